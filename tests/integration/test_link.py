"""Limited links between real sides: what comes through, what does not, and that nothing stays behind."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from rig import CHECKOUT, free_port, process, until
from runner.broker import private_broker
from runner.config import load
from runner.errors import RunError
from runner.link import Limit, limited_link
from runner.link.netns import _check_allowed
from runner.model import Endpoint
from runner.sources import compile_plans

NOISE = "{name: source, element: videotestsrc, properties: {is-live: true, pattern: snow}}"
RAW = "{name: raw, element: capsfilter, properties: {caps: '{raw_caps}'}}"
ROBOT = ("vehicle=delivery_robot", "~cameras.front", "~cameras.mast", "fps_max=15", "page.serve=false", "pqos=constant")
SOURCE = ("source=test", f"source.elements=[{NOISE}, {RAW}]")  # the encoder needs what it is allowed
SETTLE_S, MEASURE_S = 2.0, 4.0


def _may_not() -> str:
    try:
        _check_allowed()
    except RunError as error:
        return str(error)
    return "" if shutil.which("ip") else "iproute2 is not installed"


KINDS = [pytest.param("netns", marks=pytest.mark.skipif(bool(_may_not()), reason=_may_not())), "relay"]


class Drive:
    """Both sides with a link between them; `lines` is its log."""

    def __init__(self, link, lines, side, vehicle):
        self.link, self.lines, self.side, self.vehicle = link, lines, side, vehicle

    def received(self):
        return self.side.sample({})["rear"]

    def measure(self, seconds=MEASURE_S):
        """First and last line of the log, and frames that came, of a stretch of the drive."""
        begun, first = self.received().frames, len(self.lines) - 1
        until(lambda: self.lines[-1]["t"] >= self.lines[first]["t"] + seconds)
        return self.lines[first], self.lines[-1], self.received().frames - begun

    def kbps(self, seconds=MEASURE_S):
        """What the link passed on."""
        first, last, _ = self.measure(seconds)
        return 8 * (last["bytes"] - first["bytes"]) / 1000 / (last["t"] - first["t"])

    def settle(self):
        """Until the queue is as the rate makes it."""
        self.measure(SETTLE_S)


@contextmanager
def driving(kind, kbps_at, sent_kbps, tcp=False, queue_ms=200, delay_ms=0):
    """One camera that sends as much as it is let, through a link, to a receiver."""
    from runner.apply import OperatorSide

    lines = []
    limit = Limit(kbps_at, queue_ms, delay_ms)
    media, control = (Endpoint("127.0.0.1", free_port()) for _ in range(2))
    words = (*ROBOT, *SOURCE, f"pqos.kbps={sent_kbps}")
    with (
        limited_link(kind, limit, media, control, lines.append) as link,
        private_broker(link.broker),
        process("vehicle", *words, *link.vehicle_overrides, before=link.vehicle_command) as vehicle,
    ):
        plans = compile_plans(load([*words, *link.operator_overrides]))
        side = OperatorSide([_over_tcp(plan) if tcp else plan for plan in plans], lambda *_: None)
        try:
            drive = Drive(link, lines, side, vehicle)
            until(lambda: drive.received().decoded > 5, seconds=30)
            link.start(time.time())
            until(lambda: lines)
            yield drive
            link.check()
        finally:
            side.stop()


def _over_tcp(plan):
    client, *rest = plan.operator
    return replace(plan, operator=(replace(client, properties={**client.properties, "protocols": "tcp"}), *rest))


@pytest.mark.parametrize("kind", KINDS)
def test_a_wide_link_passes_everything(kind):
    with driving(kind, lambda t: 5000, sent_kbps=1000) as drive:
        drive.settle()
        first, last, frames = drive.measure()
        lost = drive.received().lost
    assert frames > 2 * MEASURE_S  # of 15 a second
    assert last["packets"] > first["packets"]
    assert (last["dropped"], lost) == (0, 0)
    assert [line["kbps"] for line in drive.lines] == [5000] * len(drive.lines)
    assert [line["t"] for line in drive.lines] == sorted(line["t"] for line in drive.lines)
