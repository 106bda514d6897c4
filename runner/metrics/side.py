"""The metrics of a running side, or nothing if the configuration names no port."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from runner.metrics.prometheus import Healthy, Link, Metrics


class SideMetrics:
    """Takes a side's records and serves their metrics. May be used from any thread.

    vehicle  name of the vehicle
    port     TCP port on 127.0.0.1; None: nothing is served, and records are ignored
    log      directory that the drive is logged to; None: it is not logged
    """

    def __init__(self, vehicle: str, port: int | None, log: Path | None = None) -> None:
        self._port, self._open = port, ExitStack()
        self._metrics: Metrics | None = None
        if port is not None:
            from runner.metrics.prometheus import Metrics

            self._metrics = Metrics(vehicle, log)

    def take(self, record: Any) -> None:
        if self._metrics:
            self._metrics.take(record)

    def show_online(self, online: bool) -> None:
        if self._metrics:
            self._metrics.show_online(online)

    def serve(self, healthy: Healthy, link: Link | None = None) -> None:
        """raises RunError if the port is in use"""
        if self._metrics and self._port:
            from runner.metrics.prometheus import served

            self._open.enter_context(served(self._metrics, self._port, healthy, link))

    def close(self) -> None:
        self._open.close()
