"""One camera's pipeline on the vehicle, from the moment it is built until it is gone."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import TYPE_CHECKING, Any, NamedTuple

from gi.repository import Gst, GstRtp, GstVideo

from runner.core.commands import KnobValue
from runner.dropping import DROPPING
from runner.errors import RunError
from runner.graph import Plan
from runner.gst.held_up import HeldUp
from runner.gst.knobs import KnobPanel
from runner.gst.lost import LostCameras
from runner.gst.picture_rate import PictureRate
from runner.gst.placed import PlacedPictures
from runner.gst.probes import BufferProbe, PassingBuffer, TypeProbe
from runner.gst.rate_limit import RateLimit, RateLimits
from runner.gst.repeats import RepeatDetector
from runner.gst.requests import RequestLimit
from runner.gst.sender_stages import EncoderWatch
from runner.gst.sent_frames import SentFrames
from runner.gst.source import loop_clip
from runner.gst.streams import NOT_SEEKABLE, add_capture_time, drop_queued_packet, passed_counts
from runner.gst.watched import WatchedSource
from runner.records.vehicle import NOTHING_ENCODED, CameraReading, EncoderCounts, SenderStages
from runner.turning import is_restarted_after_gaps

if TYPE_CHECKING:
    from runner.gst.passed import PassedStream
    from runner.gst.pushed import PushedPictures
    from runner.gst.repeated_sets import RepeatedSets
    from runner.gst.sound_pipeline import SoundPipeline
    from runner.gst.uplinks import CameraUplinks, VehicleUplinks
    from runner.ros.cameras import SharedPicture
    from runner.sound import SoundPlan

OnReport = Callable[[str, str], None]  # camera, what happened to it
SRT_KEY_BYTES = 32  # AES-256
GAP_S, GAP_INTERVALS = 0.4, 3  # without a picture, after which an encoder that would make up for it begins anew
# New caps must not make the source renegotiate: its output does not change. It would query caps between two frames,
# while the next knobs are being turned, and see only some of them. Nor does a viewer that joins change caps. The RTSP
# server (1.22) makes all elements negotiate again all the same, but what it adds behind the payloader may not be linked
# yet: then they fail, and the pipeline ends for all viewers.
_NOT_RECONFIGURED = TypeProbe(Gst.PadProbeType.EVENT_UPSTREAM, {Gst.EventType.RECONFIGURE: Gst.PadProbeReturn.DROP})


class Openings(NamedTuple):
    """How cameras are opened.

    build      makes a `CameraPipeline` from each new pipeline, or a `SoundPipeline`
    lost       those that do not open: each is opened again when that is due
    on_report  called when pipelines start, stop or fail, and when viewers are disconnected
    refusal    returns why a camera must not be opened now; None: it may
    uplinks    of the vehicle; None: the system's routes decide by which way streams leave it
    """

    build: Callable[[Gst.Bin, Plan | SoundPlan], CameraPipeline | SoundPipeline]
    lost: LostCameras
    on_report: OnReport
    refusal: Callable[[str], str | None]
    uplinks: VehicleUplinks | None = None


class CameraPipeline:
    """Sets up a newly built pipeline, then turns its knobs.

    wanted     returns the wanted knob values
    on_turned  called, from any thread, after knobs were set
    on_report  called, from any thread, with a fault of the source, its recovery, and values that elements reject
    source     the source, if it is watched

    untimed      whether the source does not know when the last picture was captured
    is_joined    whether a player has begun that waits for a key frame; those who begin within a second get the same one
    uplinks      None: the system's routes decide
    requests     limits what viewers request
    sent_frames  when frames left; None without RTP
    """

    def __init__(
        self,
        pipeline: Gst.Bin,
        plan: Plan,
        wanted: Callable[[], Mapping[str, KnobValue]],
        on_turned: Callable[[], None],
        on_report: Callable[[str], None],
        source: WatchedSource | None = None,
        uplinks: CameraUplinks | None = None,
    ) -> None:
        self._pipeline, self._plan, self._source, self.uplinks = pipeline, plan, source, uplinks
        self._wanted, self._first = wanted, wanted()
        self.untimed = False
        self.knobs = KnobPanel(pipeline, plan.camera, on_turned, on_report)
        if plan.loops:
            loop_clip(pipeline, plan, plan.camera.source.render_s or None)
        if plan.bag and source is None:
            from runner.gst.bag_feed import play_bag

            play_bag(pipeline, plan, plan.bag, on_report)
        self._started = False
        self._limits = source.limits if source else RateLimits(float(plan.camera.fps))
        if source is None:
            self._limits.follow(pipeline)
        self._sent = pipeline.get_by_name("sent")  # None: nothing is counted
        self._rate, self._on_report = PictureRate(float(plan.camera.fps)), on_report
        self._restarts_after_gaps = is_restarted_after_gaps(plan.camera.graph)
        self._passed = self._passed_stream()
        self._is_gap = False
        self.is_joined = False
        self._waved = 0.0  # when a refresh wave was asked for last, time.monotonic
        self._pushed: PushedPictures | None = None  # those of a Python program
        self._elements = [pipeline.get_by_name(element.name) for element in plan.vehicle]
        self._encoder = EncoderWatch(self._elements)
        self._entered = _count_before(self._encoder.encoder) if self._encoder.encoder else self._sent
        entry = self._elements[0].get_static_pad("sink")
        self._repeats = RepeatDetector(entry, plan.camera.source.repeated_s, on_report)
        last = next(pad for element in reversed(self._elements) if (pad := element.get_static_pad("src")))
        payloader = next((element for element in self._elements if isinstance(element, GstRtp.RTPBasePayload)), None)
        self.sent_frames = SentFrames(payloader) if payloader else None
        if payloader:
            add_capture_time(payloader)
        self.knobs.placed = PlacedPictures.of(pipeline, plan.camera, self._sent)
        if dropping := pipeline.get_by_name(DROPPING):
            self.knobs.dropped = RateLimit(dropping, float(plan.camera.fps))
        self.knobs.set_now(self._allowed(self._first))
        self._sets = _repeated_sets(plan, self._sent)
        self._held_up = HeldUp(last)
        self.requests = RequestLimit(last, on_report)
        self._first_packet = BufferProbe(last, self._on_first_packet, in_lists=True)
        self._first_packet.arm()
        for each in (NOT_SEEKABLE, _NOT_RECONFIGURED):
            each.add_to(last)

    def _passed_stream(self) -> PassedStream | None:
        """What a camera that encodes by itself delivers; None if it does not."""
        if self._sent is None or self._plan.camera.graph.passes is None:
            return None
        from runner.gst.passed import PassedStream

        return PassedStream(self._sent.get_static_pad("sink"), self._plan.camera, self._on_report)

    @property
    def is_opening(self) -> bool:
        """Whether its source still waits for the first answers of an IP camera, and for how long is its own matter."""
        return bool(self._source and self._source.is_opening)

    def has_waited(self, seconds: float) -> bool:
        """Whether it has waited so long for one of these answers."""
        return bool(self._source and self._source.waiting(seconds))

    @property
    def source_fault(self) -> str | None:
        """The fault of a source that is frozen, is not there yet, or repeats a picture; None if it works."""
        failed = self._source.fault if self._source else None
        return failed or self._repeats.outage.reason

    def turn(self, changed: Mapping[str, KnobValue]) -> None:
        """Set the knobs whose wanted values have changed."""
        allowed = self._allowed(changed)
        if allowed:
            self.knobs.turn(allowed)

    def catch_up(self) -> None:
        """Set the knobs that were turned while the pipeline was built, before `turn` could reach it."""
        known, wanted = self._first, self._wanted()
        while wanted != known:  # again: `turn` may have been called with newer values meanwhile
            self.turn({knob: value for knob, value in wanted.items() if known.get(knob) != value})
            known, wanted = wanted, self._wanted()

    def _allowed(self, values: Mapping[str, KnobValue]) -> Mapping[str, KnobValue]:
        """Until the first frame has been sent, `sending` is not changed.

        A gate that is closed from the start passes no caps, so a client's DESCRIBE would wait for them forever.
        """
        return values if self._started else {knob: value for knob, value in values.items() if knob != "sending"}

    @property
    def paused(self) -> bool:
        """Whether the gate was read back as closed."""
        return self.knobs.applied.get("sending") is False

    @property
    def kbps(self) -> int:
        """The encoder's bitrate as read back, 0 before it is set."""
        bitrate = self.knobs.applied.get("bitrate", 0)
        return bitrate if isinstance(bitrate, int) else 0

    def push(self, frame: Any, form: str | None = None, captured: float | None = None) -> bool:
        """Hand one frame to the source, which must be an appsrc; see `runner.gst.pushed`.

        raises  ValueError
        """
        from runner.gst.pushed import PushedPictures

        camera = self._plan.camera
        self._pushed = self._pushed or PushedPictures(camera.source_size, camera.fps)
        source = self._pipeline.get_by_name(self._plan.source[0].name)
        try:
            return self._pushed.push(source, frame, form, captured)
        except ValueError as error:
            raise ValueError(f"camera {camera.name}: {error}") from None

    def push_shared(self, picture: SharedPicture) -> bool:
        """Hand one picture in shared memory to the source, which must be an appsrc."""
        from runner.gst.shared import push_shared

        self.untimed = picture.untimed
        return push_shared(self._pipeline.get_by_name(self._plan.source[0].name), picture, self._plan.camera.fps)

    def look(self) -> None:
        """Look what has passed; many times a second, from one thread. After an exception the encoder's pace is 1."""
        try:
            self._look(time.monotonic())
        except Exception:
            if self.knobs.pace != 1:
                self.knobs.pace = 1.0  # nothing would lower it once the camera is faster
            raise

    def _look(self, now: float) -> None:
        self._limits.look(now)
        if self.knobs.dropped and self.knobs.fps < self._plan.camera.fps:
            self.knobs.dropped.look(now)
        if self._entered:
            self._look_at_rate(now, passed_counts(self._entered)[0])
        if self.sent_frames:
            self.sent_frames.look()
        if self.is_joined and self.requests.grant_key_unit():
            self.is_joined = False
            self.send_key_frame()
        self._ask_for_wave(now)
        if self._passed:
            self._passed.look()

    def _look_at_rate(self, now: float, entered: int) -> None:
        """entered: pictures before the encoder. Behind it, those that it leaves out would count as the camera's."""
        fps = float(self.knobs.fps)
        if self._rate.fps != fps:
            self._rate = PictureRate(fps)
        was_slow, silent_s = self.slow_fps, self._rate.silent_s(now)
        is_held_up = self._held_up.look(silent_s > self.frame_s)
        self._rate.look(now, entered, is_held_up)
        if self._rate.pace != self.knobs.pace:
            self.knobs.pace = self._rate.pace
        was_gap, self._is_gap = self._is_gap, not is_held_up and silent_s > max(GAP_S, GAP_INTERVALS * self.frame_s)
        if self._is_gap and not was_gap and self._restarts_after_gaps:
            self.knobs.restart_encoder("size")
        rate = f"{fps:g} Hz"
        if self.slow_fps and not was_slow:
            self._on_report(f"{self.slow_fps} of {rate}")
        elif was_slow and self._rate.is_steady:
            self._on_report(f"{rate} again")

    @property
    def slow_fps(self) -> int | None:
        """The rate of its pictures, Hz, if that has been well below the camera's for a while; else None."""
        slow = self._rate.slow_fps
        return None if slow is None else max(1, round(slow))

    def reading(self) -> CameraReading:
        """What its elements say now."""
        return CameraReading(
            applied=dict(self.knobs.applied),
            encoded=self.counters(),
            fault=self.source_fault,
            untimed=self.untimed,
            slow_fps=self.slow_fps,
            placed=self.knobs.placed is not None,
        )

    def counters(self) -> EncoderCounts:
        """What the encoder has output so far, counted in C."""
        return EncoderCounts(*passed_counts(self._sent)) if self._sent else NOTHING_ENCODED

    @property
    def frame_s(self) -> float:
        """Interval between two frames."""
        return 1 / float(self.knobs.fps)

    def drop_queued_packet(self) -> None:
        """Drop the packet queued for an interleaved viewer, if any."""
        drop_queued_packet(self._pipeline)

    def send_key_frame(self, *, begin_anew: bool = False) -> None:
        """Make the encoder send a key frame next, if the graph states how.

        begin_anew  and send no earlier packet again
        """
        if begin_anew:
            self.requests.begin_anew()
        match self._plan.camera.graph.key_frame:
            case "caps":
                self.knobs.restart_encoder("size")
            case "event":
                self._force_key_unit()

    def _force_key_unit(self) -> None:
        if self._sent:
            event = GstVideo.video_event_new_upstream_force_key_unit(Gst.CLOCK_TIME_NONE, True, 0)
            self._sent.get_static_pad("sink").push_event(event)

    def _ask_for_wave(self, now: float) -> None:
        """Let x264 begin a refresh wave, if one is due. While it is on its way, another one would begin after it."""
        interval = self.knobs.applied.get("wave_s")
        if isinstance(interval, Fraction) and now - self._waved >= interval and not self._rate.silent_s(now) > 1:
            self._waved = now
            self._force_key_unit()

    def stages(self) -> SenderStages | None:
        """How long the last sampled picture took to leave the encoder; a few times a second, from one thread.

        None: unknown, for example while nothing is sent
        """
        self._repeats.check_next()
        return self._encoder.take()

    def _on_first_packet(self, _pad: Gst.Pad, _packet: PassingBuffer) -> bool:
        """From a streaming thread."""
        self._started = True
        _NOT_RECONFIGURED.add_to(self._elements[0].get_static_pad("sink"))
        known: Mapping[str, KnobValue] = {}
        while (wanted := self._wanted()).get("sending") != known.get("sending"):  # `turn` may set a newer one meanwhile
            known = wanted
            self.knobs.turn({"sending": wanted["sending"]})
        return True


def _repeated_sets(plan: Plan, sent: Gst.Element | None) -> RepeatedSets | None:
    from runner.gst.repeated_sets import RepeatedSets

    return RepeatedSets.of(plan, sent)


def _count_before(encoder: Gst.Element) -> Gst.Element:
    """Put an identity in front of the encoder of a pipeline that does not play yet, which counts its pictures."""
    counter, entry = Gst.ElementFactory.make("identity"), encoder.get_static_pad("sink")
    above = entry.get_peer()
    encoder.get_parent().add(counter)
    above.unlink(entry)
    above.link(counter.get_static_pad("sink"))
    counter.get_static_pad("src").link(entry)
    return counter


def encrypt(pipeline: Gst.Bin, passphrase: str) -> None:
    """Set the passphrase of the pipeline's SRT elements.

    raises  RunError if it has no SRT element: its transport cannot be encrypted
    """
    found = [element for element in pipeline.iterate_recurse() if element.find_property("passphrase")]
    for element in found:
        element.set_property("passphrase", passphrase)
        element.set_property("pbkeylen", SRT_KEY_BYTES)
    if not found:
        raise RunError("with keys only RTSP and SRT are possible: this graph's transport is not encrypted")
