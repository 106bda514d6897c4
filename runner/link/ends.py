"""The interface of both kinds of link."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from runner.link.limit import Shaper
from runner.settings import Endpoint


@dataclass(frozen=True)
class Ends:
    """How to start both sides so that traffic from vehicle to operator passes the link.

    vehicle_command     prefix of the vehicle's command line
    vehicle_overrides   addresses at which the vehicle's RTSP server listens and it reaches the broker
    operator_overrides  addresses at which the operator reaches both
    broker              address at which the broker must listen
    shapers             by lane: sets the rates and counts
    notes               for the user
    """

    vehicle_command: tuple[str, ...]
    vehicle_overrides: tuple[str, ...]
    operator_overrides: tuple[str, ...]
    broker: Endpoint
    shapers: Mapping[str, Shaper]
    notes: tuple[str, ...] = ()


def overrides(media: Endpoint, control: Endpoint) -> tuple[str, ...]:
    """The overrides with the addresses of RTSP server and broker."""
    return tuple(
        f"{key}={value}"
        for name, endpoint in (("media", media), ("control", control))
        for key, value in ((f"{name}.host", endpoint.host), (f"{name}.port", endpoint.port))
    )
