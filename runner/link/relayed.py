"""A link without root: a separate process between vehicle and operator, `runner.link.relay`."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from runner.errors import RunError
from runner.link.child import Child, ChildShaper
from runner.link.ends import Ends, overrides
from runner.link.limit import Limit
from runner.settings import Endpoint
from runner.system import children


@contextmanager
def relayed(limits: Mapping[str, Limit], media: Endpoint, control: Endpoint, dials: bool = False) -> Iterator[Ends]:
    """The relay, for the duration of the block: the operator's RTSP and the vehicle's MQTT pass through it.

    media, control  where RTSP server and broker listen, on this machine
    raises          RunError
    """
    lane, limit = next(iter(limits.items()))
    for what, given in (("tcp", limit.tcp), ("media that the vehicle dials", dials), ("a link of lanes", lane)):
        if given:
            raise RunError(f"link=relay: {what} is not supported, choose link=netns")
    settings = {"media": [media.host, media.port], "control": [control.host, control.port], **limit.directions()}
    command = (sys.executable, "-m", "runner.link.relay", json.dumps(settings))
    relay = Child("relay", command, children.environment())
    try:
        ports = relay.answer()
        for_operator = overrides(Endpoint(media.host, ports["media"]), control)
        for_vehicle = overrides(media, Endpoint(control.host, ports["control"]))
        yield Ends((), for_vehicle, for_operator, control, {lane: ChildShaper(relay)})
    finally:
        relay.end()
