"""A link without root: a separate process between vehicle and operator, `runner.link.relay`."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager

from runner.errors import RunError
from runner.link.child import Child, ChildShaper
from runner.link.ends import Ends, overrides
from runner.link.limit import Limit
from runner.settings import Endpoint
from runner.system import children

LANE = "127.0.1.{}"  # address of the vehicle in a lane, by its number from 1 on


def lane_addresses(lanes: Iterable[str]) -> dict[str, str]:
    """What the vehicle sends from in each lane; "": that of a link without lanes."""
    return {lane: LANE.format(number) if lane else "" for number, lane in enumerate(lanes, 1)}


@contextmanager
def relayed(limits: Mapping[str, Limit], media: Endpoint, control: Endpoint, dials: bool = False) -> Iterator[Ends]:
    """The relay, for the duration of the block: the operator's RTSP and the vehicle's MQTT pass through it.

    limits          by lane; "": that of a link without lanes
    media, control  where RTSP server and broker listen, on this machine
    raises          RunError
    """
    tcp = any(limit.tcp for limit in limits.values())
    for what, given in (("tcp", tcp), ("media that the vehicle dials", dials)):
        if given:
            raise RunError(f"link=relay: {what} is not supported, choose link=netns")
    addresses = lane_addresses(limits)
    lanes = {addresses[lane]: limit.directions() for lane, limit in limits.items()}
    settings = {"media": [media.host, media.port], "control": [control.host, control.port], "lanes": lanes}
    command = (sys.executable, "-m", "runner.link.relay", json.dumps(settings))
    relay = Child("relay", command, children.environment())
    try:
        ports = relay.answer()
        for_operator = overrides(Endpoint(media.host, ports["media"]), control)
        for_vehicle = overrides(media, Endpoint(control.host, ports["control"]))
        shapers = {lane: ChildShaper(relay, number=number) for number, lane in enumerate(limits)}
        notes = tuple(
            f"lane {lane}: what the vehicle sends from {address}" for lane, address in addresses.items() if lane
        )
        yield Ends((), for_vehicle, for_operator, control, shapers, notes)
    finally:
        relay.end()
