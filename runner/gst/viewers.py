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


class StreamViewer(NamedTuple):
    """One viewer of one camera.

    address   IP address of the client
    operator  id of its operator, "" if it states none
    since     monotonic time at which it connected, s; distinguishes viewers from one address
    """

    address: str
    operator: str = ""
    since: float = 0.0


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
