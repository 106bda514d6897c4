"""A graph with an encoder that does not declare its properties as mutable while playing: vp8enc."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path

import pytest

from rig import NOISE, free_port, rejected, until, watching
from runner.configuration.config import configuration
from runner.core.commands import Command
from runner.errors import ConfigError
from runner.plans import compile_plans

MUTABLE = "mutable: [{element: encoder, property: target-bitrate}]\n"
GRAPH = """
transport: rtsp
first_port: 5600
vehicle:
  - {name: gate, element: valve, properties: {drop-mode: forward-sticky-events}}
  - {name: crop, element: videocrop}
  - {name: scaler, element: videoscale, properties: {add-borders: false}}
  - {name: size, element: capsfilter}
  - name: encoder
    element: vp8enc
    properties: {deadline: 1, cpu-used: 8, end-usage: cbr, buffer-size: 200, keyframe-max-dist: 30}
  - {name: sent, element: identity}
  - {name: pay0, element: rtpvp8pay, properties: {pt: 96}}
operator:
  - {name: client, element: rtspsrc, properties: {location: "{url}", latency: 40, timeout: 0}}
  - {name: depay, element: rtpvp8depay}
  - {name: received, element: identity}
  - {name: decoder, element: vp8dec}
  - {name: sink, element: fakesink, properties: {sync: false, async: false}}
wire:
  vehicle: [{name: wire, element: udpsink, properties: {host: "{host}", port: "{port}"}}]
  operator: [{name: wire, element: udpsrc, properties: {port: "{port}", caps: "application/x-rtp,media=video"}}]
knobs:
  sending: [{element: gate, property: drop, value: "off"}]
  roi:
    - {element: crop, property: left, value: left}
    - {element: crop, property: right, value: right}
    - {element: crop, property: top, value: top}
    - {element: crop, property: bottom, value: bottom}
  size: [{element: size, property: caps, value: "video/x-raw,width={width},height={height},pixel-aspect-ratio=1/1"}]
  bitrate: [{element: encoder, property: target-bitrate, value: bps}]
"""
WORDS = ("vehicle=delivery_robot", *NOISE, "graph=vp8", "fps_max=15")


@contextmanager
def sending(conf: Path):
    from runner.apply import VehicleSide, check_plan

    setup = configuration([*WORDS, f"media.port={free_port()}"], conf, check=check_plan).setup()
    (plan,) = (plan for plan in compile_plans(setup) if plan.camera.name == "rear")
    reported: list[str] = []
    side = VehicleSide([plan], setup.media, lambda camera, what: reported.append(what))
    try:
        yield side, plan, reported
    finally:
        side.stop()


def kbps(side, frames=20):
    """The encoder's output bitrate at 15 Hz."""
    before = side.read()["rear"].encoded
    after = until(lambda: (sent := side.read()["rear"].encoded).frames >= before.frames + frames and sent)
    return 8 * (after.bytes - before.bytes) / 1000 / ((after.frames - before.frames) / 15)


def test_a_property_that_may_change_though_the_element_does_not_declare_it(conf):
    conf.write("graph/vp8.yaml", GRAPH + MUTABLE)
    with sending(conf.path) as (side, plan, reported):
        side.turn([Command("rear", knob, value) for knob, value in {"size": (424, 240), "bitrate": 1500}.items()])
        with watching(plan) as client:
            until(lambda: len(client.sizes) > 15)
            high = kbps(side)
            side.turn([Command("rear", "bitrate", 300)])
            until(lambda: side.read()["rear"].applied["bitrate"] == 300)
            kbps(side)  # the rate control settles
            low = kbps(side)
            side.turn([Command("rear", "bitrate", 1500)])
            kbps(side)
            again = kbps(side)
            assert client.errors == []
            assert not rejected(reported)
    assert low < 1.3 * 300
    assert high > 2 * low
    assert again > 2 * low


@pytest.mark.parametrize(
    ("declared", "problem"),
    [
        ("", "vp8enc does not declare target-bitrate as mutable while playing; if it is, list it under mutable"),
        (MUTABLE.replace("target-bitrate", "deadline"), "mutable[0]: 'encoder.deadline': no knob sets this property"),
    ],
)
def test_an_undeclared_property_is_refused(conf, declared, problem):
    from runner.apply import check_plan

    conf.write("graph/vp8.yaml", GRAPH + declared)
    with pytest.raises(ConfigError) as raised:
        configuration(WORDS, conf.path, check=check_plan).setup()
    assert problem in str(raised.value)
