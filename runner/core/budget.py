"""Converts between kbit/s of encoded video and on the wire, where headers share the uplink. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from functools import lru_cache

from runner.core.model import Camera, Graph, Kbps

INSIDE_MTU = 14  # RTP header (RFC 3550) and fragmentation header (RFC 6184, FU-A), which count as part of the MTU


def on_the_wire(graph: Graph, size: int) -> int:
    """Bytes on the wire, headers included, of an access unit of `size` bytes."""
    return size + -(-size // payload_bytes(graph)) * graph.settings.header_bytes


def wire_kbps(cameras: Iterable[Camera], video: Kbps) -> Kbps:
    """Upper bound of kbit/s on the wire for this much video: the last packet of an access unit is rarely full.

    cameras  with repetitions for a camera that is sent in several copies
    """
    fixed, factor = _overhead(tuple(cameras))
    return video * factor + fixed


def video_kbps(cameras: Iterable[Camera], wire: Kbps) -> Kbps:
    """kbit/s of video that fit into this much on the wire, 0 if headers alone exceed it."""
    fixed, factor = _overhead(tuple(cameras))
    return max(Fraction(0), (wire - fixed) / factor)


@lru_cache(maxsize=64)  # for a few sets of cameras that are on
def _overhead(cameras: tuple[Camera, ...]) -> tuple[Kbps, Fraction]:
    """kbit/s of one more packet per access unit, and bytes on the wire per byte of full packets."""
    fixed = sum((camera.graph.settings.header_bytes * 8 * camera.fps / 1000 for camera in cameras), Fraction(0))
    factors = [1 + Fraction(camera.graph.settings.header_bytes, payload_bytes(camera.graph)) for camera in cameras]
    return fixed, max(factors, default=Fraction(1))


def payload_bytes(graph: Graph) -> int:
    """Of video in a full packet."""
    return max(1, graph.settings.mtu_bytes - INSIDE_MTU)
