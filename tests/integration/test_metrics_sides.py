"""Metrics of both sides for Prometheus during a drive."""

from __future__ import annotations

import re
import urllib.request

import pytest

from rig import CHECKOUT, ROBOT, free_port, process, until

CAMERAS = ("front", "rear", "mast")

parser = pytest.importorskip("prometheus_client.parser")


def scraped(port):
    """Values by metric and camera, "" for one of the whole vehicle."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5) as answer:
        families = parser.text_string_to_metric_families(answer.read().decode())
        return {(each.name, each.labels.get("camera", "")): each.value for f in families for each in f.samples}


def passes(port):
    try:
        return scraped(port)
    except OSError:
        return {}


def complete(figures):
    """Figures that include the latency of each camera; None otherwise."""
    received = [figures.get(("tod_camera_received_frames_total", camera), 0) for camera in CAMERAS]
    measured = all(("tod_camera_latency_seconds", camera) in figures for camera in CAMERAS)
    return figures if measured and min(received) > 20 and figures["tod_vehicle_online", ""] else None


def test_a_vehicle_whose_state_never_arrived_is_offline():
    """Otherwise no alert could name it."""
    port = free_port()
    words = (f"media.port={free_port()}", f"control.port={free_port()}", f"metrics.operator_port={port}")
    with process("operator", *ROBOT, *words):
        assert until(lambda: passes(port), every_s=0.2)["tod_vehicle_online", ""] == 0


def test_both_sides_serve_figures_of_a_drive(tmp_path):
    vehicle, operator = free_port(), free_port()
    ports = (f"media.port={free_port()}", f"control.port={free_port()}", f"metrics.vehicle_port={vehicle}")
    ports += (f"metrics.operator_port={operator}", f"log={tmp_path / 'drive'}")
    with process("demo", *ROBOT, *ports, "duration_s=600"):
        seen = until(lambda: complete(passes(operator)), every_s=0.2)
        sent = until(lambda: passes(vehicle), every_s=0.2)
    assert seen["tod_vehicle_online", ""] == seen["tod_healthy", ""] == sent["tod_healthy", ""] == 1
    assert seen["tod_control_connected", ""] == sent["tod_control_connected", ""] == 1
    assert seen["tod_log_free_bytes", ""] > 0
    assert sent["tod_log_free_bytes", ""] > 0
    assert sent["tod_decided_kbps", ""] == sent["tod_predicted_kbps", ""] == 3000
    for camera in CAMERAS:
        assert sent["tod_camera_sending", camera] == 1
        assert sent["tod_camera_encoded_frames_total", camera] >= seen["tod_camera_received_frames_total", camera] - 15
        assert 0 < seen["tod_camera_latency_seconds", camera] < 10
    # What alerts and dashboard mention exists.
    texts = [
        path.read_text()
        for path in (CHECKOUT / "deploy").glob("*/*")
        if path.is_file() and path.parent.name != "systemd"
    ]
    mentioned = {name for text in texts for name in re.findall(r"\btod_[a-z_]+", text)}
    assert len(mentioned) > 10
    mentioned -= {"tod_certificate_expiry_timestamp_seconds"}  # with keys
    mentioned = {name for name in mentioned if not name.startswith("tod_uplink_")}  # with several uplinks
    assert mentioned <= {name for name, _ in (*seen, *sent)}
