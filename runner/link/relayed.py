"""A link without root: a separate process between vehicle and operator, `runner.link.relay`."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict

from runner.core.model import Endpoint
from runner.link.child import Child
from runner.link.ends import Ends, overrides
from runner.link.limit import Limit, LinkCounters
from runner.system import children


@contextmanager
def relayed(limit: Limit, media: Endpoint, control: Endpoint) -> Iterator[Ends]:
    """The relay, for the duration of the block: the operator's RTSP and the vehicle's MQTT pass through it.

    media, control  where RTSP server and broker listen, on this machine
    raises          RunError
    """
    settings = {
        "media": [media.host, media.port],
        "control": [control.host, control.port],
        "up": {
            "kbps": limit.kbps(0),
            "queue_ms": limit.queue_ms,
            "delay_ms": limit.delay_ms,
            "loss": limit.loss,
            "burst": limit.burst,
        },
        "down": asdict(limit.reverse) if limit.reverse else None,
    }
    command = (sys.executable, "-m", "runner.link.relay", json.dumps(settings))
    relay = Child("relay", command, children.environment())
    try:
        listens = relay.answer()
        for_operator = overrides(Endpoint(media.host, listens["media"]), control)
        for_vehicle = overrides(media, Endpoint(control.host, listens["control"]))
        yield Ends((), for_vehicle, for_operator, control, _Relay(relay))
    finally:
        relay.end()


class _Relay:
    """The relay's process as a shaper."""

    def __init__(self, child: Child) -> None:
        self._child = child

    def limit(self, kbps: float) -> LinkCounters:
        return LinkCounters(**self._child.ask(str(kbps)))

    def check(self) -> None:
        self._child.check()
