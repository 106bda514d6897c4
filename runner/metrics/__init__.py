"""Figures of a running side, served if the configuration names a port."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from runner.metrics.prometheus import Metrics

Healthy = Callable[[], str | None]  # why the side does not work; None: it does


class Figures:
    """Takes a side's records, and serves figures of them. From any thread.

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

    def serve(self, healthy: Healthy) -> None:
        """raises RunError if the port is in use"""
        if self._metrics and self._port:
            from runner.metrics.prometheus import served

            self._open.enter_context(served(self._metrics, self._port, healthy))

    def close(self) -> None:
        self._open.close()


def metrics_of(vehicle: str, port: int | None) -> Figures:
    """The figures of a side.

    vehicle  name of the vehicle
    port     TCP port on 127.0.0.1; None: nothing is served
    """
    if port is None:
        return Figures(None, None)
    from runner.metrics.prometheus import Metrics

    return Figures(Metrics(vehicle), port)
