"""usage: tod-runner operator [OVERRIDE ...] [vehicles=[NAME, ...]] [duration_s=N] [log=DIR | drives=DIR]

The operator's side: receives and decodes every camera with the operator graph of the configuration. A browser on this
machine shows the page at http://127.0.0.1:8090/ (page.port): all pictures, the modes S, A and C, regions of interest,
bitrates and factors, charts, the drive, and why each decision was made. The terminal shows the same as a table. Ends
with Ctrl-C or duration_s after the vehicle came online, with a summary of how well the received video followed the
decisions; it waits at most 20 s for a vehicle that is offline. With log=DIR everything received is written to
DIR/operator.jsonl, for `report` and `export`; with drives=DIR to DIR/TIME/operator.jsonl, where TIME is the start in
UTC. With experiment= it sends that experiment's requests at their times.

With vehicles=[a, b] the page is a list of these vehicles, each named as its file in vehicle/; vehicles=all lists all
that the broker knows. Opening one there drives it. Each has a station in a process of its own, which receives pictures
only while somebody looks at them. With drives=DIR those of each vehicle go to DIR/NAME/TIME.

  tod-runner operator                      everything from the vehicle at media.host
  tod-runner operator keys=keys/alice media.host=192.0.2.7 control.host=192.0.2.1 control.port=8883
  tod-runner operator control.broker=embedded   with a broker of its own, for as long as it runs
  tod-runner operator page.serve=false     the table only
  tod-runner operator vehicles=all         one page for all vehicles
  tod-runner operator ros.pictures=true    with decoded pictures as ROS topics, see docs/ros.md
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from runner.configuration.layout import WITHOUT_KEYS, Layouts
from runner.operator.live import LiveOperator, live_operator
from runner.operator.station import Listener
from runner.records.lines import Note
from runner.security.exposure import page_keyring
from runner.system.memory import freeze_loaded
from runner.system.signals import stopping
from runner.verbs import Arguments
from runner.verbs.screen import SWITCH_S, say, streaming
from runner.verbs.table import LiveTable, show_summary

if TYPE_CHECKING:
    from runner.page.server import PageServer

SHOW_S = 0.25


def run(arguments: Arguments) -> int:
    if "vehicles" in arguments.values:
        from runner.verbs import fleet

        return fleet.run(arguments)
    streaming()
    if socket := arguments.path("socket"):
        return _run_behind(socket, arguments)
    from runner.drive.keeping import keeping_room

    duration = arguments.number("duration_s")
    sys.setswitchinterval(SWITCH_S)
    with (
        LiveTable() as table,
        live_operator(arguments.overrides, arguments.conf, log=arguments.drive(), site=arguments.site) as operator,
    ):
        station = operator.station
        station.listeners.append(table)
        room = keeping_room(arguments.path("drives"), operator.setup.log, station.note)
        end = "Ctrl-C ends" if duration is None else f"ends after {duration:g} s, or with Ctrl-C"
        with room, _served(operator, arguments.conf, announce=lambda what: table.announce(f"{what} ({end})")) as page:
            operator.start(page.show if page else None, duration, page.hear if page else None)
            freeze_loaded()
            with stopping(action=operator.end) as stop:
                running = True
                while running:  # once more after the end, to show the last notes
                    running = operator.runs(SHOW_S)
                    table.show(station.rows(), station.headline(), station.uplinks)
    show_summary(station.meters, station.samples)
    return stop.status


class _Notes(Listener):
    """Prints each note as a line of its own."""

    def on_note(self, note: Note) -> None:
        say(note.text)


def _run_behind(socket: Path, arguments: Arguments) -> int:
    """Run one of several stations behind the page of a list, see `runner.verbs.fleet`; ends with that process."""
    from runner.drive.keeping import keeping_room

    sys.setswitchinterval(SWITCH_S)
    with live_operator(
        arguments.overrides, arguments.conf, log=arguments.drive(), site=arguments.site, on_demand=True
    ) as operator:
        operator.station.listeners.append(_Notes())
        room = keeping_room(arguments.path("drives"), operator.setup.log, operator.station.note)
        with room, _served(operator, arguments.conf, socket=socket) as page:
            assert page
            operator.on_dropped = page.forget
            operator.start(page.show, on_sound=page.hear)
            freeze_loaded()
            with stopping(action=operator.end) as stop:
                while operator.runs(SHOW_S):
                    pass
    return stop.status


@contextmanager
def _served(
    operator: LiveOperator, conf: Path | None, *, announce: Callable[[str], None] = say, socket: Path | None = None
) -> Iterator[PageServer | None]:
    """The page, unless the configuration switches it off.

    conf      the user's directory, with the operator's layouts
    announce  is told its address
    socket    see `PageServer`; then there is none
    """
    setup, station = operator.setup, operator.station
    if not setup.page.serve:
        yield None
        return
    from runner.page.server import PageServer

    layouts = Layouts(conf, station.identity if setup.keys else WITHOUT_KEYS)
    served = partial(PageServer, setup, station, layouts=layouts, on_voice=operator.speak, on_lacking=operator.lack)
    page = served(socket=socket, on_shown=operator.show) if socket else served(keyring=page_keyring(setup))
    station.listeners.append(page)
    page.start()
    if socket is None:
        announce(f"page: {page.url}")
    try:
        yield page
    finally:
        page.stop()
