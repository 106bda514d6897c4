"""The only interface to GStreamer: builds plans, executes commands, reports the applied values.

Nothing else imports `gi`, and nothing in runner/gst/ is imported from anywhere else.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

from runner.core.budget import SOUND
from runner.core.commands import Command, KnobValue
from runner.core.decision import NOTHING
from runner.errors import suggest
from runner.graph import Plan
from runner.gst import TYPELIBS, GLib, Gst
from runner.gst.arrivals import take_arrivals
from runner.gst.clocks import captured_at
from runner.gst.credentials import Login
from runner.gst.glib_thread import GlibThread
from runner.gst.lost import LostCameras
from runner.gst.machine import check_machine, stream_problem, with_clip_range, with_lossless, with_video
from runner.gst.outage import ReportMerger
from runner.gst.pipeline import CameraPipeline, OnReport, Openings
from runner.gst.probes import PassingBuffer
from runner.gst.receiver import OnPicture, OnUnit, Receiver, Reception
from runner.gst.recorder import Recorded, Stage
from runner.gst.registry import (
    LIVE,
    check_operator,
    check_plan,
    check_recorders,
    check_vehicle,
    versions,
)
from runner.gst.rtspsrc import limit_teardown
from runner.gst.server import CameraServer
from runner.gst.supervised import CameraCaller
from runner.gst.timers import Guarded, every, later
from runner.gst.video_files import VideoFile, VideoFiles
from runner.gst.watched import WatchedSource, prepare_source
from runner.records.reception import Arrivals, SentFrame, UplinkReceived, UplinkSent
from runner.records.vehicle import CameraReading, SenderStages, SoundReading, VoiceReading
from runner.settings import Media, Uplink
from runner.system.camera_control import CameraControls

if TYPE_CHECKING:
    from runner.gst.clip_writer import write_clip
    from runner.gst.encoded_again import read_again
    from runner.gst.first_look import first_look
    from runner.gst.lanes import run_lanes
    from runner.gst.lossless import LosslessFiles
    from runner.gst.parameter_sets import parameter_set_notes
    from runner.gst.pictures import decode_video
    from runner.gst.received_uplinks import Addresses
    from runner.gst.recording_side import RecordingSide
    from runner.gst.secure import StreamLogin
    from runner.gst.sequence import discover
    from runner.gst.sound_pipeline import SoundPipeline
    from runner.gst.sound_receiver import OnSamples, OnSound, SoundPacket, SoundReceiver, SoundReception
    from runner.gst.video_reader import Unit, read_video
    from runner.gst.voice_sender import VoiceSender
    from runner.ros.cameras import SharedPicture
    from runner.security.keyring import Keyring
    from runner.sound import SoundPlan
    from runner.voice import VoicePlan

__all__ = [
    "LIVE",
    "TYPELIBS",
    "LosslessFiles",
    "OnSound",
    "OnUnit",
    "OperatorSide",
    "Reception",
    "Recorded",
    "RecordingSide",
    "SoundPacket",
    "SoundReception",
    "Stage",
    "Unit",
    "VehicleSide",
    "VideoFiles",
    "VoiceSender",
    "check_machine",
    "check_operator",
    "check_plan",
    "check_recorders",
    "check_vehicle",
    "decode_video",
    "discover",
    "first_look",
    "parameter_set_notes",
    "read_again",
    "read_video",
    "run_lanes",
    "versions",
    "write_clip",
]

SELDOM = {  # by name, its module
    "RecordingSide": "recording_side",
    "LosslessFiles": "lossless",
    "OnSound": "sound_receiver",
    "SoundPacket": "sound_receiver",
    "SoundReception": "sound_receiver",
    "decode_video": "pictures",
    "discover": "sequence",
    "first_look": "first_look",
    "parameter_set_notes": "parameter_sets",
    "read_again": "encoded_again",
    "VoiceSender": "voice_sender",
    "read_video": "video_reader",
    "run_lanes": "lanes",
    "write_clip": "clip_writer",
}
LOOK_MS, TAILS_MS = 20, 10  # between two looks which frames have left; between two checks for frames without an end


def _captured(pad: Gst.Pad, unit: PassingBuffer) -> float | None:
    return None if unit.pts is None else captured_at(pad, unit.pts)


class VehicleSide:
    """All cameras of the vehicle, streaming. Stores the wanted value of each knob, to set it again after a rebuild.

    on_report  called, from another thread, when a camera's pipeline starts, stops or fails
    video      where to store the sent streams; None: nowhere
    lossless   where to keep whole pictures of the cameras whose plans say so; None: nowhere
    keyring    of this vehicle: viewers authenticate, and everything is encrypted; None: neither
    lost       by camera whose source does not open, why: it is tried again, and started once it does
    uplinks    by name, see `runner.gst.uplinks`; none: the system's routes decide
    may_listen  whether viewers may connect at an address of an uplink, too
    sound      served beside the cameras; None: there is none
    voice      played of the operator in control; None: there is no loudspeaker
    raises     RunError if the port is in use, or a plugin that `video` needs is not installed

    `on_turned` is called, from any thread, after knobs were set and read back: `applied` may have changed.
    """

    def __init__(
        self,
        plans: Sequence[Plan],
        media: Media,
        on_report: OnReport,
        video: VideoFiles | None = None,
        keyring: Keyring | None = None,
        lost: Mapping[str, str] = NOTHING,
        uplinks: Mapping[str, Uplink] = NOTHING,
        may_listen: Callable[[str], bool] = lambda address: False,
        sound: SoundPlan | None = None,
        voice: VoicePlan | None = None,
        lossless: LosslessFiles | None = None,
    ) -> None:
        self._on_report, self._video = on_report, video
        kind: Any = uplinks and import_module("runner.gst.uplinks").VehicleUplinks
        self._uplinks = kind(uplinks, on_report, may_listen) if kind else None
        passphrase = keyring.watched_passphrase(lambda what: on_report("keys", what)).get if keyring else None
        plans = with_clip_range(with_lossless(with_video(plans, video, "vehicle"), lossless))
        self._kept = lossless.cameras(plans, on_report) if lossless else None
        self._lock, self._glib = threading.Lock(), GlibThread()
        self._logins = {p.camera.name: Login(p, partial(on_report, p.camera.name)) for p in plans}
        self._left_out: dict[str, set[str]] = {plan.camera.name: set() for plan in plans}  # decoders
        self._wanted: dict[str, dict[str, KnobValue]] = {plan.camera.name: {} for plan in plans}
        self.on_turned: Callable[[], None] = lambda: None
        self._controls = CameraControls({p.camera.name: p.command for p in plans}, self._on_knobs_turned, on_report)
        self._server: CameraServer | None = None
        streams = (*plans, *((sound,) if sound else ()))
        self._lost = LostCameras((*streams, *((voice,) if voice else ())), lost, stream_problem, self._on_found)
        openings = Openings(self._build, self._lost, on_report, self._refusal, self._uplinks)
        self._callers = {p.camera.name: CameraCaller(p, openings, passphrase) for p in plans if not p.serves}
        self._looks = [self._guarded_look(plan.camera.name) for plan in plans]
        if self._uplinks:
            self._looks.append(Guarded(self._uplinks.look, lambda what: on_report("uplinks", what)))
        served = [plan for plan in streams if not isinstance(plan, Plan) or plan.serves]

        def start() -> None:
            if served or voice:
                self._server = CameraServer(served, media, openings, keyring, voice)
            for name, caller in self._callers.items():
                if name not in lost:
                    caller.start()
            self._looking = every(LOOK_MS, self._look, lambda what: on_report("senders", what))

        self._glib.call("starting the cameras", start)

    @property
    def beat(self) -> float:
        """When the thread that accepts viewers and watches cameras last ran, time.monotonic."""
        return self._glib.beat

    def turn(self, commands: Iterable[Command]) -> None:
        """Execute commands; those for one camera take effect between the same two frames. Returns immediately."""
        changed: dict[str, dict[str, KnobValue]] = {}
        for command in commands:
            changed.setdefault(command.camera, {})[command.knob] = command.value
        self._controls.turn(changed)
        for name, values in changed.items():
            if isinstance(uplinks := values.pop("uplinks", None), tuple):
                self.carry({name: [str(each) for each in uplinks]})
            with self._lock:
                self._wanted[name] |= values
            if pipeline := self._pipeline(name):
                pipeline.turn(values)

    def carry(self, placed: Mapping[str, Collection[str]]) -> None:
        """Set which uplinks carry these cameras; all do until then. Returns immediately."""
        if self._uplinks:
            self._uplinks.carry(placed)

    def sent(self) -> dict[str, dict[str, UplinkSent]]:
        """By camera and uplink, what was sent, see `runner.gst.uplinks`."""
        return self._uplinks.counts() if self._uplinks else {}

    def give_control(self, drivers: Sequence[str], in_control: str = "") -> None:
        """Set who drives, or is about to, whose viewers are always admitted; and who may speak, "" for nobody."""
        if self._server:
            self._server.give_control(drivers, in_control)

    def push(self, camera: str, frame: Any, form: str | None = None, captured: float | None = None) -> bool:
        """Push a frame of a camera whose frames come from Python; see `runner.live.LiveVehicle`."""
        if camera not in self._wanted:
            raise ValueError(f"camera {camera!r}: no such camera{suggest(camera, self._wanted)}")
        pipeline = self._pipeline(camera)
        return pipeline is not None and pipeline.push(frame, form, captured)

    def push_shared(self, camera: str, picture: SharedPicture) -> bool:
        """Push a picture in shared memory, with its capture time; returns False if nobody is watching."""
        pipeline = self._pipeline(camera)
        if pipeline is None:
            os.close(picture.memory)
        return pipeline is not None and pipeline.push_shared(picture)

    def read(self) -> dict[str, CameraReading]:
        """By camera, what its elements say now. From any thread."""
        lost, server = self._lost.reasons(), self._server
        copies, refused = (server.copies(), server.admission.refused()) if server else (NOTHING, NOTHING)
        return {n: self._read(n, lost.get(n), copies.get(n, 0), refused.get(n, NOTHING)) for n in self._wanted}

    def read_sound(self) -> SoundReading:
        """What its elements say now. From any thread."""
        return self._server.read_sound() if self._server else SoundReading()

    def read_voice(self) -> VoiceReading:
        """What is known of the loudspeaker."""
        loudspeaker = self._server and self._server.loudspeaker
        return loudspeaker.reading() if loudspeaker else VoiceReading()

    def stages(self) -> dict[str, SenderStages]:
        """By camera, latency from capture to the encoder, and through it, ms; unknown ones are omitted.

        To be called a few times a second, from one thread: each call also checks the next picture of each source.
        """
        pipelines = {name: pipeline for name in self._wanted if (pipeline := self._pipeline(name))}
        return {name: stages for name, pipeline in pipelines.items() if (stages := pipeline.stages())}

    def sent_frames(self) -> dict[str, list[SentFrame]]:
        """By camera, when the frames left that were seen since the last call. From any one thread."""
        return {
            name: pipeline.sent_frames.take()
            for name in self._wanted
            if (pipeline := self._pipeline(name)) and pipeline.sent_frames
        }

    def send_key_frames(self, cameras: Iterable[str], *, begin_anew: bool = False) -> None:
        """Make the encoders of these cameras send key frames, as their graphs allow; unknown cameras are ignored.

        begin_anew  and send no earlier packet again
        """
        for name in cameras:
            if name in self._wanted and (pipeline := self._pipeline(name)):
                pipeline.send_key_frame(begin_anew=begin_anew)

    def stop(self) -> None:
        self._lost.stop()
        self._controls.stop()

        def stop() -> None:
            GLib.source_remove(self._looking)
            for caller in self._callers.values():
                caller.stop()
            if self._server:
                self._server.stop()

        self._glib.end(stop)
        if self._kept:
            self._kept.stop()

    def _read(self, name: str, lost: str | None, copies: int, refused: Mapping[str, str]) -> CameraReading:
        pipeline, refusal = self._pipeline(name), self._refusal(name)
        seen = pipeline.reading() if pipeline else CameraReading()
        applied = self._controls.applied(name, seen.applied) if pipeline else NOTHING
        return seen._replace(applied=applied, fault=seen.fault or refusal, lost=lost, copies=copies, refused=refused)

    def _on_found(self, name: str) -> None:
        """From the thread that tries again. A viewer makes the server open its camera."""
        if name in self._callers:
            self._glib.call(f"starting {name}", self._callers[name].start)

    def _build(self, pipeline: Gst.Bin, plan: Plan | SoundPlan) -> CameraPipeline | SoundPipeline:
        """Set up a newly built pipeline, with every knob at its wanted value."""
        name = plan.name
        report = partial(self._on_report, name)
        if not isinstance(plan, Plan):
            from runner.gst.sound_pipeline import SoundPipeline

            return SoundPipeline(pipeline, plan, report, self._uplinks.of(name) if self._uplinks else None)
        source = None
        limit_teardown(pipeline)
        if plan.frozen_s is not None:
            source = WatchedSource(plan, self._logins[name], self._left_out[name], report)
            source.install(pipeline, plan)
        else:
            prepare_source(pipeline, plan, self._logins[name], self._left_out[name], report)
        if self._video:
            VideoFile(self._video, name, "vehicle", _captured, self._on_report).follow(pipeline)
        if self._kept:
            self._kept.follow(name, pipeline)
        return CameraPipeline(
            pipeline,
            plan,
            lambda: self._wanted_of(name),
            self._on_knobs_turned,
            report,
            source,
            self._uplinks.of(name) if self._uplinks and plan.serves else None,
        )

    def _refusal(self, camera: str) -> str | None:
        """Why a camera must not be asked now: it refuses the login, and would lock the vehicle out."""
        login = self._logins.get(camera)  # sound needs none
        return login.refusal if login else None

    def _look(self) -> None:
        """Look which pictures of each camera have passed since it looked last."""
        for look in self._looks:
            look()

    def _guarded_look(self, name: str) -> Guarded:
        """That of one camera, whose fault concerns no other."""

        def look() -> None:
            if pipeline := self._pipeline(name):
                pipeline.look()

        return Guarded(look, lambda what: self._on_report(name, f"its pictures are not counted: {what}"))

    def _on_knobs_turned(self) -> None:
        self.on_turned()  # looked up now: it may have been set after the pipeline was built

    def _wanted_of(self, name: str) -> Mapping[str, KnobValue]:
        with self._lock:
            return dict(self._wanted[name])

    def _pipeline(self, name: str) -> CameraPipeline | None:
        if name in self._callers:
            return self._callers[name].pipeline
        found = self._server.pipelines.get(name) if self._server else None
        return found if isinstance(found, CameraPipeline) else None


class OperatorSide:
    """All cameras of the vehicle, received and decoded.

    on_report   called, from another thread, with cameras and what happened to them
    on_unit     called, from the camera's streaming thread, with each access unit received
    on_picture  called, from the camera's streaming thread, with each decoded picture
    arrivals    record when each access unit arrived, for the samples
    video       where to store the received streams; None: nowhere
    operator    id of the operator on the control link, which the vehicle admits first; "" for another viewer
    keyring     of this operator; None: no authentication
    vehicle     its name, which its certificate must state
    uplinks     addresses of the vehicle by uplink, as far as known; None: it has one way
    cameras     those to receive until `receive` names others; None: all
    sound       received while any camera is, or without cameras; None: there is none
    on_sound    called, from its streaming thread, with each packet of it
    on_samples  called, from its streaming thread, with what is decoded of it
    raises      RunError if a plugin that `video` needs is not installed
    """

    def __init__(
        self,
        plans: Sequence[Plan],
        on_report: OnReport,
        on_unit: OnUnit | None = None,
        on_picture: OnPicture | None = None,
        arrivals: bool = False,
        video: VideoFiles | None = None,
        operator: str = "",
        keyring: Keyring | None = None,
        vehicle: str = "",
        uplinks: Addresses | None = None,
        cameras: Collection[str] | None = None,
        sound: SoundPlan | None = None,
        on_sound: OnSound | None = None,
        on_samples: OnSamples | None = None,
    ) -> None:
        plans = with_video(plans, video, "operator")
        self._glib = GlibThread()
        self._reports = reports = ReportMerger(on_report)

        def login() -> StreamLogin | None:
            """One for each receiver: it remembers what its last pipeline used."""
            if keyring is None:
                return None
            from runner.gst.secure import StreamLogin

            return StreamLogin(keyring, vehicle, lambda what: reports("keys", what))

        self._receivers = {
            plan.camera.name: Receiver(plan, reports, on_unit, on_picture, arrivals, video, operator, login(), uplinks)
            for plan in plans
        }
        self._running: Mapping[str, Receiver] = {}  # replaced as a whole: other threads read it
        self._sound: SoundReceiver | None = None
        self._hears = False  # whether it is received
        if sound:
            kind: Any = import_module("runner.gst.sound_receiver").SoundReceiver
            self._sound = kind(sound, reports, on_sound, on_samples, operator, login(), uplinks)
        self.sound: SoundReception | None = None  # as last sampled; None: there is none

        def start() -> None:
            self._run(frozenset(self._receivers if cameras is None else cameras))
            self._tails = every(TAILS_MS, self._request_tails, lambda what: on_report("receivers", what))

        self._glib.call("starting the receivers", start)

    def receive(self, cameras: Collection[str]) -> None:
        """Receive these cameras, and no others: of those the vehicle sends nothing here. Returns immediately."""
        later(0, partial(self._run, frozenset(cameras)))

    def _run(self, cameras: Collection[str]) -> None:
        before, running = self._running, {n: r for n, r in self._receivers.items() if n in cameras}
        for name in running.keys() - before.keys():
            self._receivers[name].start()
        self._running = running
        for name in before.keys() - running.keys():
            self._receivers[name].stop()
        heard, self._hears = self._hears, bool(running) or not self._receivers
        if self._sound and self._hears != heard:
            (self._sound.start if self._hears else self._sound.stop)()

    def sample(self, sending: Mapping[str, bool], anew: bool = False) -> dict[str, Reception]:
        """Reception of each camera, and of the sound, which is `sound` then; to be called a few times a second.

        sending  which cameras should send, likewise the sound; a silent one that should is rebuilt. Unknown: omitted
        anew     ask at once for those that the vehicle has refused: it may decide otherwise now
        raises   RunError if GStreamer hangs
        """

        def sample() -> dict[str, Reception]:
            if self._sound:
                hears = self._hears
                self.sound = self._sound.sample(sending.get(SOUND), anew) if hears else self._sound.stopped_at
            return {
                name: receiver.sample(sending.get(name), anew) if name in self._running else receiver.stopped_at
                for name, receiver in self._receivers.items()
            }

        return self._glib.call("reading the receivers' counters", sample)

    def admit(self, uplinks: Addresses) -> None:
        """Receive from these addresses of the vehicle, by uplink, and from no others. From any thread."""
        for receiver in (*self._receivers.values(), *((self._sound,) if self._sound else ())):
            receiver.admit(uplinks)

    def received(self) -> dict[str, dict[str, UplinkReceived]]:
        """By camera and uplink, what was received since the camera's pipeline was built; none without uplinks."""
        return {name: each.rtp.uplinks.counts() for name, each in self._receivers.items() if each.rtp.uplinks}

    def _request_tails(self) -> None:
        for receiver in self._running.values():
            receiver.rtp.request_tails()

    def take_arrivals(self) -> dict[str, Arrivals]:
        """Arrivals since the last call, by uplink, "" if the vehicle has one; to be called from one thread."""
        return take_arrivals(self._running)

    def stop(self) -> None:
        def stop() -> None:
            GLib.source_remove(self._tails)
            self._run(())

        self._glib.end(stop)
        self._reports.flush()


if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """What is used offline only, or with sound only, and not loaded otherwise."""
        if name not in SELDOM:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"runner.gst.{SELDOM[name]}"), name)
