"""Cameras that encode by themselves: their pictures are passed on as they come."""

from __future__ import annotations

import inside
import pytest

from rig import faults, free_port, ip_camera, streaming, until, watching
from runner.core.commands import Command

pytestmark = [pytest.mark.gst, pytest.mark.timed]

WORDS = ("vehicle=delivery_robot", "source=rtsp", "graph=pass_through")


def test_the_vehicle_neither_decodes_nor_encodes():
    with (
        ip_camera(free_port()) as (address, _),
        streaming(*WORDS, f'source.address="{address}"', cameras=("rear",)) as (side, _, plans, reported),
    ):
        side.turn([Command("rear", knob, value) for knob, value in (("sending", True), ("bitrate", 500))])
        with watching(plans[0]) as client:
            until(lambda: len(client.sizes) > 20)
            kinds = [each.get_factory() for each in inside.sender(side, "rear").iterate_recurse()]
            words = {word for kind in kinds if kind for word in kind.get_metadata("klass").split("/")}
            print(set(client.sizes), side.read(), words)
            assert not words & {"Decoder", "Encoder"}
            assert faults(reported) == ["rear: pipeline built"]
