"""Decides who may watch a camera over the uplink: each copy of its stream costs the full bitrate again.

A viewer on the vehicle itself (loopback) uses no uplink; it is always admitted and never counted. The controller, the
operator in control, is always admitted. With keys, the certificate of an RTSP client proves which operator it belongs
to. Without, RTSP has no field for an operator, and the client states its id as User-Agent (RFC 2326, 12.41), which
survives address translation and distinguishes operators on one machine. It is a name, not a proof.
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
    viewers: Sequence[StreamViewer], new_viewer: StreamViewer, limit: int, controller: str
) -> list[StreamViewer] | None:
    """The viewers of a camera to disconnect for a new one; None if the new one is refused.

    viewers     of this camera, in order of arrival
    limit       viewers over the uplink at once, at least 1
    controller  id of the operator in control, "" for none
    returns     for the controller, the newest viewers of others; if all are the controller's own, the oldest: a
                leftover of an operator whose address has changed
    """
    if not over_uplink(new_viewer.address):
        return []
    counted = [viewer for viewer in viewers if over_uplink(viewer.address)]
    surplus = len(counted) + 1 - limit
    if surplus <= 0:
        return []
    if not controller or new_viewer.operator != controller:
        return None
    others = [viewer for viewer in reversed(counted) if viewer.operator != controller]
    own = [viewer for viewer in counted if viewer.operator == controller]
    return (others + own)[:surplus]
