"""A vehicle's side for another network namespace: its uplinks by what it reads, one line of JSON each.

    python vehicle_on_ways.py '{"words": [OVERRIDE...], "uplinks": {NAME: {"interface": DEVICE}}, "number": FIRST}'

`number` is the RTP sequence number of each camera's first packet. A line {"carry": {CAMERA: [UPLINK...]}} places
cameras, {"anew": [CAMERA...]} lets them begin anew with a key picture, {} does nothing. Each is answered: what was sent
by camera and uplink, and what was reported so far.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from functools import partial

from runner import apply
from runner.configuration.config import configuration
from runner.core.commands import Command
from runner.graph import Plan
from runner.plans import compile_plans
from runner.records import to_json
from runner.security.exposure import may_listen, vehicle_keyring
from runner.settings import Uplink


def numbered_from(first: int, plan: Plan) -> Plan:
    *elements, payloader = plan.vehicle
    numbered = replace(payloader, properties={**payloader.properties, "seqnum-offset": first})
    return replace(plan, vehicle=(*elements, numbered))


def main(given: str) -> None:
    asked = json.loads(given)
    setup = configuration(asked["words"], check=apply.check_plan).setup()
    uplinks = {name: Uplink(**keys) for name, keys in asked["uplinks"].items()}
    keyring = vehicle_keyring(setup)
    reported: list[str] = []
    side = apply.VehicleSide(
        [numbered_from(asked["number"], plan) for plan in compile_plans(setup)],
        setup.media,
        lambda camera, what: reported.append(f"{camera}: {what}"),
        keyring=keyring,
        uplinks=uplinks,
        may_listen=partial(may_listen, setup),
    )
    cameras = setup.vehicle.cameras.values()
    side.turn(Command(camera.name, "size", (camera.full_roi.width, camera.full_roi.height)) for camera in cameras)
    print(json.dumps({}), flush=True)
    for line in sys.stdin:
        wanted = json.loads(line)
        side.carry(wanted.get("carry", {}))
        side.send_key_frames(wanted.get("anew", ()), begin_anew=True)
        print(json.dumps({"sent": to_json(side.sent()), "reported": reported}), flush=True)
    side.stop()


if __name__ == "__main__":
    main(sys.argv[1])
