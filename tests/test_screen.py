"""Lines and tables of the live verbs, and where they go when nobody can read them."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import IO

import pytest
from rich.console import Console

from runner.operator.meter import ReceptionMeter
from runner.records.lines import Note
from runner.verbs.screen import progress_bar, say
from runner.verbs.table import LiveTable, show_summary


@pytest.fixture(params=["a pipe without a reader", "a full disk"])
def unwritable(request: pytest.FixtureRequest) -> Iterator[IO[str]]:
    if request.param == "a full disk":
        descriptor = os.open("/dev/full", os.O_WRONLY)
    else:
        reader, descriptor = os.pipe()
        os.close(reader)
    yield os.fdopen(descriptor, "w", buffering=1, closefd=False)
    os.close(descriptor)


def test_a_line_that_cannot_be_written_is_dropped(unwritable: IO[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", unwritable)
    say("finishing the files")
    with progress_bar() as progress:
        progress("front", 0.5)


def test_a_table_that_cannot_be_written_is_dropped(unwritable: IO[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", unwritable)
    with LiveTable() as table:
        for _ in range(2):
            table.on_note(Note(0.0, "the vehicle is online"))
            table.show([], "mode A")
    show_summary({}, {})


def test_what_can_be_written_arrives(capsys: pytest.CaptureFixture[str]) -> None:
    say("finishing the files")
    print("written")
    out, err = capsys.readouterr()
    assert out == "written\n" and err.endswith(" finishing the files\n")


def test_progress_that_does_not_interrupt(monkeypatch: pytest.MonkeyPatch) -> None:
    def check() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("runner.system.signals.check", check)
    with progress_bar(interrupts=False) as progress:
        progress("front", 0.5)
    with pytest.raises(KeyboardInterrupt), progress_bar() as progress:
        progress("front", 0.5)


def test_the_page_is_announced_above_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    with LiveTable() as table:
        table.announce("page: http://127.0.0.1:8090/ (Ctrl-C ends)")
        table.show([], "mode A")
    first, *_ = capsys.readouterr().out.splitlines()
    assert first.endswith(" page: http://127.0.0.1:8090/ (Ctrl-C ends)")


def test_a_narrow_terminal_gets_a_summary_that_fits(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("runner.verbs.table._console", lambda: Console(file=sys.stdout, width=80))
    show_summary({"front_center": ReceptionMeter(15)}, {"front_center": SimpleNamespace(frames=229, lost=3, rebuilt=0)})
    out = capsys.readouterr().out
    assert "…" not in out and max(map(len, out.splitlines())) <= 80
    assert out.splitlines()[-2].split() == ["front_center", "229", "15", "0", "of", "0", "-", "-", "3"]
