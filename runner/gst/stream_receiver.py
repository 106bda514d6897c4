"""Receives one stream of the vehicle: connects, and connects again when it fails or falls silent."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING

from gi.repository import Gst

from runner.graph import Plan
from runner.gst.arriving import RTP_HZ
from runner.gst.repair import RtpSession
from runner.gst.rtspsrc import (
    NO_PLACE,
    STREAM_ENDED,
    Opening,
    handle_stream_end,
    is_rtsp_client,
    limit_teardown,
    status_of,
)
from runner.gst.sender_filter import SenderFilter
from runner.gst.supervised import SupervisedPipeline
from runner.gst.timers import later
from runner.gst.viewers import user_agent
from runner.system.backoff import pause_s
from runner.system.held_up import LateCheck

if TYPE_CHECKING:
    from runner.gst.received_uplinks import Addresses, ReceivedUplinks
    from runner.gst.secure import StreamLogin
    from runner.sound import SoundPlan

STALL_S = 2.0  # a stream that should arrive but neither does nor answers for longer is rebuilt
DIALLED_STALL_S = 1.0  # likewise where the vehicle dials: it calls again, but a listener keeps its first caller
REFUSED_S = (1.0, 30.0)  # from a refusal to the next request: doubled from the first value up to the second
GRACE_S = 0.75  # time for the first frame once a camera is expected to send


class StreamReceiver(ABC):
    """Its methods are to be called a few times a second; they also detect a silent stream.

    `rtp` is how its packets arrive.

    launch     its pipeline as GStreamer parses it
    operator   id of the operator on the control link, which the vehicle admits first; "" for another viewer
    login      credentials for the vehicle; None: the vehicle does not authenticate
    uplinks    addresses of the vehicle by uplink, as far as known; None: it has one way
    hz         of the RTP timestamps
    """

    def __init__(
        self,
        plan: Plan | SoundPlan,
        launch: str,
        on_report: Callable[[str, str], None],
        operator: str,
        login: StreamLogin | None,
        uplinks: Addresses | None,
        hz: int = RTP_HZ,
    ) -> None:
        self._on_report, self._operator, self._login = on_report, operator, login
        self._client_name = plan.operator[0].name
        self._late = LateCheck()
        self._name = name = plan.name
        received = None if uplinks is None else _received_uplinks(uplinks, has_keys=login is not None, hz=hz)
        self.rtp = RtpSession(plan.settings, lambda what: on_report(name, what), received, hz)
        self._is_dialled = isinstance(plan, Plan) and not plan.serves
        self._stall_s = DIALLED_STALL_S if self._is_dialled else STALL_S
        self._supervised = SupervisedPipeline(launch, self._on_built, lambda what: on_report(name, what))
        self._supervised.is_excused = self._is_refusal
        self._supervised.must_wait = lambda: time.monotonic() < self._refused_until
        self._refused, self._refused_until = 0, 0.0  # refusals in a row; until when the vehicle is not asked again
        self._frames = self._bytes = 0  # received, across all pipelines; of sound: packets
        self._foreign_reported = False
        self._filter: SenderFilter | None = None
        self._built = self._begun = False  # a pipeline; this one has received something
        self._progress = (0, time.monotonic())  # frames at their last change, and when there was progress
        self._last_unexpected = time.monotonic()  # when the stream was last not expected
        self._was_expected = False  # whether it was expected at the last sample
        self._should_send: bool | None = None  # as of the last sample

    @abstractmethod
    def _on_built(self, pipeline: Gst.Pipeline) -> Gst.Pad:
        """See `SupervisedPipeline`; calls `_follow`."""

    def _follow(self, pipeline: Gst.Pipeline) -> None:
        """Set up what connects a new pipeline to the vehicle."""
        self._built, self._begun = True, False
        self._close_filter()
        self._progress = (self._frames, time.monotonic())
        pipeline.get_bus().connect("message::progress", self._on_progress)
        self.rtp.begin()
        self._client = pipeline.get_by_name(self._client_name)
        for element in pipeline.iterate_recurse():
            self._on_element(pipeline, pipeline, element)
        pipeline.connect("deep-element-added", self._on_element)
        if self._login and (problem := self._login.prepare(pipeline, self._client)):
            self._on_report(self._name, problem)
        if is_rtsp_client(self._client):
            if self.rtp.uplinks:
                self.rtp.uplinks.direct(self._client)
            self.rtp.follow(self._client)
            handle_stream_end(self._client, self._on_source_gone)
            limit_teardown(pipeline)
            opening = Opening()
            opening.follow(pipeline.get_bus())
            self._supervised.before_stop = opening.wait
        if self._operator and self._client.find_property("user-agent"):
            self._client.set_property("user-agent", user_agent(self._operator))

    def _expect(self, should_send: bool | None, *, anew: bool) -> None:
        """Before counters are read.

        should_send  whether the stream should arrive; None: unknown while the vehicle is offline
        anew         ask the vehicle again now if it has refused this viewer
        """
        self._should_send = should_send
        if anew and self._refused:
            self._refused, self._refused_until = 1, 0.0
            self._supervised.hurry()

    def _is_alive(self, frames: int, foreign: int) -> bool:
        """After counters were read: whether there is progress. Rebuilds a pipeline that has stalled.

        foreign  packets from other hosts
        """
        if foreign and not self._foreign_reported:
            self._foreign_reported = True
            self._on_report(self._name, "packets from hosts other than the vehicle are dropped")
        now = time.monotonic()
        is_excused = self._late.is_excused(now)
        if self._login and (withdrawn := self._login.withdrawn()):
            self._supervised.restart(withdrawn)
        expected = self._was_expected = self._is_expected()
        if not expected:
            self._last_unexpected = now
        if frames != self._progress[0] or self._should_send is False:
            self._progress = (frames, now)
        elif expected and not is_excused and self._has_stalled(now):
            self._progress = (frames, now)
            self._supervised.restart(f"no frame for {self._stall_s:g} s")
        else:
            return False
        return True

    def start(self) -> None:
        self._supervised.start()

    def _has_stalled(self, now: float) -> bool:
        return now - self._progress[1] > self._stall_s and now - self._last_unexpected > GRACE_S

    def _is_expected(self) -> bool:
        """Whether frames should arrive.

        Unknown while the vehicle is offline. But a caller may disappear together with its control link, and needs a
        waiting listener when it is back: a stream that was flowing is expected until its pipeline is rebuilt.
        """
        if self._should_send is None and self._is_dialled:
            return self._was_expected and self._begun
        return bool(self._should_send)

    def _is_refusal(self, error: Gst.Message) -> bool:
        """Whether a receiver fails since the vehicle has no room for it, which its state explains. Begins a pause."""
        if status_of(error) != NO_PLACE:
            self._refused = 0
            return False
        self._refused_until = time.monotonic() + pause_s(self._refused, *REFUSED_S)
        self._refused += 1
        return True

    def _on_progress(self, _bus: Gst.Bus, _message: Gst.Message) -> None:
        """The client is connecting and the server answers, which takes time over a slow link."""
        self._progress = (self._progress[0], time.monotonic())

    def _on_element(self, _pipeline: Gst.Pipeline, _parent: Gst.Bin, element: Gst.Element) -> None:
        self.rtp.add(element)
        if element.find_property("used-socket") and element.get_static_pad("src"):
            self._filter_senders(element)

    def _on_source_gone(self, client: Gst.Element, is_bye: bool) -> None:
        """The stream has ended, or is silent, which `sample` finds sooner where the vehicle's state is known."""
        if is_bye or self._should_send is None:
            later(0, partial(self._on_stream_ended, client))

    def _on_stream_ended(self, client: Gst.Element) -> None:
        if client is self._client:
            self._supervised.restart(STREAM_ENDED)

    def _filter_senders(self, source: Gst.Element) -> None:
        """Make a socket of the client accept packets from the vehicle only. From the client's thread."""
        used_socket = source.get_property("used-socket")
        if used_socket is None:
            return
        try:
            if self._filter is None:
                host = Gst.Uri.from_string(self._client.get_property("location")).get_host()
                self._filter = SenderFilter(*((self.rtp.uplinks and self.rtp.uplinks.hosts) or [host]))
            self._filter.attach(used_socket.get_fd())
        except OSError as error:
            self._on_report(self._name, f"packets from hosts other than the vehicle are not dropped: {error}")

    def admit(self, addresses: Addresses) -> None:
        """The addresses of the vehicle's uplinks are these from now on; none: they are unknown. From any thread."""
        uplinks, current = self.rtp.uplinks, self._filter
        if uplinks and uplinks.admit(addresses) and current and uplinks.hosts:
            with suppress(OSError):  # it has just been closed
                current.admit(*uplinks.hosts)

    def _close_filter(self) -> None:
        if self._filter:
            self._filter.close()
            self._filter = None


def _received_uplinks(addresses: Addresses, *, has_keys: bool, hz: int) -> ReceivedUplinks:
    from runner.gst.received_uplinks import ReceivedUplinks

    return ReceivedUplinks(addresses, has_keys=has_keys, hz=hz)
