"""The operator's side of voice: what the page's microphone hears goes to the vehicle's loudspeaker."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any

from gi.repository import Gst, GstRtsp

from runner.core.budget import SAMPLE_BYTES, VOICE, VOICE_HZ
from runner.gst.srtp import set_master_key, write_keys
from runner.gst.supervised import SupervisedPipeline
from runner.gst.timers import later
from runner.gst.viewers import user_agent
from runner.system.lateness import Lateness
from runner.voice import MICROPHONE, VoicePlan

if TYPE_CHECKING:
    from runner.gst.secure import StreamLogin
    from runner.security.keyring import Keyring

LATE_S = 0.3  # what has come from the page so much later than usual is not sent: the key may have been released
UNHEARD_S = 3.0  # the client does not notice that the vehicle has ended its connection: the vehicle's state says so
RECORDING = 2  # steps after which the client sends
SILENT_MS = 20  # sent once connected: the client announces its stream when the first packet is there


class VoiceSender:
    """Connects while this operator is in control, so that a key press is heard at once. From any thread.

    on_report  called with what happened to it
    operator   id of the operator on the control link
    keyring    of this operator; None: no authentication
    vehicle    its name, which its certificate must state
    """

    def __init__(
        self,
        plan: VoicePlan,
        on_report: Callable[[str, str], None],
        operator: str,
        keyring: Keyring | None = None,
        vehicle: str = "",
    ) -> None:
        self._plan, self._operator = plan, operator
        self._login: StreamLogin | None = None
        if keyring:
            from runner.gst.secure import StreamLogin

            self._login = StreamLogin(keyring, vehicle, lambda what: on_report("keys", what))
        self._on_report = partial(on_report, VOICE)
        self._supervised = SupervisedPipeline(plan.sender, self._on_built, self._on_report)
        self._wanted = self._connected = False
        self._heard_at = 0.0  # when the vehicle last had it, or could not: time.monotonic
        self._steps = 0  # of the client, towards sending
        self._began = 0.0  # this pipeline, time.monotonic
        self._source: Any = None
        self._clock, self._lateness = 0.0, Lateness()

    def follow(self, *, may_speak: bool, is_heard: bool) -> None:
        """Be connected, or not, from now on. To be called a few times a second: it notices what has ended.

        is_heard  whether the vehicle states that this operator is connected
        """
        later(0, partial(self._follow, may_speak, is_heard))

    def _follow(self, may_speak: bool, is_heard: bool) -> None:
        now = time.monotonic()
        if is_heard or not self._connected:
            self._heard_at = now
        before, self._wanted = self._wanted, may_speak
        if may_speak and not before:
            self._supervised.start()
        elif before and not may_speak:
            self._connected = False
            self._supervised.stop()
        elif may_speak and self._login and (withdrawn := self._login.withdrawn()):
            self._supervised.restart(withdrawn)
        elif now - self._heard_at > UNHEARD_S:
            self._connected = False
            self._supervised.restart("the vehicle has ended the connection")

    def push(self, samples: bytes, sent: float, clock: float = 0.0) -> None:
        """Send what was spoken; dropped while the vehicle is not connected, and if it is old.

        samples, clock  as of `runner.operator.live.LiveOperator.speak`
        sent            when it was spoken
        """
        now = time.monotonic()
        if clock != self._clock:
            self._clock, self._lateness = clock, Lateness()
        late_s = self._lateness.add(sent, now)
        if late_s < LATE_S and self._connected:
            self._source.emit("push-buffer", _buffer(samples, now - late_s - self._began))

    def _on_built(self, pipeline: Gst.Pipeline) -> None:
        self._connected, self._steps, self._began = False, 0, time.monotonic()
        self._source, client = pipeline.get_by_name(MICROPHONE), pipeline.get_by_name(self._plan.operator[-1].name)
        profiles = GstRtsp.RTSPProfile
        client.set_property("profiles", profiles.SAVP if self._login else profiles.AVP)
        client.set_property("protocols", GstRtsp.RTSPLowerTrans.UDP)  # see `runner.gst.loudspeaker`
        client.set_property("user-agent", user_agent(self._operator))
        client.connect("update-sdp", _join_keys)
        pipeline.connect("deep-element-added", self._on_element)
        pipeline.get_bus().connect("message::progress", self._on_progress, pipeline)
        if self._login and (problem := self._login.prepare(pipeline, client)):
            self._on_report(problem)
        self._source.emit("push-buffer", _buffer(bytes(VOICE_HZ * SAMPLE_BYTES * SILENT_MS // 1000), 0.0))

    def _on_element(self, _pipeline: Gst.Bin, _parent: Gst.Bin, element: Gst.Element) -> None:
        """Of those that the client adds."""
        if element.get_factory() and element.get_factory().get_name() == "srtpenc":
            set_master_key(element)
        if element.find_property("qos-dscp"):
            element.set_property("qos-dscp", self._plan.dscp)
        if element.find_property("processing-deadline"):
            element.set_property("sync", False)  # or it would hold packets until their time: pure latency

    def _on_progress(self, _bus: Gst.Bus, message: Gst.Message, pipeline: Gst.Pipeline) -> None:
        """It says so before it announces the stream, and again once the vehicle has set it up."""
        _, code, _ = message.parse_progress()
        if code == "record" and self._source.get_parent() is pipeline:
            self._steps += 1
            if self._steps == RECORDING:
                self._connected = True
                self._supervised.note_working()


def _buffer(samples: bytes, at_s: float) -> Gst.Buffer:
    """With its time: when it was spoken, and not when it arrives here."""
    buffer = Gst.Buffer.new_wrapped(samples)
    buffer.pts = round(at_s * Gst.SECOND)
    buffer.duration = Gst.SECOND * len(samples) // (SAMPLE_BYTES * VOICE_HZ)
    return buffer


def _join_keys(_client: Gst.Element, description: Any) -> None:
    with suppress(IndexError):
        write_keys(description.get_media(0))
