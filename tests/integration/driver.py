"""An operator's side that tells what happens to it, for tests that start several of them and end some.

    python driver.py OVERRIDE...

Standard output has one JSON object per line: its own id, who drives whenever that changes, camera and arrival of each
access unit, answers, notes. Standard input takes requests; an acceptance gets the cameras that have arrived for 1 s.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from typing import Any

from runner.operator.live import live_operator
from runner.operator.station import Listener
from runner.records import to_json
from runner.records.lines import Note
from runner.records.vehicle import Outcome, VehicleState

GAP_S, LIVE_S = 0.5, 1.0


def say(**what: Any) -> None:
    os.write(sys.stdout.fileno(), f"{json.dumps(what)}\n".encode())  # unbuffered: several threads write


class Teller(Listener):
    def __init__(self) -> None:
        self._driving: Any = None
        self._arrived: dict[str, tuple[float, float]] = {}  # by camera: since when without a gap, and last

    def on_state(self, state: VehicleState | None) -> None:
        driving = state and to_json(state.driving)
        if driving != self._driving:
            self._driving = driving
            say(driving=driving)

    def on_note(self, note: Note) -> None:
        say(note=note.text)

    def on_unit(self, camera: str, *_: object) -> None:
        now = time.monotonic()
        since, last = self._arrived.get(camera, (now, now))
        self._arrived[camera] = (since if now - last < GAP_S else now, now)
        say(camera=camera, t=now)

    def live(self) -> list[str]:
        now = time.monotonic()
        return [name for name, (since, last) in self._arrived.items() if now - since >= LIVE_S and now - last < GAP_S]


def main(words: list[str]) -> None:
    teller = Teller()
    with live_operator(words) as operator:
        operator.station.listeners.append(teller)
        say(id=operator.station.identity)

        def listen() -> None:
            for line in sys.stdin:
                event = json.loads(line)
                if event["event"] == "control_accepted":
                    event["live"] = teller.live()
                operator.station.ask(event, lambda outcome, name=event["event"]: answered(name, outcome))

        threading.Thread(target=listen, daemon=True).start()
        operator.start(teller.on_unit)
        while operator.runs(0.1):
            pass


def answered(name: str, outcome: Outcome) -> None:
    say(answered=name, result=outcome.result, reason=outcome.reason)


if __name__ == "__main__":
    main(sys.argv[1:])
