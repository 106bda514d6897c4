"""The operator's table in the terminal, and the summary at its end."""

from __future__ import annotations

import os
import select
import sys
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Any

from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table as RichTable
from rich.text import Text

from runner.operator.meter import ReceptionMeter, middle, percentile
from runner.operator.station import CameraRow, Listener
from runner.operator.uplinks import UplinkRow
from runner.records.lines import Note
from runner.redact import printable
from runner.system.signals import urgent
from runner.verbs.screen import forgiving

PLAIN_EVERY_S = 5.0
NOTES = 4
MAX_PENDING = 1000
WHY = "why"
HEADINGS = ("fps", "kbit/s", "allocated", "demand", "size", "factor", "latency ms", "lost", WHY)
NARROW = ("fps", "kbit/s", "allocated", "size", "latency ms", "lost")
SUMMARY = (
    *(
        "frames",
        "Hz",
        "seconds with\ntoo few frames",
        "received of\nallocated",
        "seconds at\ndecided size",
        "sizes\nseen",
    ),
    *("latency ms\nmedian", "p95", "packets\nlost", "stream\nrebuilt"),
)
IN_SHORT = ("frames", "Hz", "seconds with\ntoo few frames", "latency ms\nmedian", "p95", "packets\nlost")
WHOLE = 110  # columns from which all of these fit
WHOLE_SUMMARY = 130
MOST_NAME = 20  # columns that a camera's name keeps on a narrow terminal


class LiveTable(Listener):
    """Shown in place on a terminal, every few seconds elsewhere. Driving continues if it cannot be shown."""

    def __init__(self) -> None:
        self._console = _console()
        self._live = Live(console=self._console, auto_refresh=False) if sys.stdout.isatty() else None
        self._pending: deque[str] = deque(maxlen=MAX_PENDING)  # notes not shown yet
        self._notes: deque[str] = deque(maxlen=NOTES)
        self._shown = 0.0
        self._stack = ExitStack()

    def __enter__(self) -> LiveTable:
        if self._live:
            self._stack.enter_context(urgent(_show_cursor))
            self._stack.enter_context(self._live)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._stack.__exit__(kind, error, at)

    def announce(self, text: str) -> None:
        """Print one line that stays above the table."""
        self._console.print(_line(time.time(), text), markup=False, highlight=False)

    def on_note(self, note: Note) -> None:
        """Add one line below the table, shown with its next update. May be called from any thread."""
        self._pending.append(_line(note.t, note.text))

    def show(self, rows: Sequence[CameraRow], headline: str, uplinks: Sequence[UplinkRow] = ()) -> None:
        while self._pending:
            line = self._pending.popleft()
            self._notes.append(line)
            if not self._live:
                self._console.print(line, markup=False, highlight=False)
        title = Text("\n").join((Text(headline), *map(_uplink, uplinks)))
        if self._live:
            self._live.update(Group(_table(rows, title, self._console.width), *map(Text, self._notes)), refresh=True)
        elif time.monotonic() - self._shown >= PLAIN_EVERY_S:
            self._shown = time.monotonic()
            self._console.print(_table(rows, title, self._console.width))


def _line(t: float, text: str) -> str:
    return f"{time.strftime('%H:%M:%S', time.localtime(t))} {printable(text)}"


def _console() -> Console:
    return Console(file=forgiving(sys.stdout), width=None if sys.stdout.isatty() else 150)


def _show_cursor() -> None:
    """Undo the live table's changes to the terminal, unless it accepts no output."""
    if select.select([], [sys.stdout], [], 0)[1]:
        os.write(sys.stdout.fileno(), b"\x1b[?25h\n")


def _uplink(row: UplinkRow) -> Text:
    return Text(row.words, style="bold red" if row.is_stalled else "")


def _table(rows: Sequence[CameraRow], title: Text, width: int) -> RichTable:
    """Cameras by row, in so many columns of the terminal: a narrow one shows what was received, not why."""
    cells = {row.name: _cells(row) for row in rows}
    shown = NARROW if width < WHOLE else HEADINGS
    table = RichTable(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("camera", overflow="fold", min_width=min(MOST_NAME, max(map(len, cells), default=0)))
    for heading in shown:
        table.add_column(
            heading, justify="left" if heading == WHY else "right", no_wrap=heading != WHY, overflow="fold"
        )
    for name, each in cells.items():
        table.add_row(name, *(each[heading] for heading in shown))
    return table


def _cells(row: CameraRow) -> dict[str, str | Text]:
    received, state = row.received, row.state
    size = f"{received.width}x{received.height}" if received.width and row.rates.fps else "-"
    if row.refused:
        size = "refused"
    return {
        "fps": f"{row.rates.fps:.1f}",
        "kbit/s": f"{row.rates.kbps:.0f}",
        "allocated": str(state.kbps) if state else "-",
        "demand": f"{state.demand_kbps:.0f}" if state else "-",
        "size": Text(size, style=_size_style(row)),
        "factor": str(state.scaling or ("LOST" if state.on else "off")) if state else "-",
        "latency ms": f"{received.latency_ms:.1f}" if received.latency_ms is not None else "-",
        "lost": str(received.lost),
        WHY: row.refused or (state.reason if state else ""),
    }


def _size_style(row: CameraRow) -> str:
    """Highlights a picture that does not have the decided size (yet)."""
    decided, received = row.state, row.received
    wrong = decided and decided.sending and (decided.width, decided.height) != (received.width, received.height)
    return "bold yellow" if wrong else ""


def show_summary(meters: Mapping[str, ReceptionMeter], received: Mapping[str, Any]) -> None:
    """Reception compared with the decisions, over the whole run."""
    console = _console()
    shown = IN_SHORT if console.width < WHOLE_SUMMARY else SUMMARY
    title = "received over the drive, compared with what was decided"
    table = RichTable(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("camera", overflow="fold")
    for heading in shown:
        table.add_column(heading, justify="right", no_wrap=True)
    for name, meter in meters.items():
        if sample := received.get(name):
            cells = _summary(meter, sample)
            table.add_row(name, *(cells[heading] for heading in shown))
    console.print(table)


def _summary(meter: ReceptionMeter, sample: Any) -> dict[str, str]:
    values = (
        str(sample.frames),
        f"{meter.fps:g}",
        f"{meter.short} of {meter.windows}",
        _share(middle(meter.followed)),
        f"{sum(meter.sizes.values())} of {meter.sized}",
        str(len(meter.sizes)),
        _number(middle(meter.latencies_ms)),
        _number(percentile(meter.latencies_ms, 0.95)),
        str(sample.lost),
        str(sample.rebuilt),
    )
    return dict(zip(SUMMARY, values, strict=True))


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.0%}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"
