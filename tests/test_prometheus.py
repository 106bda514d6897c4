"""Metrics for Prometheus: those of every record, under valid names, and health; the rules of deploy/prometheus."""

from __future__ import annotations

import re
import shutil
import socket
import struct
import subprocess
import sys
import urllib.error
import urllib.request
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
import yaml

from rig import CHECKOUT, free_port
from runner.core.decision import Believed, Setting
from runner.core.events import LinkState
from runner.core.model import Mode, Roi
from runner.errors import RunError
from runner.metrics.side import SideMetrics
from runner.mqtt.link import ControlLink
from runner.records.decisions import UplinkDecision
from runner.records.vehicle import (
    CameraReading,
    CameraState,
    CameraTelemetry,
    Telemetry,
    UplinkMeasured,
    UplinkTelemetry,
    VehicleState,
)
from runner.settings import Endpoint

pytest.importorskip("prometheus_client")

CAMERA = CameraTelemetry(applied={}, frames=10, bytes=2000, encode_ms=4.0)
BELIEVED = Believed(2431, 0.1, 0.05, bias=-0.2, error=0.1, gain=None, policer_kbps=None)
READING = CameraReading()
TELEMETRY = Telemetry(1.0, None, None, {"front": CAMERA, "rear": CAMERA}, refused=3)


def fetch(port: int, path: str, host: str = "") -> tuple[int, str]:
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers={"Host": host} if host else {})
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def test_a_side_serves_its_figures_and_its_health() -> None:
    port, problems = free_port(), list[str]()
    figures = SideMetrics("car", port)
    figures.serve(lambda: problems[-1] if problems else None)
    try:
        figures.take(TELEMETRY)
        figures.take(VehicleState(1.0, "", Mode.AUTOMATIC, 2000, 2000, {}, believed=BELIEVED))
        figures.show_online(True)
        status, text = fetch(port, "/metrics")
        assert status == 200
        assert 'tod_camera_encoded_frames_total{camera="front",vehicle="car"} 10.0' in text
        assert 'tod_camera_encode_seconds{camera="rear",vehicle="car"} 0.004' in text
        assert 'tod_refused_requests_total{vehicle="car"} 3.0' in text
        assert 'tod_vehicle_online{vehicle="car"} 1.0' in text
        assert 'tod_prediction_bias{vehicle="car"} -0.2' in text
        assert "tod_predicted_kbps{" not in text  # unknown
        assert "tod_prediction_gain{" not in text
        assert "tod_uplink" not in text
        assert fetch(port, "/health") == (200, "ok\n")
        assert 'tod_healthy{vehicle="car"} 1.0' in text
        problems.append("the control loop hangs in a rule")
        assert fetch(port, "/health") == (503, "the control loop hangs in a rule\n")
        assert 'tod_healthy{vehicle="car"} 0.0' in fetch(port, "/metrics")[1]
        assert fetch(port, "/") == (404, "expected /metrics or /health\n")
    finally:
        figures.close()
    with pytest.raises(urllib.error.URLError):
        fetch(port, "/health")


def test_each_of_several_uplinks_has_figures() -> None:
    pytest.importorskip("prometheus_client")
    from prometheus_client import CollectorRegistry, generate_latest

    from runner.metrics.prometheus import Metrics

    metrics, registry = Metrics("car"), CollectorRegistry(auto_describe=False)
    registry.register(metrics)
    setting = Setting(True, True, 900, 900, 900, Fraction(1), Roi(0, 0, 640, 480), 640, 480, "", ("a", "b"))
    decided = {"a": UplinkDecision(1500, False, ""), "b": UplinkDecision(300, True, "")}
    state = VehicleState(1.0, "", Mode.AUTOMATIC, 1800, 1800, {"front": CameraState.at(setting, 1, "front", READING)})
    metrics.take(replace(state, uplinks=decided))
    measured = UplinkMeasured(1480.5, 12.0, 0.01, LinkState.CLEAR, 30.0)
    metrics.take(replace(TELEMETRY, uplinks={"a": UplinkTelemetry(("10.0.0.1",), measured), "b": UplinkTelemetry(())}))
    found = dict(line.rsplit(" ", 1) for line in generate_latest(registry).decode().splitlines() if "uplink=" in line)
    assert found == {
        'tod_uplink_allowed_kbps{uplink="a",vehicle="car"}': "1500.0",
        'tod_uplink_allowed_kbps{uplink="b",vehicle="car"}': "300.0",
        'tod_uplink_stalled{uplink="a",vehicle="car"}': "0.0",
        'tod_uplink_stalled{uplink="b",vehicle="car"}': "1.0",
        'tod_uplink_cameras{uplink="a",vehicle="car"}': "1.0",
        'tod_uplink_cameras{uplink="b",vehicle="car"}': "1.0",
        'tod_uplink_received_kbps{uplink="a",vehicle="car"}': "1480.5",
        'tod_uplink_queue_seconds{uplink="a",vehicle="car"}': "0.012",
        'tod_uplink_loss{uplink="a",vehicle="car"}': "0.01",
    }


def test_another_host_name_is_refused() -> None:
    """A website that resolves its own name to this machine could otherwise read them in a browser."""
    port = free_port()
    figures = SideMetrics("car", port)
    figures.serve(lambda: None)
    try:
        for path in ("/metrics", "/health"):
            for host in ("example.org", f"example.org:{port}", "127.0.0.1.example.org"):
                assert fetch(port, path, host)[0] == 403
            for host in ("127.0.0.1", f"localhost:{port}", "LOCALHOST"):
                assert fetch(port, path, host)[0] == 200
    finally:
        figures.close()


def test_a_client_that_is_silent_or_breaks_off_leaves_no_traceback(capfd: pytest.CaptureFixture[str]) -> None:
    port = free_port()
    figures = SideMetrics("car", port)
    figures.serve(lambda: None)
    try:
        with socket.create_connection(("127.0.0.1", port), 60) as silent:
            assert silent.recv(1) == b""
        with socket.create_connection(("127.0.0.1", port), 60) as broken:
            broken.sendall(b"GET /health")
            broken.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # it is reset
        assert fetch(port, "/health")[0] == 200
    finally:
        figures.close()
    assert capfd.readouterr().err == ""


def test_without_a_port_nothing_is_served_and_nothing_is_loaded() -> None:
    figures = SideMetrics("car", None)
    figures.take(TELEMETRY)
    figures.show_online(False)
    figures.serve(lambda: None)
    figures.close()


def test_a_port_in_use_is_named() -> None:
    port = free_port()
    first, second = SideMetrics("car", port), SideMetrics("car", port)
    first.serve(lambda: None)
    try:
        with pytest.raises(RunError, match=rf"cannot listen on {Endpoint('127.0.0.1', port)}"):
            second.serve(lambda: None)
    finally:
        first.close()


def test_every_figure_has_a_valid_name_of_its_own() -> None:
    from runner.metrics.prometheus import METRICS

    names: list[Any] = [metric.name for parts in METRICS.values() for part in parts for metric in part]
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(r"[a-z][a-z_]*", name) for name in names)


def test_the_control_link_and_its_certificates_have_metrics():
    from runner.metrics.prometheus import Metrics

    metrics = Metrics("car")
    metrics.link = ControlLink(Endpoint("127.0.0.1", 1), None, {}, lambda here: None, print)
    (connected,) = metrics.collect()  # without keys no certificate
    assert (connected.name, connected.samples[0].value) == ("tod_control_connected", 0.0)
    metrics.link.certificate_ends = lambda: {"own": 1.8e9}
    _, ends = metrics.collect()
    assert (ends.name, ends.samples[0].labels["whose"], ends.samples[0].value) == (
        "tod_certificate_expiry_timestamp_seconds",
        "own",
        1.8e9,
    )


def test_free_space_is_that_of_the_disk_of_the_log(tmp_path):
    from runner.metrics.prometheus import Metrics

    def free(log):
        return {metric.name: metric.samples[0].value for metric in Metrics("car", log).collect()}

    assert free(None) == {}
    disk = shutil.disk_usage(tmp_path)
    assert free(tmp_path)["tod_log_free_bytes"] == pytest.approx(disk.free, abs=0.01 * disk.total)
    assert free(tmp_path / "removed") == {"tod_log_free_bytes": 0.0}


def test_alerts_are_evaluated_often_enough_and_use_nothing_but_figures_of_the_sides():
    """Names are checked against those of a drive in test_metrics_sides.py."""
    rules = yaml.safe_load((CHECKOUT / "deploy/prometheus/alerts.yml").read_text())
    scrape = yaml.safe_load((CHECKOUT / "deploy/prometheus/scrape.yml").read_text())
    (every,) = {job["scrape_interval"] for job in scrape["scrape_configs"]}
    for group in rules["groups"]:
        assert group["interval"] == every == "1s"
        for rule in group["rules"]:
            names = re.findall(r"\b[a-z]+_[a-z_]+\b", rule["expr"])
            assert names
            assert all(name.startswith("tod_") for name in names), rule


def test_each_alert_fires_when_it_should():
    command = [Path(sys.executable).with_name("promtool"), "test", "rules", CHECKOUT / "tests/alerts_test.yml"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
