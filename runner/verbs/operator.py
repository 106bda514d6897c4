"""usage: tod-runner operator [OVERRIDE ...] [duration_s=N] [log=DIR | drives=DIR]

The operator's side: receives and decodes every camera with the operator graph of the configuration. A browser on this
machine shows the page at http://127.0.0.1:8090/ (page.port): all pictures, the modes S, A and C, regions of interest,
bitrates and factors, charts, the drive, and why each decision was made. The terminal shows the same as a table. Ends
with Ctrl-C or duration_s after the vehicle came online, with a summary of how well the received video followed the
decisions; it waits at most 20 s for a vehicle that is offline. With log=DIR everything received is written to
DIR/operator.jsonl, for `report` and `export`; with drives=DIR to DIR/TIME/operator.jsonl, where TIME is the start in
UTC. With experiment= it sends that experiment's requests at their times.

  tod-runner operator                      everything from the vehicle at media.host
  tod-runner operator keys=keys/alice media.host=192.0.2.7 control.host=192.0.2.1 control.port=8883
  tod-runner operator page.serve=false     the table only
  tod-runner operator ros.pictures=true    with decoded pictures as ROS topics, see docs/ros.md
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from runner.configuration.layout import WITHOUT_KEYS, Layouts
from runner.operator.live import LiveOperator, live_operator
from runner.security.exposure import page_keyring
from runner.system.memory import freeze_loaded
from runner.system.signals import stopping
from runner.verbs import Arguments
from runner.verbs.screen import SWITCH_S, streaming
from runner.verbs.table import LiveTable, show_summary

if TYPE_CHECKING:
    from runner.page.server import PageServer

SHOW_S = 0.25


def run(arguments: Arguments) -> int:
    streaming()
    duration = arguments.number("duration_s")
    sys.setswitchinterval(SWITCH_S)
    with (
        LiveTable() as table,
        live_operator(arguments.overrides, arguments.conf, log=arguments.drive(), site=arguments.site) as operator,
    ):
        station = operator.station
        station.listeners.append(table)
        with _served(operator, arguments.conf) as page:
            operator.start(page.show if page else None, duration)
            freeze_loaded()
            with stopping(action=operator.end) as stop:
                running = True
                while running:  # once more after the end, to show the last notes
                    running = operator.runs(SHOW_S)
                    table.show(station.rows(), station.headline(), station.uplinks)
    show_summary(station.meters, station.samples)
    return stop.status


@contextmanager
def _served(operator: LiveOperator, conf: Path | None) -> Iterator[PageServer | None]:
    """The page, unless the configuration switches it off.

    conf  the user's directory, with the operator's layouts
    """
    setup, station = operator.setup, operator.station
    if not setup.page.serve:
        yield None
        return
    from runner.page.server import PageServer

    layouts = Layouts(conf, station.identity if setup.keys else WITHOUT_KEYS)
    page = PageServer(setup, station, keyring=page_keyring(setup), layouts=layouts)
    station.listeners.append(page)
    page.start()
    station.note(f"page: {page.url}")
    try:
        yield page
    finally:
        page.stop()
