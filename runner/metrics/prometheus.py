"""Metrics of a running side for Prometheus, and its health, over HTTP on loopback.

/metrics  the newest values, in Prometheus's text format
/health   200 while the side works; 503 with the reason otherwise
"""

from __future__ import annotations

import shutil
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol
from wsgiref.simple_server import WSGIRequestHandler, make_server

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import ThreadingWSGIServer
from prometheus_client.registry import Collector

from runner.records.operator import Sample
from runner.records.vehicle import Telemetry, VehicleState
from runner.settings import Endpoint
from runner.system.ports import check_port_free

STOP_S = 1.0
HOSTS = ("127.0.0.1", "localhost")


class Link(Protocol):
    """A side's control link."""

    @property
    def is_connected(self) -> bool: ...

    def certificate_ends(self) -> Mapping[str, float]:
        """By whose certificate it is, the time until which it is valid, s since 1970."""


Healthy = Callable[[], str | None]  # why the side does not work; None: it does
Reading = Callable[[Any], float | None]  # of a record, or of its entry for a camera; None: unknown, left out


class _Metric(NamedTuple):
    """A metric: its name without prefix, its help text, and its value."""

    name: str
    help: str
    value: Reading


def _ms(value: float | None) -> float | None:
    return None if value is None else value / 1000


def _believed(key: str) -> Reading:
    """Of a vehicle's state, a value of what it believes of the uplink; None: nothing is believed, or it is unknown."""
    return lambda state: getattr(state.believed, key, None)


class _Uplink(NamedTuple):
    """One of several uplinks: its entry in a record, and the record."""

    name: str
    own: Any
    record: Any


def _cameras_on(uplink: _Uplink) -> int:
    return sum(uplink.name in (camera.uplinks or ()) for camera in uplink.record.cameras.values())


# By record, metrics of the whole vehicle, of each camera, and of each of several uplinks. A name that ends in _total is
# a counter.
METRICS: dict[type, tuple[tuple[_Metric, ...], tuple[_Metric, ...], tuple[_Metric, ...]]] = {
    VehicleState: (
        (
            _Metric("decided_kbps", "Total bitrate of all cameras", lambda s: s.total_kbps),
            _Metric("asked_kbps", "Total given by prediction or operator", lambda s: s.asked_kbps),
            _Metric("rules_failing", "1 while the rules cannot decide", lambda s: s.fault is not None),
            _Metric("believed_kbps", "Capacity that the uplink is believed to have", _believed("kbps")),
            _Metric("believed_margin", "By how much less is sent, as a difference of ln", _believed("margin")),
            _Metric("policer_kbps", "Rate above which the uplink drops packets", _believed("policer_kbps")),
            _Metric("prediction_bias", "Mean of ln(capacity / prediction) of the last seconds", _believed("bias")),
            _Metric("prediction_error", "Standard deviation of ln(capacity / prediction)", _believed("error")),
            _Metric("prediction_gain", "Share of a prediction's change that comes true", _believed("gain")),
        ),
        (
            _Metric("camera_decided_kbps", "Bitrate of the encoder", lambda c: c.kbps),
            _Metric("camera_scaling", "Scaling factor", lambda c: c.scaling),
            _Metric("camera_sending", "1 while the camera should be sent", lambda c: c.sending),
            _Metric("camera_source_failing", "1 while the source has failed", lambda c: c.fault is not None),
        ),
        (
            _Metric("uplink_allowed_kbps", "Bitrate that an uplink is to carry", lambda u: u.own.total_kbps),
            _Metric("uplink_stalled", "1 while nothing arrives over an uplink", lambda u: u.own.stalled),
            _Metric("uplink_cameras", "Cameras that an uplink carries, copies included", _cameras_on),
        ),
    ),
    Telemetry: (
        (
            _Metric("predicted_kbps", "Newest prediction of the bitrate", lambda t: t.predicted_kbps),
            _Metric("refused_requests_total", "Requests refused", lambda t: t.refused),
            _Metric("loop_errors_total", "Exceptions that the control loop survived", lambda t: t.errors),
            _Metric("speed_factor", "Advised share of full speed", lambda t: t.speed_factor),
        ),
        (
            _Metric("camera_encoded_frames_total", "Frames that the encoder has output", lambda c: c.frames),
            _Metric("camera_encoded_bytes_total", "Bytes that the encoder has output", lambda c: c.bytes),
            _Metric("camera_encode_seconds", "Time in the encoder", lambda c: _ms(c.encode_ms)),
        ),
        (
            _Metric("uplink_received_kbps", "Received over an uplink, with packet headers", lambda u: u.own.kbps),
            _Metric("uplink_queue_seconds", "Standing queue in front of an uplink", lambda u: _ms(u.own.queue_ms)),
            _Metric("uplink_loss", "Share of packets that an uplink has lost", lambda u: u.own.loss),
        ),
    ),
    Sample: (
        (
            _Metric("received_kbps", "Received of all cameras", lambda s: s.actual_kbps),
            _Metric("clock_bound_seconds", "Bound of the clocks' difference", lambda s: _ms(s.clock_bound_ms)),
            _Metric("invalid_messages_total", "Invalid messages on the control link", lambda s: s.dropped),
        ),
        (
            _Metric("camera_received_kbps", "Received over the last second", lambda c: c.kbps),
            _Metric("camera_received_fps", "Frames received over the last second", lambda c: c.fps),
            _Metric("camera_received_frames_total", "Frames received", lambda c: c.frames),
            _Metric("camera_lost_packets_total", "RTP packets that never arrived", lambda c: c.lost),
            _Metric("camera_damaged_frames_total", "Frames that show lost packets", lambda c: c.damaged),
            _Metric("camera_foreign_packets_total", "Packets of other senders, dropped", lambda c: c.foreign),
            _Metric("camera_rebuilds_total", "Receivers that were rebuilt", lambda c: c.rebuilt),
            _Metric("camera_latency_seconds", "Capture to decode", lambda c: _ms(c.latency_ms)),
        ),
        (),
    ),
}


class Metrics(Collector):
    """The newest record of each kind, as metrics. Records are taken from any thread.

    vehicle  its name, a label of every metric
    log      directory that the drive is logged to; None: it is not logged
    """

    def __init__(self, vehicle: str, log: Path | None = None) -> None:
        self._vehicle, self._log = vehicle, log
        self.healthy: Healthy | None = None
        self.link: Link | None = None
        self._newest: dict[type, Any] = {}
        self._online: bool | None = None

    def take(self, record: Any) -> None:
        """Keep a record if it has metrics."""
        if type(record) in METRICS:
            self._newest[type(record)] = record

    def show_online(self, online: bool) -> None:
        """Whether the vehicle is online, as the operator's side sees it."""
        self._online = online
        if not online:  # stale metrics would look as if the vehicle were still driving
            self._newest.pop(VehicleState, None)

    def collect(self) -> Iterator[Metric]:
        if self._online is not None:
            yield self._family("vehicle_online", "1 while the vehicle is online", [((), float(self._online))])
        if self._log:
            yield self._family("log_free_bytes", "Free space for the drive's log", [((), float(_free(self._log)))])
        if self.healthy:
            yield self._family("healthy", "1 while the side works", [((), float(self.healthy() is None))])
        if self.link:
            yield self._family(
                "control_connected", "1 while there is a control link", [((), float(self.link.is_connected))]
            )
            if ends := self.link.certificate_ends():
                text = "When a certificate of the control link expires, s since 1970"
                values = [((whose,), at) for whose, at in ends.items()]
                yield self._family("certificate_expiry_timestamp_seconds", text, values, ("whose",))
        for kind, record in list(self._newest.items()):
            of_all, of_camera, of_uplink = METRICS[kind]
            for metric in of_all:
                yield from self._values(metric, {(): record}, ())
            for metric in of_camera:
                yield from self._values(metric, {(name,): each for name, each in record.cameras.items()}, ("camera",))
            for metric in of_uplink:
                yield from self._values(metric, {(each.name,): each for each in _uplinks(record)}, ("uplink",))

    def _values(
        self, metric: _Metric, records: Mapping[tuple[str, ...], Any], labels: tuple[str, ...]
    ) -> Iterator[Metric]:
        values = [(own, float(value)) for own, each in records.items() if (value := metric.value(each)) is not None]
        if values:
            yield self._family(metric.name, metric.help, values, labels)

    def _family(
        self, name: str, text: str, values: Iterable[tuple[tuple[str, ...], float]], labels: tuple[str, ...] = ()
    ) -> Metric:
        family = CounterMetricFamily if name.endswith("_total") else GaugeMetricFamily
        metric = family(f"tod_{name}", text, labels=["vehicle", *labels])
        for own, value in values:
            metric.add_metric([self._vehicle, *own], value)
        return metric


def _uplinks(record: Any) -> Iterator[_Uplink]:
    """Those about which a record says something; none if the vehicle has one."""
    for name, each in (record.uplinks or {}).items():
        if own := each.measured if isinstance(record, Telemetry) else each:
            yield _Uplink(name, own, record)


def _free(directory: Path) -> int:
    """Bytes that may still be written there; 0 if it cannot be read, for example because it was removed."""
    try:
        return shutil.disk_usage(directory).free
    except OSError:
        return 0


class _Handler(WSGIRequestHandler):
    timeout = 5.0  # s: a client that sends nothing

    def log_message(self, *_: object) -> None:
        """Nothing: each scrape would be a line."""


class _Server(ThreadingWSGIServer):
    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print no traceback of a client that is silent or breaks the connection."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


@contextmanager
def served(metrics: Metrics, port: int, healthy: Healthy, link: Link | None) -> Iterator[None]:
    """Serve metrics and health on 127.0.0.1 for the duration of the block.

    raises  RunError if the port is in use
    """
    endpoint = Endpoint(HOSTS[0], port)
    check_port_free(endpoint)
    metrics.healthy, metrics.link = healthy, link
    registry = CollectorRegistry(auto_describe=False)
    registry.register(metrics)
    scrape = make_wsgi_app(registry)

    def app(environ: dict[str, Any], start: Any) -> Iterable[bytes]:
        # No website may read them through a browser on this machine, by a name of its own (DNS rebinding).
        is_own = environ.get("HTTP_HOST", "").lower().partition(":")[0] in HOSTS
        path = environ.get("PATH_INFO")
        if is_own and path == "/metrics":
            text: Iterable[bytes] = scrape(environ, start)
            return text
        why: str | None
        if not is_own:
            status, why = "403 Forbidden", f"Host must be {' or '.join(HOSTS)}"
        elif path != "/health":
            status, why = "404 Not Found", "expected /metrics or /health"
        else:
            why = healthy()
            status = "503 Service Unavailable" if why else "200 OK"
        start(status, [("Content-Type", "text/plain; charset=utf-8")])
        return [f"{why or 'ok'}\n".encode()]

    with make_server(endpoint.host, port, app, _Server, _Handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True)
        thread.start()
        try:
            yield
        finally:
            server.shutdown()
            thread.join(STOP_S)
