"""A link that is cut and restored, with RTSP and SRT together."""

from __future__ import annotations

import time
from contextlib import contextmanager

import pytest

from rig import free_port, needs_root, process, until
from runner.configuration.config import configuration
from runner.link import limited_link
from runner.link.limit import Limit, OneWay
from runner.mqtt.broker import private_broker
from runner.plans import compile_plans
from runner.settings import Endpoint

BACK_S = 5
CONTROL_S = 1.0  # until the control link has recovered; until then it is unknown which cameras should send
COMMON = ("source=test", "fps_max=15", "pqos=constant", "pqos.kbps=1000", "modes=paper", "page.serve=false")
# Each vehicle with one camera.
RTSP = ("vehicle=delivery_robot", "~cameras.front", "~cameras.mast")
OTHERS = ("front_left", "front_right", "front_center", "top_front", "top_left", "top_right", "top_rear")
SMALL = ("cameras.rear_center.width_px=480", "cameras.rear_center.height_px=260")
SRT = ("vehicle=tum_q7", "graph=h264_srt", *SMALL, *(f"~cameras.{name}" for name in OTHERS))


@contextmanager
def received(*words):
    """One camera at the operator. Yields (frames so far, given whether it is known to send; messages)."""
    from runner.apply import OperatorSide

    plans = compile_plans(configuration([*COMMON, *words]).setup())
    messages = []
    side = OperatorSide(plans, lambda cameras, what: messages.append(f"{cameras}: {what}"))
    name = plans[0].camera.name
    try:
        yield lambda known: side.sample({name: True} if known else {})[name].frames, messages
    finally:
        side.stop()


@needs_root
@pytest.mark.parametrize("cut_s", [8, pytest.param(20, marks=pytest.mark.soak)])
def test_after_a_cut_everything_is_back_within_5_s(cut_s):
    media, srt = Endpoint("127.0.0.1", free_port()), free_port()
    passing = [True]

    def kbps(t):
        return 20_000 if passing[-1] else 0

    wide = Limit(kbps, queue_ms=200, delay_ms=0, reverse=OneWay(kbps, queue_ms=200, delay_ms=0))
    with (
        limited_link("netns", wide, media, Endpoint("127.0.0.1", free_port()), lambda line: None) as link,
        private_broker(link.broker),
    ):
        here = (f"media.host={link.broker.host}", f"graph.first_port={srt}", "insecure=true")  # SRT dials the operator
        control = tuple(word for word in link.vehicle_overrides if word.startswith("control."))
        link.start(time.time())
        with (
            process("vehicle", *COMMON, *RTSP, *link.vehicle_overrides, before=link.vehicle_command),
            process("vehicle", *COMMON, *SRT, *here, *control, before=link.vehicle_command),
            received(*RTSP, *link.operator_overrides) as (rtsp_frames, _),
            received(*SRT, *here) as (srt_frames, _),
        ):
            cameras = {"rtsp": rtsp_frames, "srt": srt_frames}

            def frames(known):
                return {transport: count(known) for transport, count in cameras.items()}

            until(lambda: min(frames(True).values()) > 30)
            passing.append(False)
            cut = time.monotonic()
            while time.monotonic() < cut + cut_s:
                before = frames(False)
                time.sleep(0.1)
            passing.append(True)
            began, back = time.monotonic(), {}
            while len(back) < len(cameras) and time.monotonic() < began + 3 * BACK_S:
                passed = time.monotonic() - began
                now = frames(passed > CONTROL_S)
                back |= {name: passed for name in cameras if now[name] > before[name] + 5 and name not in back}
                time.sleep(0.05)
            assert set(back) == {"rtsp", "srt"}
            assert max(back.values()) < BACK_S
