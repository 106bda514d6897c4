"""Metrics for Prometheus: those of every record, under valid names, and health."""

from __future__ import annotations

import re
import urllib.error
import urllib.request
from typing import Any

import pytest

from rig import free_port
from runner.core.model import Endpoint
from runner.errors import RunError
from runner.metrics.side import metrics_of
from runner.records import CameraTelemetry, Telemetry

pytest.importorskip("prometheus_client")

CAMERA = CameraTelemetry(applied={}, frames=10, bytes=2000, encode_ms=4.0)
TELEMETRY = Telemetry(1.0, None, None, {"front": CAMERA, "rear": CAMERA}, refused=3)


def fetch(port: int, path: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=5) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def test_a_side_serves_its_figures_and_its_health() -> None:
    port, problems = free_port(), list[str]()
    figures = metrics_of("car", port)
    figures.serve(lambda: problems[-1] if problems else None)
    try:
        figures.take(TELEMETRY)
        figures.show_online(True)
        status, text = fetch(port, "/metrics")
        assert status == 200
        assert 'tod_camera_encoded_frames_total{camera="front",vehicle="car"} 10.0' in text
        assert 'tod_camera_encode_seconds{camera="rear",vehicle="car"} 0.004' in text
        assert 'tod_refused_requests_total{vehicle="car"} 3.0' in text
        assert 'tod_vehicle_online{vehicle="car"} 1.0' in text
        assert "tod_predicted_kbps{" not in text  # unknown
        assert fetch(port, "/health") == (200, "ok\n")
        problems.append("the control loop hangs in a rule")
        assert fetch(port, "/health") == (503, "the control loop hangs in a rule\n")
        assert fetch(port, "/") == (404, "expected /metrics or /health\n")
    finally:
        figures.close()
    with pytest.raises(urllib.error.URLError):
        fetch(port, "/health")


def test_without_a_port_nothing_is_served_and_nothing_is_loaded() -> None:
    figures = metrics_of("car", None)
    figures.take(TELEMETRY)
    figures.show_online(False)
    figures.serve(lambda: None)
    figures.close()


def test_a_port_in_use_is_named() -> None:
    port = free_port()
    first, second = metrics_of("car", port), metrics_of("car", port)
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


def test_a_vehicle_whose_state_never_arrived_is_offline():
    """Otherwise no alert could name it."""
    from runner.metrics.prometheus import Metrics
    from runner.metrics.side import SideMetrics
    from runner.operator.live import _MetricsListener

    metrics = Metrics("car")
    _MetricsListener(SideMetrics(metrics, None))
    (online,) = metrics.collect()
    assert (online.name, [sample.value for sample in online.samples]) == ("tod_vehicle_online", [0.0])
