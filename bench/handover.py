"""Gaps in the pictures of both operators while one hands a moving vehicle over to the other.

  sudo .venv/bin/python bench/handover.py            20 drives, 5 minutes; fewer: --drives 3

A vehicle goes 8 m/s and sends each camera once (`media.max_viewers=1`); it is reached by an address that is not
loopback, so that copies count. Each drive has two new stations. The first one is in control and offers it to the other,
which gets no pictures until then; it accepts once every camera has been live for a second. A row for each drive: time
from the offer until all of that second is over, and the longest gap between two pictures of a camera, in frame
intervals, at either side: of the first one until control passes, of the second one from the beginning of its live
second until 2 s after. The first one's longest gap in the 2 s before the offer shows what the machine itself causes.
Exit status 1: a gap is above 2 intervals.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any, NamedTuple

from rig import SMALL_ROBOT, free_port, process, repeating, until
from runner.h264.access_unit import AccessUnit
from runner.live import live_operator
from runner.mqtt.broker import private_broker
from runner.settings import Endpoint

HOST = "10.77.0.1"
INSIDE = "TOD_BENCH_HANDOVER"
FPS, SPEED_MPS, LIVE_S, AFTER_S, MOST = 15, 8.0, 1.0, 2.0, 2.0
INTERVAL_S = 1 / FPS
ROBOT = (*SMALL_ROBOT, "source=test", f"fps_max={FPS}", "modes=open_loop", "pqos=constant", "pqos.kbps=3000")
POSITION = {"event": "position_reported", "lat": 48.26, "lon": 11.67, "speed_mps": SPEED_MPS}


class Row(NamedTuple):
    """Of one drive: time from the offer until control could pass, s; longest gaps before it and after, intervals."""

    until_live_s: float
    before: float
    former: float
    latter: float


class Side:
    """A station, and when its pictures arrived, by camera, s since 1970."""

    def __init__(self, operator: Any) -> None:
        self.station, self._cameras = operator.station, operator.setup.vehicle.cameras
        self.arrived: dict[str, list[float]] = defaultdict(list)
        operator.start(self._on_unit)

    def _on_unit(self, camera: str, unit: AccessUnit) -> None:
        self.arrived[camera].append(unit.arrived)

    def is_present(self) -> bool:
        """Whether the vehicle knows this operator."""
        state = self.station.state
        return bool(state and state.driving and self.station.identity in state.driving.present)

    def live(self) -> list[str]:
        """The cameras whose pictures have arrived without a gap for a second."""
        now = time.time()
        return [name for name in list(self.arrived) if self._is_live(name, now)]

    def sees_all(self) -> bool:
        return set(self.live()) == set(self._cameras)

    def _is_live(self, name: str, now: float) -> bool:
        times = [now - LIVE_S, *(t for t in list(self.arrived[name]) if t > now - LIVE_S), now]
        return self.arrived[name][0] < now - LIVE_S and longest(times) <= MOST * INTERVAL_S

    def gap(self, begin: float, end: float) -> float:
        """The longest gap of any camera between two times, in frame intervals."""
        return max(longest([t for t in times if begin <= t <= end]) for times in self.arrived.values()) / INTERVAL_S

    def ask(self, **event: Any) -> None:
        """raises SystemExit if the vehicle refuses it"""
        if problem := self.refusal(**event):
            raise SystemExit(f"{event['event']}: {problem}")

    def refusal(self, **event: Any) -> str | None:
        answers: list[Any] = []
        self.station.ask(event, answers.append)
        (answer,) = until(lambda: answers)
        return None if answer.result == "applied" else f"{answer.result}: {answer.reason}"

    def accepts(self) -> bool:
        """Accept control. The vehicle refuses it until the reports that it has show these pictures."""
        return self.refusal(event="control_accepted", live=self.live()) is None


def longest(times: list[float]) -> float:
    return max((after - before for before, after in pairwise(times)), default=float("inf"))


@contextmanager
def station(words: list[str]) -> Iterator[Side]:
    with live_operator(words) as operator:
        yield Side(operator)


def drive(words: list[str]) -> Row:
    with station(words) as former:
        until(former.is_present)
        former.ask(event="control_taken")  # from the one that the last drive has left, at 8 m/s
        until(former.sees_all)
        with repeating(lambda: former.station.ask(POSITION), 0.2), station(words) as latter:
            until(latter.is_present)
            time.sleep(AFTER_S)
            if latter.arrived:
                raise SystemExit("the other station gets pictures before control is offered to it")
            offered = time.time()
            former.ask(event="control_offered", to=latter.station.identity)
            until(latter.sees_all)
            live = time.time()
            until(latter.accepts)
            passed = time.time()
            time.sleep(AFTER_S)
            before, until_passed = former.gap(offered - AFTER_S, offered), former.gap(offered, passed)
            return Row(live - offered, before, until_passed, latter.gap(live - LIVE_S, passed + AFTER_S))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=20)
    options = parser.parse_args()
    if INSIDE not in os.environ:  # a network of its own, whose address is no loopback address
        setup = f'ip link set lo up; ip address add {HOST}/24 dev lo; exec "$@"'
        command = ["unshare", "--net", "sh", "-c", setup, "sh", sys.executable, *sys.argv]
        return subprocess.run(command, env={**os.environ, INSIDE: "1"}, check=False).returncode
    words = [*ROBOT, f"media.host={HOST}", f"media.port={free_port()}", f"control.port={(control := free_port())}"]
    words.append("insecure=true")
    with (
        tempfile.TemporaryDirectory() as kept,  # nobody is known from earlier drives
        private_broker(Endpoint("127.0.0.1", control)),
        process("vehicle", *words, env={"XDG_STATE_HOME": kept}, stdout=subprocess.DEVNULL),
    ):
        rows = [shown(number, drive(words)) for number in range(options.drives)]
    worst = max(max(row.former, row.latter) for row in rows)
    print(f"longest gap {worst:.2f} intervals in {len(rows)} drives, at most {MOST:g} are wanted")
    return 0 if worst <= MOST else 1


def shown(number: int, row: Row) -> Row:
    former = f"former {row.before:.2f} before, {row.former:.2f} from the offer on"
    latter = f"latter {row.latter:.2f} intervals"
    live = f"pictures for {LIVE_S:g} s after {row.until_live_s:.1f} s"
    print(f"drive {number + 1}: {live}; longest gaps: {former}, {latter}", flush=True)
    return row


if __name__ == "__main__":
    sys.exit(main())
