"""When cameras that do not open are tried again."""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from runner.errors import RunError
from runner.gst.lost import LostCameras

pytestmark = pytest.mark.gst  # the package runner.gst loads it


@contextmanager
def lost_cameras(problem, on_found, *names):
    plans = [SimpleNamespace(name=name, camera=SimpleNamespace(name=name)) for name in names]
    cameras = LostCameras(plans, dict.fromkeys(names, "missing"), lambda plan: problem(plan.camera.name), on_found)
    try:
        yield cameras
    finally:
        cameras.stop()


def await_true(done):
    until = time.monotonic() + 5
    while not done():
        assert time.monotonic() < until
        time.sleep(0.01)


@pytest.fixture(autouse=True)
def at_once(monkeypatch):
    monkeypatch.setattr("runner.gst.lost.BACKOFF_S", (0.05, 0.05))
    monkeypatch.setattr("runner.gst.lost.POLL_S", 0.01)


@pytest.mark.parametrize(
    ("error", "reason"), [(RunError("GStreamer hangs"), "GStreamer hangs"), (TypeError("odd"), "TypeError: odd")]
)
def test_a_camera_that_is_found_but_does_not_start_is_still_lost_and_tried_again(error, reason):
    errors, started = [error], []

    def start(name):
        if errors and gate.wait(5):
            raise errors.pop()
        started.append(name)

    gate = threading.Event()
    with lost_cameras(lambda _: None, start, "front") as cameras:
        assert cameras.reasons() == {"front": "missing"}
        seen = []
        gate.set()
        await_true(lambda: seen.append(cameras.reasons().get("front")) or started)
        assert reason in seen
        await_true(lambda: not cameras.reasons())
    assert started == ["front"]


def test_a_source_that_hangs_does_not_hold_up_the_others(monkeypatch):
    monkeypatch.setattr("runner.gst.aside.HUNG_S", 0.1)
    hung, found = threading.Event(), []

    def problem(name):
        if name == "front":
            hung.wait(10)

    with lost_cameras(problem, found.append, "front", "rear") as cameras:
        await_true(lambda: found == ["rear"])
        await_true(lambda: cameras.reasons() == {"front": "its source did not start within 5 s"})
        hung.set()
        await_true(lambda: found == ["rear", "front"])
