"""Converts between kbit/s of encoded video and on the wire, where headers and sound share the uplink. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from fractions import Fraction
from functools import lru_cache

from runner.core.model import Camera, Graph, Kbps, Vehicle

INSIDE_MTU = 14  # RTP header (RFC 3550) and fragmentation header (RFC 6184, FU-A), which count as part of the MTU


SOUND = "sound"  # its name among the streams of a vehicle, which no camera then has
VOICE = "voice"  # likewise of the operator's voice, which takes nothing of the uplink


def sound_kbps(kbps: int, packet_ms: int, header_bytes: int) -> Kbps:
    """kbit/s on the wire of sound with a constant bitrate: each packet has headers."""
    return Kbps(kbps) + Fraction(8 * header_bytes, packet_ms)


def beside_sound(vehicle: Vehicle, copies: Mapping[str, int], total: Kbps, uplinks: int = 1) -> Kbps:
    """What sound leaves of a total to the cameras, at least 0; every copy that leaves the vehicle counts.

    copies   by stream, how many leave the vehicle; 1 for others
    uplinks  that the total is for; each carries the sound
    """
    return max(Fraction(0), total - _taken(vehicle, copies, uplinks)) if vehicle.sound else total


def with_sound(vehicle: Vehicle, copies: Mapping[str, int], total: Kbps) -> Kbps:
    """The total of which sound leaves this much to the cameras."""
    return total + _taken(vehicle, copies, max(1, len(vehicle.uplinks)))


def _taken(vehicle: Vehicle, copies: Mapping[str, int], uplinks: int) -> Kbps:
    return vehicle.sound * copies.get(SOUND, 1) * uplinks


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
