"""What retransmission repairs by bitrate and round trip: one camera over a lossy link, no key frames for the rest.

  python bench/retransmission.py                 four minutes
  python bench/retransmission.py --loss 0.03 --seconds 20

A row for each bitrate and round trip: frames received, those with visible damage, and packets that never arrived. Run
it on an otherwise idle machine.
"""

from __future__ import annotations

import argparse
import time
from contextlib import ExitStack

from uplinks import row

from runner.apply import OperatorSide, VehicleSide, check_plan
from runner.configuration.config import configuration
from runner.core.commands import Command
from runner.gst.receiver import Reception
from runner.link import Limit, limited_link
from runner.link.limit import OneWay
from runner.plans import compile_plans
from runner.settings import Endpoint

CAMERA = "rear"
KBPS = (3000, 6000, 8000)
ROUND_TRIPS_MS = (30, 80, 160, 200)
SETTLE_S = 2.0  # until the round trip is known
WIDE_KBPS = 50_000
NOISE = (  # needs all of the bitrate
    "source.elements=[{name: source, element: videotestsrc, properties: {is-live: true, pattern: snow}},"
    ' {name: raw, element: capsfilter, properties: {caps: "{raw_caps}"}}]'
)
WORDS = ("vehicle=delivery_robot", "fps_max=30", "source=test", NOISE, "media.port=18554")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loss", type=float, default=0.01)
    parser.add_argument("--seconds", type=float, default=15)
    options = parser.parse_args()
    print(row("kbit/s", "round trip, ms", "frames", "damaged", "packets lost for good"))
    print(row(*["---"] * 5))
    for kbps in KBPS:
        for round_trip_ms in ROUND_TRIPS_MS:
            before, after = drive(kbps, round_trip_ms, options.loss, options.seconds)
            counts = [getattr(after, key) - getattr(before, key) for key in ("frames", "damaged", "lost")]
            print(row(str(kbps), str(round_trip_ms), *map(str, counts)), flush=True)


def drive(kbps: int, round_trip_ms: int, loss: float, seconds: float) -> tuple[Reception, Reception]:
    """What had been received when the stream had settled, and at the end."""
    setup = configuration(WORDS, check=check_plan).setup()
    delay_ms = round_trip_ms / 2
    limit = Limit(
        lambda _t: WIDE_KBPS,
        queue_ms=500,
        delay_ms=delay_ms,
        loss=loss,
        reverse=OneWay(lambda _t: WIDE_KBPS, queue_ms=500, delay_ms=delay_ms),
    )
    with ExitStack() as stack:
        plans = [plan for plan in compile_plans(setup) if plan.camera.name == CAMERA]
        side = VehicleSide(plans, setup.media, lambda *_: None)
        stack.callback(side.stop)
        side.turn([Command(CAMERA, knob, value) for knob, value in {"sending": True, "bitrate": kbps}.items()])
        link = stack.enter_context(
            limited_link("relay", limit, setup.media, Endpoint("127.0.0.1", 18883), lambda _sample: None)
        )
        reached = configuration([*WORDS, *link.operator_overrides], check=check_plan).setup()
        operator = OperatorSide(
            [plan for plan in compile_plans(reached) if plan.camera.name == CAMERA], lambda *_: None
        )
        stack.callback(operator.stop)
        before = _received(operator, SETTLE_S)
        return before, _received(operator, seconds)


def _received(operator: OperatorSide, seconds: float) -> Reception:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        received = operator.sample({CAMERA: True})[CAMERA]
        time.sleep(0.25)
    return received


if __name__ == "__main__":
    main()
