"""Cost of a frame and of a change, as counts that do not depend on the machine."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from contextlib import ExitStack
from weakref import WeakKeyDictionary

import pytest

from rig import CHECKOUT, SMALL_ROBOT, free_port, until
from runner.apply import OperatorSide, VehicleSide, check_plan
from runner.configuration.config import configuration
from runner.core.commands import Command
from runner.gst import Gst
from runner.gst.probes import BufferProbe
from runner.plans import compile_plans

pytestmark = pytest.mark.gst
ROBOT = (*SMALL_ROBOT, "source=test", "fps_max=15")
FRAMES = 30
BUFFERS = Gst.PadProbeType.BUFFER | Gst.PadProbeType.BUFFER_LIST


@pytest.fixture
def calls(monkeypatch):
    """How often each probe of buffers was called."""
    counted, names = Counter(), WeakKeyDictionary()
    add_probe, make, handle = Gst.Pad.add_probe, BufferProbe.__init__, BufferProbe.handle

    def add_counted(pad, mask, callback, *data):
        def on_buffer(*words):
            if words[1].type & BUFFERS:
                counted[callback.__qualname__] += 1
            return callback(*words)

        return add_probe(pad, mask, on_buffer, *data)

    def make_named(probe, pad, on_buffer, **options):
        names[probe] = on_buffer.__qualname__
        make(probe, pad, on_buffer, **options)

    def handle_counted(probe, address):
        counted[names[probe]] += 1
        return handle(probe, address)

    monkeypatch.setattr(Gst.Pad, "add_probe", add_counted)
    monkeypatch.setattr(BufferProbe, "__init__", make_named)
    monkeypatch.setattr(BufferProbe, "handle", handle_counted)
    return counted


@pytest.fixture
def writes(monkeypatch):
    """The properties that were set, in order."""
    written, set_property = [], Gst.Element.set_property

    def set_counted(element, key, value):
        written.append(f"{element.get_name()}.{key}")
        set_property(element, key, value)

    monkeypatch.setattr(Gst.Element, "set_property", set_counted)
    return written


@pytest.fixture
def streaming():
    """The vehicle's side with a viewer, playing, and the vehicle."""
    setup = configuration([*ROBOT, f"media.port={free_port()}"], check=check_plan).setup()
    plans = compile_plans(setup)
    with ExitStack() as stack:
        side = VehicleSide(plans, setup.media, lambda *_: None)
        stack.callback(side.stop)
        side.turn(Command(name, "bitrate", 500) for name in setup.vehicle.cameras)
        viewer = OperatorSide(plans, lambda *_: None)
        stack.callback(viewer.stop)
        until(lambda: all(each.frames > FRAMES for each in viewer.sample({}).values()))
        yield side, setup.vehicle


def test_a_frame_costs_no_call_into_python_on_the_vehicle(calls, streaming):
    side, _ = streaming
    # The operator's side, also in this process, inspects each arriving frame and packet.
    viewing = {name for name in calls if name.startswith(("Receiver", "RepairBuffer"))}
    assert viewing
    before, sent = Counter(calls), side.read()
    until(lambda: all(now.encoded.frames > sent[name].encoded.frames + FRAMES for name, now in side.read().items()))
    during = calls - before
    assert {name: count for name, count in during.items() if name not in viewing} == {}
    assert sum(during.values()) > FRAMES  # the counters work


def test_a_change_sets_only_what_differs(streaming, writes):
    side, vehicle = streaming

    def turned(knob, value):
        """A single property is set immediately, by the thread that turns the knob."""
        writes.clear()
        side.turn(Command(name, knob, value) for name in vehicle.cameras)
        until(lambda: all(camera.applied.get(knob) == value for camera in side.read().values()))
        return Counter(key for key in writes if key.partition(".")[0] in own)

    # A viewer's jitter buffers are set as well, whenever the library adds one.
    own = {element.name for camera in vehicle.cameras.values() for element in camera.graph.vehicle}
    cameras = len(vehicle.cameras)
    assert turned("bitrate", 540) == {"encoder.bitrate": cameras}
    assert turned("bitrate", 540) == {}
    assert turned("size", (320, 180)) == {"size.caps": cameras}
    assert turned("size", (320, 180)) == {}


@pytest.mark.parametrize(
    ("check", "loads"),
    [("check_vehicle", "libgstx264"), ("check_operator", "libgstlibav")],
    ids=["vehicle", "operator"],
)
def test_a_side_loads_the_plugins_of_its_own_part_only(check, loads):
    """Codecs are the largest: tens of MB each."""
    code = f"""
from runner import apply
from runner.configuration.config import configuration
configuration({ROBOT!r}, check=apply.{check}).setup()
mapped = open("/proc/self/maps").read()
print([name for name in ("libgstx264", "libgstlibav") if name in mapped])
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=CHECKOUT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == repr([loads])
