"""A limited link between the vehicle's and the operator's process, whose rate follows a trace.

Arrivals, losses and delays are thus measured, not assumed. Two kinds: `netns` (root; packets of any protocol between
two network namespaces) and `relay` (no root; RTSP, RTP and MQTT through a process). Both limit all traffic from the
vehicle to the operator in one queue, and all traffic back in another, if that is limited.

with limited_link("relay", limit, vehicle.media, vehicle.control, log.record) as link, private_broker(link.broker):
    ...  # [*link.vehicle_command, python, ..., *link.vehicle_overrides] and [python, ..., *link.operator_overrides]
    link.start(time.time())
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace

from runner.errors import RunError, suggest
from runner.link import netns
from runner.link.ends import Ends
from runner.link.limit import Limit, LinkCounters
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

    on_sample  called with each sample, from a thread of the link

    `vehicle_command`, `vehicle_overrides`, `operator_overrides`, `broker` and `notes`: see `Ends`.
    """

    def __init__(self, limit: Limit, ends: Ends, on_sample: OnLinkSample) -> None:
        self.vehicle_command, self.broker = ends.vehicle_command, ends.broker
        self.vehicle_overrides, self.operator_overrides = ends.vehicle_overrides, ends.operator_overrides
        self.notes = ends.notes
        self._limit, self._shaper, self._on_sample = limit, ends.shaper, on_sample
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
        self._shaper.check()

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
        in_force, line = self._limit.rates(0), 0
        ended = False
        while not ended:
            ended = self._stopped.wait(POLL_S)
            t = time.monotonic() - zero
            rates, logs = self._limit.rates(t), t >= line * LOG_S or (ended and t >= 0)
            if rates != in_force or logs:
                in_force, counters = rates, self._shaper.limit(rates)
            if logs:
                line = int(t / LOG_S) + 1
                self._on_sample(_sample(t, rates.up, counters))


def _sample(t: float, kbps: float, counters: LinkCounters) -> LinkSample:
    return LinkSample(
        **asdict(replace(counters, queue_ms=round(counters.queue_ms, 1))), t=round(t, 3), kbps=round(kbps, 3)
    )


def check_possible(kind: str) -> None:
    """raises RunError if this machine or its user cannot set up a link of that kind"""
    if kind == "netns":
        netns.check_possible()


@contextmanager
def limited_link(
    kind: str, limit: Limit, media: Endpoint, control: Endpoint, on_sample: OnLinkSample, *, dials: bool = False
) -> Iterator[LimitedLink]:
    """The link, for the duration of the block; everything that belongs to it is removed at the end.

    kind            netns or relay
    limit           its rate, queue and delay
    media, control  RTSP server and broker as configured
    on_sample       called 10 times a second from a thread, once the link is started; bytes, packets and dropped count
                    since the link was set up
    dials           whether the vehicle dials the operator for media, as with SRT; kind netns
    raises          RunError if it cannot be set up, with the remedy; at the end, if it has failed meanwhile
    """
    if kind not in KINDS:
        raise RunError(f"link={kind}: unknown kind{suggest(kind, KINDS)}")
    with KINDS[kind](limit, media, control, dials) as ends:
        link = LimitedLink(limit, ends, on_sample)
        try:
            yield link
        finally:
            link.stop()
        link.check()
