"""`graph=h265_rtsp`: x265 on the vehicle, its knobs turned while a viewer decodes with libav."""

from __future__ import annotations

import pytest

from rig import rejected, streaming, until, watching
from runner.core.commands import Command
from runner.core.model import Roi
from runner.h264.access_unit import H265_IRAP, H265_VCL, has_parameter_sets, nal_units

gst = pytest.importorskip("runner.gst")
pytestmark = [
    pytest.mark.gst,
    pytest.mark.skipif(
        not all(gst.Gst.ElementFactory.find(name) for name in ("x265enc", "avdec_h265")), reason="needs x265"
    ),
]
WORDS = ("vehicle=delivery_robot", "source.elements.0.properties.pattern=ball", "fps_max=15", "graph=h265_rtsp")


def is_key(unit):
    kinds = (header >> 1 & 0x3F for header, _ in nal_units(unit))
    return next(kind for kind in kinds if kind in H265_VCL) in H265_IRAP


def test_it_follows_its_knobs_while_a_viewer_decodes():
    with streaming(*WORDS, "graph.key_interval_s=60", cameras=("rear",)) as (side, _, (plan,), reported):
        turned = {"size": (212, 120), "bitrate": 300}
        side.turn([Command("rear", knob, value) for knob, value in turned.items()])
        with watching(plan) as client:
            units = []

            def on_unit(_pad, info):
                buffer = info.get_buffer()
                units.append(buffer.extract_dup(0, buffer.get_size()))
                return client.gst.PadProbeReturn.OK

            received = client.pipeline.get_by_name("received").get_static_pad("sink")
            received.add_probe(client.gst.PadProbeType.BUFFER, on_unit)

            def keys():
                return [unit for unit in units if is_key(unit)]

            def then_a_key_picture(ask):
                count = len(keys())
                ask()
                until(lambda: len(keys()) > count)

            until(lambda: len(client.sizes) > 10)
            then_a_key_picture(lambda: side.turn([Command("rear", "size", (104, 60))]))
            until(lambda: (104, 60) in client.sizes)
            then_a_key_picture(lambda: side.turn([Command("rear", "bitrate", 100)]))
            assert side.read()["rear"].applied["bitrate"] == 100
            then_a_key_picture(lambda: side.send_key_frames(["rear"]))
            side.turn([Command("rear", "roi", Roi(0, 0, 424, 240))])
            count = len(client.sizes)
            until(lambda: len(client.sizes) > count + 10)
            assert all(has_parameter_sets(unit, "h265") for unit in keys())
            assert client.errors == []
            assert not rejected(reported)
