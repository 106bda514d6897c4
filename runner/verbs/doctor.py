"""usage: tod-runner doctor [OVERRIDE ...]

What this machine lacks for what the configuration asks for, and what brings it: Python packages, GStreamer and its
bindings, elements, broker, free ports, cores. Ends with status 1 where something is missing.

  tod-runner doctor
  tod-runner doctor vehicle=delivery_robot graph=h264_va_rtsp
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from importlib.util import find_spec
from typing import NamedTuple

from runner.broker import find_mosquitto
from runner.config import load
from runner.errors import RunError
from runner.model import Vehicle
from runner.ports import check_port_free
from runner.sources import compile_plans
from runner.verbs import EXTRAS, Arguments

TYPELIBS = {  # Debian package by typelib
    "Gst": "gir1.2-gstreamer-1.0",
    "GstRtp": "gir1.2-gst-plugins-base-1.0",
    "GstRtsp": "gir1.2-gst-plugins-base-1.0",
    "GstRtspServer": "gir1.2-gst-rtsp-server-1.0",
}
CORE_MPX_S = 180  # what one core crops, scales and encodes in a second at factor 0.5, measured with h264_rtsp


class Finding(NamedTuple):
    """One thing looked at."""

    fine: bool
    what: str


def run(arguments: Arguments) -> int:
    vehicle = load(arguments.overrides, arguments.conf, runnable=False)
    findings = list(examine(vehicle))
    for fine, what in findings:
        print(f"{'ok     ' if fine else 'MISSING'} {what}")
    return 0 if all(fine for fine, _ in findings) else 1


def examine(vehicle: Vehicle) -> Iterator[Finding]:
    """Everything that the live verbs need."""
    for module, extra in EXTRAS.items():
        there = _importable(module)
        yield Finding(there, f"Python module {module}" + ("" if there else f": pip install 'tod-runner[{extra}]'"))
    bindings = list(_bindings())
    yield from bindings
    if all(finding.fine for finding in bindings):
        yield from _elements(vehicle)
    try:
        yield Finding(True, f"MQTT broker {find_mosquitto()}, for the demo")
    except RunError as error:
        yield Finding(False, str(error))
    yield from _ports(vehicle)
    yield _cores(vehicle)


def _importable(module: str) -> bool:
    return find_spec(module) is not None


def _bindings() -> Iterator[Finding]:
    if not _importable("gi"):
        yield Finding(False, "Python module gi: apt-get install python3-gi, and a virtual environment that sees it")
        return
    import gi

    for name, package in TYPELIBS.items():
        try:
            gi.require_version(name, "1.0")
        except ValueError:
            yield Finding(False, f"typelib {name}: apt-get install {package}")
        else:
            yield Finding(True, f"typelib {name}")


def _elements(vehicle: Vehicle) -> Iterator[Finding]:
    from runner.apply import missing_plugins, missing_recorders

    plans = compile_plans(vehicle)
    lines = [line for plan in plans for line in (plan.source, plan.vehicle, plan.operator, plan.recorder)]
    names = {element.factory for line in lines for element in line}
    missing = dict.fromkeys(s for plan in plans for s in (*missing_plugins(plan), *missing_recorders(plan)))
    yield from (Finding(False, sentence) for sentence in missing)
    if not missing:
        yield Finding(True, f"{len(names)} GStreamer elements")


def _ports(vehicle: Vehicle) -> Iterator[Finding]:
    ports = {"media.port": vehicle.media, "control.port": vehicle.control}
    if vehicle.page.serve:
        ports["page.port"] = vehicle.page.endpoint
    for key, endpoint in ports.items():
        try:
            check_port_free(endpoint)
        except RunError as error:
            yield Finding(False, f"{key}: {error}")
        else:
            yield Finding(True, f"{key}: {endpoint.host}:{endpoint.port} is free")


def _cores(vehicle: Vehicle) -> Finding:
    """Whether the cores carry all cameras at full rate, as an estimate; never called missing."""
    load_mpx = sum(float(camera.fps) * camera.width * camera.height for camera in vehicle.cameras.values()) / 1e6
    cores = os.cpu_count() or 1
    need = load_mpx / CORE_MPX_S
    return Finding(True, f"{cores} cores; sending all cameras takes about {need:.1f} of them, receiving comes on top")
