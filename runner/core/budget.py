"""Converts between kbit/s of encoded video and on the wire, where headers and sound share the uplink. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from fractions import Fraction
from functools import lru_cache
from typing import NamedTuple

from runner.core.model import Camera, Graph, Kbps, Vehicle

INSIDE_MTU = 14  # RTP header (RFC 3550) and fragmentation header (RFC 6184, FU-A), which count as part of the MTU
# In which a picture says what it shows (`runner.h264.region`), of sides up to 16383 px, and its length in a packet.
REGION_BYTES = 18

SOUND = "sound"  # its name among the streams of a vehicle, which no camera then has
VOICE = "voice"  # likewise of the operator's voice, which takes nothing of the uplink
VOICE_HZ, SAMPLE_BYTES = 48_000, 2  # of what a page or a program hands over, one channel


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

    cameras  with repetitions for a camera that is sent in several copies; those whose pictures say which part of the
             image they show have graphs that `places`
    """
    extra = _overhead(tuple(cameras))
    own = extra.regions * min(Fraction(1), video / extra.full) if extra.regions else 0
    return video * extra.factor + extra.fixed + own


def video_kbps(cameras: Iterable[Camera], wire: Kbps) -> Kbps:
    """kbit/s of video that fit into this much on the wire, 0 if headers alone exceed it."""
    extra = _overhead(tuple(cameras))
    video = (wire - extra.fixed - extra.regions) / extra.factor
    if extra.regions and video < extra.full:
        video = (wire - extra.fixed) / (extra.factor + extra.regions / extra.full)
    return max(Fraction(0), video)


class _Overhead(NamedTuple):
    """What is on the wire beside the video, kbit/s.

    fixed    of one more packet per access unit, and of the regions that pictures state
    factor   bytes on the wire per byte of full packets
    regions  if each region had a packet of its own: one shares that of a picture, unless the picture takes several
    full     video of which each picture fills one packet
    """

    fixed: Kbps
    factor: Fraction
    regions: Kbps
    full: Kbps


@lru_cache(maxsize=64)  # for a few sets of cameras that are on
def _overhead(cameras: tuple[Camera, ...]) -> _Overhead:
    fixed = regions = full = Fraction(0)
    for camera in cameras:
        kbit, header, is_placed = 8 * camera.fps / 1000, camera.graph.settings.header_bytes, camera.graph.places
        fixed += kbit * (header + (REGION_BYTES if is_placed else 0))
        full += kbit * payload_bytes(camera.graph)
        if is_placed and _shares_packets(camera.graph):
            regions += kbit * header
        elif is_placed:
            fixed += kbit * header
    factors = [1 + Fraction(camera.graph.settings.header_bytes, payload_bytes(camera.graph)) for camera in cameras]
    return _Overhead(fixed, max(factors, default=Fraction(1)), regions, full)


def _shares_packets(graph: Graph) -> bool:
    """Whether its payloader puts the parts of a small picture into one packet."""
    return any(element.properties.get("aggregate-mode", "none") != "none" for element in graph.vehicle)


@lru_cache(maxsize=256)  # the same object: what is known of sets of cameras is kept
def unplaced(camera: Camera) -> Camera:
    """The camera as one whose pictures do not say what they show, as they do not while that is the full image."""
    return replace(camera, graph=replace(camera.graph, places=False)) if camera.graph.places else camera


def payload_bytes(graph: Graph) -> int:
    """Of video in a full packet."""
    return max(1, graph.settings.mtu_bytes - INSIDE_MTU)
