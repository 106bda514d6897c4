"""An operator's side for another network namespace: prints when each picture was decoded and each request answered.

    python remote_operator.py OVERRIDE...

One line of JSON each, with times of the monotonic clock, which all namespaces share: {"what": CAMERA, "t": SECONDS} for
a picture, {"what": "control", ...} for an answer to a request, {"note": TEXT} for what the operator would read.
"""

from __future__ import annotations

import json
import os
import sys
import time

from runner import apply
from runner.configuration import agreement
from runner.configuration.config import configuration
from runner.drive.log import Log
from runner.operator.live import LiveOperator
from runner.operator.station import Listener, Station
from runner.plans import compile_plans
from runner.records.lines import Note
from runner.security.exposure import viewer_keyring

ASK_S = 0.1


def report(**what: object) -> None:
    os.write(sys.stdout.fileno(), f"{json.dumps(what)}\n".encode())  # unbuffered: several threads write


class Notes(Listener):
    def on_note(self, note: Note) -> None:
        report(note=note.text, t=time.monotonic())


def main(words: list[str]) -> None:
    config = configuration(words, check=apply.check_plan)
    setup = config.setup()
    plans, keyring = compile_plans(setup), viewer_keyring(setup)
    station = Station(setup, agreement.settings(config.document), keyring)
    station.listeners.append(Notes())

    def build(_on_unit: object) -> apply.OperatorSide:
        return apply.OperatorSide(
            plans,
            lambda camera, what: station.note(f"{camera}: {what}"),
            on_picture=lambda camera, *_: report(what=camera, t=time.monotonic()),
            operator=station.identity,
            keyring=keyring,
            vehicle=setup.vehicle.name,
            uplinks=station.addresses if setup.uplinks else None,
        )

    operator = LiveOperator(setup, station, Log(None, "operator", {}, {}, station.note), build)
    operator.start()
    while operator.runs(ASK_S):
        station.ask({"event": "mode_selected", "mode": "automatic"}, on_answer)


def on_answer(outcome: object) -> None:
    if getattr(outcome, "result", "") == "applied":
        report(what="control", t=time.monotonic())


if __name__ == "__main__":
    main(sys.argv[1:])
