"""Effects of SIGINT, SIGTERM and SIGHUP on a process, whatever its main thread is busy with."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from textwrap import dedent, indent

import pytest

from runner.system.signals import END_S, LIFELINE

pytestmark = pytest.mark.slow  # starts and ends processes
# 128 and the signal's number; or the signal itself, if it arrives after the interpreter has put back its handlers
BY_SIGNALS = (130, 143, -signal.SIGINT, -signal.SIGTERM)

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
LOCK = "lock = ctypes.create_string_buffer(64); ctypes.CDLL(None).pthread_mutex_lock(lock)"  # twice: blocks for ever


def started(body: str, **options: object) -> subprocess.Popen[str]:
    """A process that runs `body` as a verb would run, and has printed "ready"."""
    program = dedent(
        """\
        import ctypes, sys, threading, time
        from pathlib import Path
        from runner.system import signals
        from runner.system.files import unfinished
        def ready():
            print("ready", flush=True)
        with signals.handled():
            try:
                with signals.interruptible():
        """
    )
    program += indent(dedent(body), 12 * " ")
    program += "\n    except KeyboardInterrupt:\n        sys.exit(128 + signals.received())\n"
    words = [sys.executable, "-c", program]
    child = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)  # type: ignore[call-overload]
    assert child.stdout
    assert child.stdout.readline() == "ready\n", child.communicate(timeout=10)
    return child  # type: ignore[no-any-return]


def ended(child: subprocess.Popen[str]) -> tuple[int, str, float]:
    """Exit status, standard error, and seconds until the end."""
    began = time.monotonic()
    _, errors = child.communicate(timeout=20)
    return child.returncode, errors, time.monotonic() - began


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_interrupts_the_main_thread(number: signal.Signals) -> None:
    child = started("ready(); time.sleep(60)")
    child.send_signal(number)
    assert ended(child)[:2] == (128 + number, "")


def test_nohup_keeps_a_process_running() -> None:
    child = started("ready(); time.sleep(60)", preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN))
    child.send_signal(signal.SIGHUP)
    child.send_signal(signal.SIGTERM)
    assert ended(child)[:2] == (143, "")


@pytest.mark.parametrize("times", [1, 3])
def test_an_interrupt_that_python_discards_is_repeated(times: int) -> None:
    """In a destructor, as in the callback of a weak reference that every import has."""
    child = started(
        f"""\
        class Slow:
            def __del__(self):
                time.sleep(60)
        ready()
        for _ in range({times}):
            slow = Slow()
            del slow
        time.sleep(60)
        """
    )
    child.send_signal(signal.SIGINT)
    assert ended(child)[:2] == (130, "")


def test_an_interrupt_that_a_library_turns_into_another_error() -> None:
    child = started(
        """\
        ready()
        try:
            time.sleep(60)
        except KeyboardInterrupt:
            raise ValueError("Invalid affine transformation matrix")
        """
    )
    child.send_signal(signal.SIGTERM)
    assert ended(child)[:2] == (143, "")


@pytest.mark.parametrize("number", SIGNALS)
def test_a_verb_that_polls_is_not_interrupted(number: signal.Signals) -> None:
    child = started(
        """\
        with signals.stopping() as stop:
            ready()
            while not stop.wait(60):
                pass
        time.sleep(0.2)  # its orderly end
        sys.exit(stop.status)
        """
    )
    child.send_signal(number)
    assert ended(child)[:2] == (130 if number == signal.SIGINT else 0, "")


@pytest.mark.parametrize("mode", ["", "with signals.stopping(): "])
def test_a_main_thread_in_a_c_library_is_ended_by_force(mode: str) -> None:
    child = started(f"{mode}threading.Timer(0.3, ready).start(); {LOCK}; {LOCK.partition('; ')[2]}")
    child.send_signal(signal.SIGTERM)
    status, errors, seconds = ended(child)
    assert (status, errors) == (143, "shutdown timed out: ending now\n")
    assert seconds > END_S / 2


def test_a_second_signal_ends_immediately_and_leaves_no_partial_file(tmp_path: Path) -> None:
    child = started(
        f"""\
        with signals.stopping(limit_s=None) as stop, unfinished(Path({str(tmp_path / "file")!r})) as part:
            part.write_text("half")
            ready()
            stop.wait(60)
            print("stopping", flush=True)
            time.sleep(60)
        """
    )
    assert len(list(tmp_path.iterdir())) == 1
    child.send_signal(signal.SIGINT)
    assert child.stdout and child.stdout.readline() == "stopping\n"
    child.send_signal(signal.SIGTERM)
    assert ended(child)[:2] == (130, "second signal: ending now\n")
    assert list(tmp_path.iterdir()) == []


def test_the_same_signal_twice_at_once_is_one() -> None:
    """As `timeout` sends it: to the process, and to its group."""
    child = started("with signals.stopping() as stop:\n    ready(); stop.wait(60); time.sleep(0.3)")
    child.send_signal(signal.SIGTERM)
    time.sleep(0.02)  # two at once would be delivered as one
    child.send_signal(signal.SIGTERM)
    assert ended(child)[1] == ""


def test_hanging_cleanup_does_not_delay_the_end_for_long() -> None:
    child = started("with signals.urgent(lambda: time.sleep(60)):\n    ready(); time.sleep(0.1); time.sleep(60)")
    child.send_signal(signal.SIGSTOP)  # both signals are pending when it resumes
    child.send_signal(signal.SIGINT)
    child.send_signal(signal.SIGTERM)
    child.send_signal(signal.SIGCONT)
    status, errors, seconds = ended(child)
    assert status in BY_SIGNALS
    assert errors == "second signal: ending now\n"
    assert seconds < 10


def test_a_full_pipe_of_standard_error_does_not_delay_the_end() -> None:
    child = started("ready()\nwhile True:\n    sys.stderr.write('x' * 4096)")
    time.sleep(0.2)  # the pipe is full now
    child.send_signal(signal.SIGINT)
    child.send_signal(signal.SIGTERM)
    assert child.wait(10) in BY_SIGNALS


def test_a_verb_whose_lifeline_closes_ends_as_by_sigterm() -> None:
    read, write = os.pipe()
    child = started(
        "with signals.stopping() as stop:\n    ready(); stop.wait(60)\nsys.exit(stop.status)",
        pass_fds=[read],
        env={**os.environ, LIFELINE: str(read)},
    )
    os.close(read)
    os.close(write)
    assert ended(child)[:2] == (0, "")


def test_a_parent_that_ended_before_the_verb_started_is_noticed() -> None:
    read, write = os.pipe()
    os.close(write)
    words = [sys.executable, "-m", "runner", "replay", "modes=paper", "source=test"]
    with subprocess.Popen(
        words, stdin=subprocess.PIPE, stderr=subprocess.PIPE, pass_fds=[read], env={**os.environ, LIFELINE: str(read)}
    ) as child:
        os.close(read)
        assert child.wait(20) == 143
        assert child.stderr and child.stderr.read() == b""
