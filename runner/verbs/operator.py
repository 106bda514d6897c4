"""usage: tod-runner operator [OVERRIDE ...] [duration_s=N] [log=DIR]

The operator's side: receives every camera by the operator graph of the configuration and decodes it. A browser on this
machine shows the page at http://127.0.0.1:8090/ (page.port): all pictures, the modes S, A and C, regions of interest,
bitrates and factors, charts, the drive, and why each decision was made. The terminal shows a table of the same. Ends
with Ctrl-C or after duration_s, with a summary of how well what came followed what was decided. With log=DIR all that
comes is written to DIR/operator.jsonl, for `report` and `export`.

  tod-runner operator                      everything from the vehicle at media.host
  tod-runner operator vehicle=delivery_robot media.host=192.0.2.7 control.host=192.0.2.7
  tod-runner operator page.serve=false     the table only
"""

from __future__ import annotations

import gc
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from runner.config import composed, load
from runner.drive.heard import listener
from runner.drive.log import Log
from runner.model import Vehicle
from runner.sources import compile_plans
from runner.station import Station
from runner.verbs import Arguments
from runner.verbs.screen import streaming
from runner.verbs.table import Table, show_summary

if TYPE_CHECKING:
    from runner.apply import OperatorSide
    from runner.page.server import Page

SAMPLE_S = 0.25
SWITCH_S = 0.0005  # a thread that has a frame to pass on waits no longer than this for one that draws a table


def run(arguments: Arguments) -> int:
    apply = streaming()
    duration = arguments.number("duration_s")
    vehicle = load(arguments.overrides, arguments.conf, runnable=False, check=apply.check_plan)
    log = arguments.path("log")
    plans = compile_plans(vehicle)
    config = composed(arguments.overrides, arguments.conf).document if log else {}
    versions = apply.versions(element for plan in plans for element in plan.operator)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    sys.setswitchinterval(SWITCH_S)
    with Table() as table:
        station = Station(vehicle)
        station.listeners.append(table.tell)
        drive = Log(log, "operator", config, versions, station.note)
        if log:
            station.listeners.append(listener(station, drive))
        with _served(vehicle, station) as page:
            station.connect()
            video = apply.VideoFiles(log, drive.video) if log and vehicle.log_video else None
            on_unit = page.show if page else None
            side = apply.OperatorSide(plans, station.report, on_unit, arrivals=log is not None, video=video)
            drive.begin()
            gc.freeze()  # what is loaded by now stays: collecting it again and again would hold up frames
            until = None if duration is None else time.monotonic() + duration
            # A terminal that takes nothing (Ctrl-S) may hold up the table, and nothing else.
            sampling = threading.Thread(target=_sample, args=(station, side, stop, until), name="sampling", daemon=True)
            sampling.start()
            try:
                while sampling.is_alive():
                    sampling.join(SAMPLE_S)
                    table.show(station.rows(), station.headline())
            finally:
                stop.set()
                sampling.join()
                station.close()
                side.stop()
                drive.close()
    show_summary(station.meters, station.samples)
    return 0


def _sample(station: Station, side: OperatorSide, stop: threading.Event, until: float | None) -> None:
    """Take samples until it is time to stop."""
    while not stop.wait(SAMPLE_S) and (until is None or time.monotonic() < until):
        station.take(side.sample(station.sending()))


@contextmanager
def _served(vehicle: Vehicle, station: Station) -> Iterator[Page | None]:
    """The page while it is wanted."""
    if not vehicle.page.serve:
        yield None
        return
    from runner.page.server import Page

    page = Page(vehicle, station)
    page.start()
    station.listeners.append(page.tell)
    station.note(f"page: {page.url}")
    try:
        yield page
    finally:
        page.stop()
