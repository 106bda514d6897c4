"""A camera's watched source: if it freezes or fails, it is replaced while the rest of the pipeline continues."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from gi.repository import GLib, Gst

from runner.graph import Plan, launch
from runner.gst.aside import HUNG, HUNG_STARTING, change_in_thread, set_state_in_thread
from runner.gst.credentials import Login
from runner.gst.decoders import SILENT_S, DecoderWatch
from runner.gst.ip_camera import CameraClient, follow_cameras
from runner.gst.outage import Outage
from runner.gst.probes import EventProbe, IdleProbe
from runner.gst.rate_limit import RateLimits
from runner.gst.rtspsrc import STREAM_ENDED, Opening, handle_stream_end, is_rtsp_client, limit_teardown
from runner.gst.source import fixed_rate
from runner.gst.timers import Delayed, later
from runner.system.backoff import pause_s

CHECK_S = 0.1
FIRST_FRAME_S = 10.0  # a UDP source may take 5 s to fail, and the first keyframe may be late
HELD_UP_S = 0.5  # between two checks; that time does not count
IN_FLIGHT = 5  # frames that may still pass after an error that stops the source
LONGEST_START_S = 300.0  # a start that hangs is abandoned then; its thread remains
DECODER_S = 2 * SILENT_S  # how much longer the pictures may stand while the decoder is looked at
BEGIN_S = 5.0  # until a pipeline that was built is started, at most
WAITING_S = 1.0  # an answer that takes longer is reported
BACKOFF_S = (1.0, 10.0)  # between the starts of two attempts: doubled from the first value up to the second


class WatchedSource(Gst.Bin):  # type: ignore[misc]
    """Replaces the elements of a source in its pipeline, and contains them as a child bin.

    A source that delivers no frame for `Plan.frozen_s` while the pipeline plays, fails or ends is removed and rebuilt.
    Downstream elements only see a pause: clock and running time continue, and the source's errors, its EOS and its
    asynchronous state changes do not leave this bin. Frames are counted in C before the gate, so a camera that is
    paused or off counts as working.

    Before the first frame nothing is replaced: errors fail the whole pipeline, and the client gets an error. Nor is a
    camera that still answers the first requests of its client: `first_reply_s` limits each answer.

    login      of the camera, over all of its pipelines
    left_out   decoders that are not chosen, likewise
    on_report  called with what happened

    `limits` hold it at the camera's rate.
    """

    def __init__(self, plan: Plan, login: Login, left_out: set[str], on_report: Callable[[str], None]) -> None:
        super().__init__(name="watched-source")
        assert plan.frozen_s is not None
        self._plan, self._frozen_s = plan, plan.frozen_s
        self._launch, self._last = launch(plan.source), plan.source[-1].name
        self._login, self._left_out, self._on_report = login, left_out, on_report
        self.outage = Outage(on_report)
        self.limits = RateLimits(float(plan.camera.fps))
        # Messages of this bin are handled from the first `add` on.
        self._opening = Opening()  # of its RTSP client
        self._client: CameraClient | None = None  # of the child, if it is an IP camera
        self._decoders: DecoderWatch | None = None  # of the child
        self._counter = Gst.ElementFactory.make("identity", "source-frames")
        self.add(self._counter)
        self.add_pad(Gst.GhostPad.new("src", self._counter.get_static_pad("src")))
        self._events = EventProbe(Gst.PadProbeType.EVENT_DOWNSTREAM, self._ends_here)
        self._events.add_to(self._counter.get_static_pad("sink"))
        self._lock = (
            threading.Lock()
        )  # for the child: the server's threads start and stop it, GLib's thread replaces it
        self._child: Gst.Bin | None = None
        self._built, self._has_begun = time.monotonic(), False
        self._late: tuple[str, float] | None = None  # the last request without an answer that was reported
        self._next_check: Delayed | None = None
        self._starting: threading.Thread | None = None  # starts the child
        self._started = 0.0  # when it began
        self._error: tuple[str, int] | None = None  # the source's own error, and frames before it; set from its threads
        self._progress = (0, 0.0)  # frames at the last change of the counter, and when
        self._watched = 0.0  # when it was last checked
        self._attempts = 0  # in this outage
        self._last_attempt = (0, 0.0)  # frames when the last attempt began, and when

    def install(self, pipeline: Gst.Bin, plan: Plan) -> None:
        """Replace the plain elements of the source in a newly built pipeline."""
        for element in plan.source:
            pipeline.remove(pipeline.get_by_name(element.name))
        pipeline.add(self)
        self.link(pipeline.get_by_name(plan.entry))

    @property
    def fault(self) -> str | None:
        """Why it delivers nothing; None if it does, or has only begun."""
        return self.outage.reason or self.waiting(WAITING_S)

    @property
    def is_opening(self) -> bool:
        """Whether it is yet to start, or an IP camera still answers the first requests."""
        if not self._has_begun:
            return time.monotonic() - self._built < BEGIN_S
        client = self._client  # of a child that another thread may remove
        return bool(client and client.is_opening and not self._error)

    def waiting(self, least_s: float) -> str | None:
        """For which answer of an IP camera it has waited so long; None if for none."""
        client = self._client
        asked = client and client.asked
        waited_s = time.monotonic() - asked[1] if asked else 0.0
        return f"waiting for the camera: {asked[0]}, {waited_s:.0f} s" if asked and waited_s >= least_s else None

    # --- called by GStreamer ------------------------------------------------------------------------------------------

    def do_change_state(self, transition: Gst.StateChange) -> Gst.StateChangeReturn:
        if transition == Gst.StateChange.READY_TO_PAUSED:
            with self._lock:
                self._add_child()
            self._has_begun = True
            self._watched = time.monotonic()
            self._progress = (self._frames(), self._watched)
            self._next_check = later(CHECK_S, self._watch)
        elif transition == Gst.StateChange.PAUSED_TO_READY:
            self._end()
        result = Gst.Bin.do_change_state(self, transition)
        if transition == Gst.StateChange.READY_TO_PAUSED and result == Gst.StateChangeReturn.FAILURE:
            self._end()  # the bin stays in READY
        return result

    def _end(self) -> None:
        with self._lock:
            if self._next_check:
                self._next_check.cancel()
            self._next_check = None
            self._remove_child()
            self.outage, self._attempts = Outage(self._on_report), 0

    def do_handle_message(self, message: Gst.Message) -> None:
        self._opening.handle(message)
        if client := self._client:
            client.follow(message)
        if message.type == Gst.MessageType.ERROR:
            self._on_error(message)
        if self._frames():
            if message.type == Gst.MessageType.ERROR:
                self._set_error(message.parse_error()[0].message)
                return
            if message.type in (Gst.MessageType.ASYNC_START, Gst.MessageType.ASYNC_DONE):
                return
        Gst.Bin.do_handle_message(self, message)

    def _ends_here(self, event: Gst.EventType) -> bool:
        """From a streaming thread. The end of a source that has worked does not end the pipeline."""
        if event != Gst.EventType.EOS or not self._frames():
            return False
        self._set_error(STREAM_ENDED)
        return True

    def _on_stream_gone(self, client: Gst.Element, is_bye: bool) -> None:
        """From a streaming thread of an IP camera's client. A silent one is noticed by its missing frames."""
        if not is_bye or client.get_parent() is not self._child:
            return
        if self._frames():
            self._set_error(STREAM_ENDED)
        else:
            self.post_message(Gst.Message.new_error(self, GLib.Error(STREAM_ENDED), ""))

    def _on_error(self, message: Gst.Message) -> None:
        self._login.handle(message)
        if decoders := self._decoders:
            decoders.handle(message.parse_error()[0])

    def _set_error(self, what: str) -> None:
        self._error = self._error or (what, self._frames())  # the first one: others follow from it

    # --- in GLib's thread ---------------------------------------------------------------------------------------------

    def _watch(self) -> None:
        with self._lock:
            if not self._next_check:
                return
            self._next_check = later(CHECK_S, self._watch)
        now, frames = time.monotonic(), self._frames()
        gap_s, self._watched = now - self._watched, now
        if gap_s > HELD_UP_S and not self._error:  # this thread was held up, and the source perhaps with it
            self._progress = (self._progress[0], self._progress[1] + gap_s - CHECK_S)
        if frames != self._progress[0] or not self._is_playing():
            self._progress = (frames, now)
            if self._error and frames > self._error[1] + IN_FLIGHT:
                self._error = None  # it does not stop the video
        self._note_waiting(now)
        if not frames:
            return
        if not self._attempts:
            self._check_source(now)
        elif frames > self._last_attempt[0]:
            self._attempts = 0
            self.outage.report_recovery(now)
        else:
            self._check_attempt(now)

    def _note_waiting(self, now: float) -> None:
        """Report an answer that is late, once, and when it has come."""
        client = self._client
        asked = client.asked if client else None
        if asked and asked != self._late and (waiting := self.waiting(WAITING_S)):
            self._late = asked
            self._on_report(waiting)
        elif self._late and client and asked != self._late:
            if not client.has_failed:
                self._on_report(f"the camera answered {self._late[0]} after {now - self._late[1]:.0f} s")
            self._late = None

    def _check_source(self, now: float) -> None:
        """During normal operation."""
        still_s = now - self._progress[1]
        if still_s <= self._frozen_s:
            return
        decoders = self._decoders
        if not self._error and decoders and decoders.suspects and still_s < self._frozen_s + DECODER_S:
            return  # the camera is not frozen: its decoder may soon be found to be at fault
        if self._is_idle():
            self.outage.report_failure(
                f"source: {self._error[0] if self._error else f'no frame for {self._frozen_s:g} s'}", self._progress[1]
            )
            if not self._login.refusal:
                self._replace(now)
        else:
            self._progress = (self._progress[0], now)  # its next frame follows once this one has passed

    def _check_attempt(self, now: float) -> None:
        """After an attempt that has not delivered a frame yet."""
        if self._error:
            self.outage.report_failure(f"source: {self._error[0]}", self._progress[1])
        starting = self._starting
        if starting and starting.is_alive() and now - self._started < LONGEST_START_S:
            self._last_attempt = (self._last_attempt[0], now)  # its first frame is due once it has started
            return
        if self.is_opening:
            self._last_attempt = (self._last_attempt[0], now)  # likewise
            return
        if self._login.refusal:
            return
        pause = pause_s(self._attempts - 1, *BACKOFF_S)
        if now - self._last_attempt[1] > (pause if self._error else max(pause, FIRST_FRAME_S)):
            self._replace(now)

    def _replace(self, now: float) -> None:
        self._last_attempt = (self._progress[0], now)
        self._attempts += 1
        with self._lock:
            if not self._next_check:
                return
            self._remove_child()
            self._error = None
            child = self._add_child()
            self._started = now
            self._starting = change_in_thread(
                "start", child.sync_state_with_parent, lambda: self._on_report(f"source: {HUNG_STARTING}")
            )

    # --- the child, under its lock ------------------------------------------------------------------------------------

    def _add_child(self) -> Gst.Bin:
        child = Gst.parse_bin_from_description(self._launch, ghost_unlinked_pads=False)
        child.add_pad(Gst.GhostPad.new("src", child.get_by_name(self._last).get_static_pad("src")))
        if problem := self._login.log_in(child):
            self._on_report(problem)
        self._decoders = DecoderWatch(child, child.get_static_pad("src"), self._left_out, self._on_report)
        if self._plan.bag:
            from runner.gst.bag_feed import play_bag

            play_bag(child, self._plan, self._plan.bag, self._on_report)
        for client in filter(is_rtsp_client, child.children):
            handle_stream_end(client, self._on_stream_gone)
        self._client = next(iter(follow_cameras(child, self._plan, self._login.accept)), None)
        limit_teardown(child)
        for element in fixed_rate(child):
            element.set_property("skip-to-first", True)  # otherwise the first frame is repeated for the time before it
        self.limits.follow(child)
        self.add(child)
        child.link(self._counter)
        self._child = child
        return child

    def _remove_child(self) -> None:
        child, self._child, self._client, self._decoders = self._child, None, None, None
        if child is not None:
            self.remove(child)
            bus, opening, self._opening = Gst.Bus(), self._opening, Opening()
            opening.follow(bus)
            child.set_bus(bus)  # it belongs to no pipeline any more

            def before_stop() -> None:
                opening.wait()
                bus.set_flushing(True)  # messages in a bus keep their elements alive, and these the bus

            hung = f"source: {HUNG}"
            set_state_in_thread(child, Gst.State.NULL, lambda: self._on_report(hung), self._starting, before_stop)
            self._starting = None

    # ------------------------------------------------------------------------------------------------------------------

    def _frames(self) -> int:
        frames: int = self._counter.get_property("stats").get_value("num-buffers")
        return frames

    def _is_playing(self) -> bool:
        return bool(self._counter.get_state(0).state == Gst.State.PLAYING)

    def _is_idle(self) -> bool:
        """Whether no frame is blocked downstream of the source, for example by a sink that is reconnecting."""
        pad = self._counter.get_static_pad("src")
        return _IdleCheck(pad).is_idle


class _IdleCheck:
    """Whether a pad is idle now. Its probe ends with it."""

    def __init__(self, pad: Gst.Pad) -> None:
        self.is_idle = False
        self._probe = IdleProbe(self._on_idle)
        self._probe.add_to(pad)

    def _on_idle(self) -> None:
        self.is_idle = True


def prepare_source(
    pipeline: Gst.Bin, plan: Plan, login: Login, left_out: set[str], on_report: Callable[[str], None]
) -> None:
    """Set up a source that is not watched in a newly built pipeline; the arguments are those of `WatchedSource`."""
    bus = (pipeline.get_parent() or pipeline).get_bus()
    if problem := login.log_in(pipeline):
        on_report(problem)
    if follow_cameras(pipeline, plan, login.accept):
        login.follow(bus)
    end = pipeline.get_by_name(plan.source[-1].name).get_static_pad("src")
    DecoderWatch(pipeline, end, left_out, on_report).follow(bus)
