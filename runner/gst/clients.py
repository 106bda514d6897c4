"""The clients of the RTSP server: their connections, how many there may be, and who watches which camera."""

from __future__ import annotations

import resource
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING

from gi.repository import GstRtspServer

from runner.gst.connections import RtspConnection
from runner.gst.pipeline import CameraPipeline
from runner.gst.viewers import over_uplink

if TYPE_CHECKING:
    from runner.gst.sound_pipeline import SoundPipeline

CLOSE_S = 2.0  # how long connections may take to end when the server stops
# A connection and its thread take three descriptors, and some more until it has ended. Beyond this many connections the
# oldest one that watches nothing is dropped, whatever it requests: a viewer watches within a second.
DESCRIPTORS, RESERVED, LEAST, MOST = 5, 256, 16, 1000
# TLS handshakes wait in a pool of ten threads, to which GLib adds slowly. A client without a request is dropped after
# FIRST_REQUEST_S, or after CROWDED_S if there are more than CROWD of them.
FIRST_REQUEST_S, CROWD, CROWDED_S = 5.0, 8, 1.0


class Clients:
    """May be used from any thread.

    changed    guards the state that clients' threads share, that of the cameras included
    on_report  called with a camera and why its viewer was disconnected
    """

    def __init__(self, on_report: Callable[[str, str], None]) -> None:
        self.changed, self._on_report = threading.Condition(), on_report
        self.connections: dict[GstRtspServer.RTSPClient, RtspConnection] = {}
        self._is_closed = False
        self._most = min(MOST, max(LEAST, (resource.getrlimit(resource.RLIMIT_NOFILE)[0] - RESERVED) // DESCRIPTORS))

    def add(self, client: GstRtspServer.RTSPClient, connection: RtspConnection) -> None:
        with self.changed:
            others = list(self.connections.items())
            self.connections[client] = connection
            if self._is_closed:
                connection.close()
        if len(others) >= self._most:  # now: the library aborts the process without descriptors
            idle = [other for each, other in others if not (other.closed or _watches(each, other))]
            min(idle, key=lambda other: (other.opening, other.viewer.since), default=connection).close()

    def remove(self, client: GstRtspServer.RTSPClient) -> RtspConnection | None:
        """A client's connection has ended."""
        with self.changed:
            connection = self.connections.pop(client, None)
            if connection:
                connection.release()
                self.changed.notify_all()
            return connection

    def close(self) -> None:
        """End every connection in its own thread."""
        with self.changed:
            self._is_closed = True
            for connection in self.connections.values():
                connection.close()
            self.changed.notify_all()
            self.changed.wait_for(lambda: not self.connections, CLOSE_S)

    def of(self, client: GstRtspServer.RTSPClient) -> RtspConnection | None:
        with self.changed:
            return self.connections.get(client)

    def current(self) -> list[tuple[GstRtspServer.RTSPClient, RtspConnection]]:
        with self.changed:
            return list(self.connections.items())

    def watching(self, camera: str) -> list[RtspConnection]:
        with self.changed:
            return [connection for connection in self.connections.values() if camera in connection.cameras]

    def using(self, camera: str) -> list[RtspConnection]:
        """Those that watch a camera, or requested it last."""
        with self.changed:
            return [c for c in self.connections.values() if camera in (c.described, *c.cameras)]

    def copies(self) -> dict[str, int]:
        """By camera, the number of viewers outside the vehicle; cameras without any are omitted."""
        with self.changed:
            watched = [c.cameras for c in self.connections.values() if over_uplink(c.viewer.address)]
            return dict(Counter(name for cameras in watched for name in tuple(cameras)))

    def disconnect(self, connection: RtspConnection, why: str) -> None:
        for camera in sorted(connection.cameras):
            self._on_report(camera, f"disconnected the viewer at {connection}: {why}")
        connection.close()

    def lag(self, connection: RtspConnection, pipelines: Mapping[str, CameraPipeline | SoundPipeline]) -> float:
        """See `RtspConnection.lag`."""
        others = (other for other in self.connections.values() if other is not connection)
        shared = any(other.cameras.keys() & connection.cameras.keys() for other in others)
        watched = [pipeline for name in connection.cameras if (pipeline := pipelines.get(name))]
        return connection.lag(sum(pipeline.kbps for pipeline in watched), shared)


def drop_silent(connections: Iterable[RtspConnection], now: float) -> None:
    """Close those whose client makes no request, to free threads for other handshakes."""
    silent = [each for connection in connections if (each := (connection.unused_s(now), connection))[0] > 0]
    for idle_s, connection in silent:
        if idle_s > (CROWDED_S if len(silent) > CROWD else FIRST_REQUEST_S):
            connection.close()


def _watches(client: GstRtspServer.RTSPClient, connection: RtspConnection) -> bool:
    """Whether a connection holds a camera or a session."""
    return bool(connection.cameras or client.session_filter(None))
