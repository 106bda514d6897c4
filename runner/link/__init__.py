"""A limited link between the vehicle's and the operator's process, whose rate follows a trace.

Arrivals, losses and delays are thus measured, not assumed. Two kinds: `netns` (root; packets of any protocol between
two network namespaces) and `relay` (no root; RTSP, RTP and MQTT through a process). Both limit all traffic from the
vehicle to the operator in one queue, and all traffic back in another, if that is limited. A link may have lanes, as of
a vehicle with several modems: each is a network device of the vehicle, or one of its addresses, with its own limits.

with limited_link("relay", limit, vehicle.media, vehicle.control, log.record) as link, private_broker(link.broker):
    ...  # [*link.vehicle_command, python, ..., *link.vehicle_overrides] and [python, ..., *link.operator_overrides]
    link.start(time.time())
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace

from msgspec import UNSET

from runner.errors import RunError, suggest
from runner.link import netns
from runner.link.ends import Ends
from runner.link.limit import Limit, LinkCounters, Rates
from runner.link.relayed import relayed
from runner.records.lines import LinkSample
from runner.settings import Endpoint

__all__ = ["KINDS", "Limit", "LimitedLink", "check_possible", "limited_link"]

KINDS = {"netns": netns.namespaced, "relay": relayed}
LOG_S = 0.1  # between two lines of the log
POLL_S = 0.02  # how late a rate change may be
STOP_S = 0.5  # how long the last line of the log may take

OnLinkSample = Callable[[LinkSample], None]


class LimitedLink:
    """A link that is set up. Its rate is the initial one until `start` sets the start of the drive.

    limits     by lane
    on_sample  called with each sample, from a thread of the link

    `vehicle_command`, `vehicle_overrides`, `operator_overrides`, `broker` and `notes`: see `Ends`.
    """

    def __init__(self, limits: Mapping[str, Limit], ends: Ends, on_sample: OnLinkSample) -> None:
        self.vehicle_command, self.broker = ends.vehicle_command, ends.broker
        self.vehicle_overrides, self.operator_overrides = ends.vehicle_overrides, ends.operator_overrides
        self.notes = ends.notes
        self._limits, self._shapers, self._on_sample = limits, ends.shapers, on_sample
        self._stopped = threading.Event()
        self._failure: Exception | None = None
        self._thread: threading.Thread | None = None

    def start(self, began: float) -> None:
        """Make the rate follow the trace from now on, and write the log; to be called once.

        began  the drive's time 0, s since 1970
        """
        assert self._thread is None, "a link starts once"
        zero = time.monotonic() - (time.time() - began)  # the system clock may change while driving
        self._thread = threading.Thread(target=self._run, args=(zero,), name="link", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """raises RunError if the link no longer works as it should"""
        if isinstance(self._failure, RunError):
            raise self._failure
        if self._failure:
            raise RunError(f"the limited link stopped: {self._failure!r}") from self._failure
        for shaper in self._shapers.values():
            shaper.check()

    def stop(self) -> None:
        """Write the last line of the log; the rate stays."""
        self._stopped.set()
        if self._thread:
            self._thread.join(STOP_S)  # a thread that waits for an answer ends with its child

    def _run(self, zero: float) -> None:
        try:
            self._follow(zero)
        except Exception as error:  # kept for `check`
            self._failure = error

    def _follow(self, zero: float) -> None:
        in_force, line = {lane: limit.rates(0) for lane, limit in self._limits.items()}, 0
        ended = False
        while not ended:
            ended = self._stopped.wait(POLL_S)
            t = time.monotonic() - zero
            logs = t >= line * LOG_S or (ended and t >= 0)
            for lane, limit in self._limits.items():
                rates = limit.rates(t)
                if rates != in_force[lane] or logs:
                    in_force[lane], counters = rates, self._shapers[lane].limit(rates)
                if logs:
                    self._on_sample(_sample(t, rates, counters, lane))
            line = int(t / LOG_S) + 1 if logs else line


def _sample(t: float, rates: Rates, counters: LinkCounters, lane: str) -> LinkSample:
    counted = asdict(replace(counters, queue_ms=round(counters.queue_ms, 1)))
    kbps = 0.0 if rates.cut else round(rates.up, 3)
    return LinkSample(**counted, t=round(t, 3), kbps=kbps, lane=lane or UNSET)


def check_possible(kind: str) -> None:
    """raises RunError if this machine or its user cannot set up a link of that kind"""
    if kind == "netns":
        netns.check_possible()


@contextmanager
def limited_link(
    kind: str,
    limit: Limit,
    media: Endpoint,
    control: Endpoint,
    on_sample: OnLinkSample,
    *,
    dials: bool = False,
    lanes: Mapping[str, Limit] | None = None,
) -> Iterator[LimitedLink]:
    """The link, for the duration of the block; everything that belongs to it is removed at the end.

    kind            netns or relay
    limit           its rate, queue and delay, unless it has lanes
    media, control  RTSP server and broker as configured
    on_sample       called 10 times a second from a thread, once the link is started; bytes, packets and dropped count
                    since the link was set up; for each lane, if it has some
    dials           whether the vehicle dials the operator for media, as with SRT; kind netns
    lanes           limits by name, which is that of the vehicle's device; None: one without a name
    raises          RunError if it cannot be set up, with the remedy; at the end, if it has failed meanwhile
    """
    if kind not in KINDS:
        raise RunError(f"link={kind}: unknown kind{suggest(kind, KINDS)}")
    limits = lanes or {"": limit}
    with KINDS[kind](limits, media, control, dials) as ends:
        link = LimitedLink(limits, ends, on_sample)
        try:
            yield link
        finally:
            link.stop()
        link.check()
