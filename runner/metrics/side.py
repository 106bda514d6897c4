"""The metrics of a running side, or nothing if the configuration names no port."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from runner.metrics.prometheus import Healthy, Link, Metrics


class SideMetrics:
    """Takes a side's records and serves their metrics. May be used from any thread.

    metrics, port  None: nothing is served, and records are ignored
    """

    def __init__(self, metrics: Metrics | None, port: int | None) -> None:
        self._metrics, self._port = metrics, port
        self._open = ExitStack()

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


def metrics_of(vehicle: str, port: int | None, log: Path | None = None) -> SideMetrics:
    """The metrics of a side.

    vehicle  name of the vehicle
    port     TCP port on 127.0.0.1; None: nothing is served
    log      directory that the drive is logged to; None: it is not logged
    """
    if port is None:
        return SideMetrics(None, None)
    from runner.metrics.prometheus import Metrics

    return SideMetrics(Metrics(vehicle, log), port)
