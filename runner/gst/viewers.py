"""Decides who may watch a camera over the uplink: each copy of its stream costs the full bitrate again.

A viewer on the vehicle itself (loopback) uses no uplink; it is always admitted and never counted. The operator that has
control is always admitted, and so is the one to whom it is offered. With keys, the certificate of an RTSP client proves
which operator it belongs to. Without, RTSP has no field for an operator, and the client states its id as User-Agent
(RFC 2326, 12.41), which survives address translation and distinguishes operators on one machine. It is a name, not a
proof.
"""

from __future__ import annotations

from collections.abc import Sequence
from ipaddress import IPv6Address, ip_address
from typing import NamedTuple

_PRODUCT = "tod-runner/"
STATED_S = 45.0  # how long a refusal is stated after the last one: receivers ask again earlier, see `gst/receiver.py`
MOST_REFUSED = 50  # names are not proven without keys


class StreamViewer(NamedTuple):
    """One viewer of one camera.

    address   IP address of the client
    operator  id of its operator, "" if it states none
    since     monotonic time at which it connected, s; distinguishes viewers from one address
    """

    address: str
    operator: str = ""
    since: float = 0.0

    def __str__(self) -> str:
        return f"{self.address} ({self.operator})" if self.operator else self.address


def user_agent(operator: str) -> str:
    """The User-Agent of an operator's RTSP client."""
    return f"{_PRODUCT}{operator}"


def operator_of(agent: str | None) -> str:
    """The operator that a User-Agent states, or ""."""
    return agent.removeprefix(_PRODUCT) if agent and agent.startswith(_PRODUCT) else ""


def over_uplink(address: str) -> bool:
    """Whether traffic to an IP address leaves this machine; its own addresses other than loopback count as leaving."""
    ip = ip_address(address.partition("%")[0])
    mapped = ip.ipv4_mapped if isinstance(ip, IPv6Address) else None
    return not (mapped or ip).is_loopback


def admit(
    viewers: Sequence[StreamViewer], new_viewer: StreamViewer, limit: int, drivers: Sequence[str]
) -> list[StreamViewer] | None:
    """The viewers of a camera to disconnect for a new one; None if the new one is refused.

    viewers  of this camera, in order of arrival
    limit    viewers over the uplink at once, at least 1; as many as there are drivers are admitted anyway
    drivers  ids of the operator that has control, and of the one to whom it is offered
    returns  for a driver, the newest viewers that are none; if there are none, its own oldest: a leftover of one whose
             address has changed
    """
    if not over_uplink(new_viewer.address):
        return []
    counted = [viewer for viewer in viewers if over_uplink(viewer.address)]
    if new_viewer.operator not in drivers:
        return None if len(counted) >= limit else []
    own = [viewer for viewer in counted if viewer.operator == new_viewer.operator]
    surplus = max(0, len(counted) + 1 - max(limit, len(drivers)))
    return (_others(counted, drivers) + own)[:surplus]


def too_many(viewers: Sequence[StreamViewer], limit: int, drivers: Sequence[str]) -> list[StreamViewer]:
    """The viewers of a camera to disconnect once there are other drivers; arguments as those of `admit`."""
    counted = [viewer for viewer in viewers if over_uplink(viewer.address)]
    return _others(counted, drivers)[: max(0, len(counted) - max(limit, len(drivers)))]


def _others(viewers: Sequence[StreamViewer], drivers: Sequence[str]) -> list[StreamViewer]:
    """Those that do not drive, the newest first."""
    return [viewer for viewer in reversed(viewers) if viewer.operator not in drivers]


def limit_words(limit: int, viewers: Sequence[StreamViewer]) -> str:
    """Why there is no room for another viewer of a camera.

    viewers  those of this camera
    """
    names = sorted({each.operator for each in viewers if each.operator and over_uplink(each.address)})
    watching = f"; {' and '.join(names)} {'watches' if len(names) == 1 else 'watch'}" if names else ""
    return f"{'one viewer' if limit == 1 else f'{limit} viewers'} per camera: media.max_viewers{watching}"


class RefusedViewers:
    """Who is refused which camera, and why. Not thread-safe; times are s by the monotonic clock."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, str, str], tuple[float, str]] = {}  # camera, operator, address: until when, why

    def add(self, camera: str, viewer: StreamViewer, why: str, now: float) -> bool:
        """Returns whether it was not known to be refused for this reason."""
        self._forget(now)
        key = (camera, viewer.operator, viewer.address)
        before = self._known.pop(key, None)
        if len(self._known) >= MOST_REFUSED:
            del self._known[next(iter(self._known))]
        self._known[key] = now + STATED_S, why
        return before is None or before[1] != why

    def remove(self, camera: str, viewer: StreamViewer) -> None:
        """It is admitted."""
        self._known.pop((camera, viewer.operator, viewer.address), None)

    def stated(self, now: float) -> dict[str, dict[str, str]]:
        """By camera and operator, why it is refused; viewers that state no operator are omitted."""
        self._forget(now)
        stated: dict[str, dict[str, str]] = {}
        for (camera, operator, _), (_, why) in self._known.items():
            if operator:
                stated.setdefault(camera, {})[operator] = why
        return stated

    def _forget(self, now: float) -> None:
        self._known = {key: (until, why) for key, (until, why) in self._known.items() if until > now}
