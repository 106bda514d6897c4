"""Pipelines with their own network elements: they run independently and are rebuilt when they fail."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from gi.repository import GLib, Gst

from runner.graph import Plan
from runner.gst.aside import HUNG, set_state_in_thread
from runner.gst.outage import Outage
from runner.gst.pipeline import CameraPipeline, Openings, encrypt
from runner.gst.probes import BufferProbe, PassingBuffer
from runner.gst.rtspsrc import STREAM_ENDED
from runner.gst.timers import Delayed, every, later
from runner.gst.video_files import concerns_file

RETRY_S = 1.0  # minimum time between the starts of two attempts
STOPPED_S = 2.0  # how long the next pipeline waits for the previous one to release its port
STOPPING_S = 0.02  # between two checks
WATCH_MS = 250  # how often a caller's acknowledgements are counted
UNACKNOWLEDGED_S = 1.5  # without an acknowledgement for this long, packets are not delivered; SRT itself needs 5 s
PATIENCE_S = 5.0  # the other side may start later: until then a waiting side reports nothing


class SupervisedPipeline:
    """A pipeline that is torn down and rebuilt when it fails or ends; it is never repaired in place.

    All methods are called in the thread of GLib's main loop. State changes run in separate threads, so that an element
    that deadlocks does not delay the others.

    on_built   called with each new pipeline before it starts; returns the pad whose first buffer shows that it works,
               None: `note_working` is called then
    on_report  called once with each reason, until the pipeline works again
    rebuilt    how often a pipeline that had worked was rebuilt
    must_wait   whether it must not be built again yet
    is_excused  whether an error, as a message, is reported elsewhere
    before_stop  called before this pipeline is stopped, in the thread that stops it
    """

    def __init__(
        self, launch: str, on_built: Callable[[Gst.Pipeline], Gst.Pad | None], on_report: Callable[[str], None]
    ) -> None:
        self._launch, self._on_built, self._on_report = launch, on_built, on_report
        self._pipeline: Gst.Pipeline | None = None
        self._change: threading.Thread | None = None  # the last state change of the last pipeline
        self._retry: Delayed | None = None
        self._first: Gst.Pad | None = None  # whose first buffer shows that this pipeline works
        self._begun = self._ended = time.monotonic()  # start and end of the last attempt
        self._lost = self._begun  # when a pipeline last worked
        self._works = self._worked = False  # this pipeline, any pipeline
        self._stopped = True
        self._outage = Outage(on_report)
        self.rebuilt = 0
        self.must_wait: Callable[[], bool] = lambda: False
        self.is_excused: Callable[[Gst.Message], bool] = lambda _error: False
        self.before_stop: Callable[[], object] = lambda: None

    def start(self) -> None:
        """Build and start it, also again after `stop`: then once the previous pipeline has released its port."""
        self._stopped = False
        self._begin()

    def _build(self) -> None:
        pipeline = Gst.parse_launch(self._launch)
        if not isinstance(pipeline, Gst.Pipeline):  # a single element is returned without a pipeline
            element, pipeline = pipeline, Gst.Pipeline.new(None)
            pipeline.add(element)
        self._pipeline, self._begun, self._works = pipeline, time.monotonic(), False
        bus = pipeline.get_bus()
        bus.add_signal_watch()
        bus.connect("message::error", self._on_failed)
        bus.connect("message::eos", self._on_failed)
        self._first = self._on_built(pipeline)
        if self._first:
            self._probe = BufferProbe(self._first, self._on_first_buffer)
            self._probe.arm()
        self._change = set_state_in_thread(pipeline, Gst.State.PLAYING)

    def stop(self) -> None:
        if self._retry:
            self._retry.cancel()
            self._retry = None
        self._stopped, self._ended = True, time.monotonic()
        self._tear_down()

    def _tear_down(self) -> None:
        if self._pipeline is not None:
            self._pipeline.get_bus().remove_signal_watch()
            self._change = set_state_in_thread(
                self._pipeline, Gst.State.NULL, lambda: self._on_report(HUNG), self._change, self.before_stop
            )
            self._pipeline = None

    def hurry(self) -> None:
        """If it waits to be built again, do so now."""
        if self._retry:
            self._retry.cancel()
            self._begin()

    def restart(self, why: str | None) -> None:
        """Tear down now, rebuild soon; nothing happens if it is stopped.

        why  is reported; None: it is not
        """
        if self._retry or self._stopped:
            return
        now = time.monotonic()
        if self._works:
            self.rebuilt += 1
            self._lost = now
        if why and (self._worked or now - self._lost > PATIENCE_S):
            self._outage.report_failure(why, self._lost)
        self._ended = now
        self._tear_down()
        self._retry = later(max(0.0, self._begun + RETRY_S - now), self._begin)

    def _begin(self) -> None:
        if self._change and self._change.is_alive() and time.monotonic() - self._ended < STOPPED_S:
            self._retry = later(STOPPING_S, self._begin)
            return
        if self.must_wait():
            self._retry = later(RETRY_S, self._begin)
            return
        self._retry = None
        self._build()

    def _on_failed(self, _bus: Gst.Bus, message: Gst.Message) -> None:
        if concerns_file(message) or self._retry or self._stopped:
            return
        if message.type != Gst.MessageType.ERROR:
            self.restart(STREAM_ENDED)
        else:
            self.restart(None if self.is_excused(message) else message.parse_error()[0].message)

    def _on_first_buffer(self, pad: Gst.Pad, _buffer: PassingBuffer) -> bool:
        """From a streaming thread."""
        later(0, partial(self._on_working, pad))
        return True

    def _on_working(self, pad: Gst.Pad) -> None:
        if pad is self._first and self._pipeline is not None:
            self.note_working()

    def note_working(self) -> None:
        """This pipeline works."""
        self._works = self._worked = True
        self._outage.report_recovery(time.monotonic())


class _AcknowledgementWatch:
    """Checks the statistics of an SRT caller for acknowledgements; other elements are not watched.

    When the vehicle's address or its NAT mapping changes, the peer drops the packets, but SRT (1.5) considers the
    connection alive until sixteen timers of 0.3 s have expired, whatever `peeridletimeo` says.
    """

    def __init__(self, element: Gst.Element) -> None:
        self._element = element
        self._watched = element.find_property("stats") is not None
        self._acks = self._sent = 0  # acknowledgements, and packets sent when the last one arrived
        self._since = time.monotonic()  # time of the last acknowledgement, or when there was nothing to acknowledge

    def are_missing(self, now: float) -> bool:
        """Whether packets were sent and none was acknowledged for UNACKNOWLEDGED_S; a few times a second."""
        sent, acks = self._counts()
        if acks != self._acks or sent <= self._sent:
            self._acks, self._sent, self._since = acks, sent, now
        return now - self._since > UNACKNOWLEDGED_S

    def _counts(self) -> tuple[int, int]:
        stats = self._element.get_property("stats") if self._watched else None
        if stats is None or not stats.has_field("packet-ack-received"):  # not connected yet
            return 0, 0
        return stats.get_value("packets-sent"), stats.get_value("packet-ack-received")


class CameraCaller:
    """One camera's supervised pipeline on the vehicle.

    passphrase  returns what encrypts the stream, and may change; None: it is not encrypted
    """

    def __init__(self, plan: Plan, openings: Openings, passphrase: Callable[[], str] | None) -> None:
        self._plan, self._build, self._passphrase = plan, openings.build, passphrase
        self._used = ""  # the passphrase of the current pipeline
        name = plan.camera.name
        self.pipeline: CameraPipeline | None = None
        self._watch: int | None = None  # None: it has not been started
        self._on_fault = lambda what: openings.on_report(name, what)
        self._supervised = SupervisedPipeline(plan.pipeline, self._on_built, self._on_fault)
        self._supervised.must_wait = lambda: openings.refusal(name) is not None

    def start(self) -> None:
        """Start it; a second call has no effect."""
        if self._watch is not None:
            return
        self._supervised.start()
        self._watch = every(WATCH_MS, self._check, self._on_fault)

    def stop(self) -> None:
        if self._watch is None:
            return
        GLib.source_remove(self._watch)
        self.pipeline = None
        self._supervised.stop()

    def _check(self) -> None:
        if self._passphrase and self._passphrase() != self._used:
            self._supervised.restart("there are new keys")
        elif self._acknowledgements.are_missing(time.monotonic()):
            self._supervised.restart(f"nothing was acknowledged for {UNACKNOWLEDGED_S:g} s")

    def _on_built(self, pipeline: Any) -> Gst.Pad:
        if self._passphrase:
            self._used = self._passphrase()
            encrypt(pipeline, self._used)
        built = self._build(pipeline, self._plan)
        assert isinstance(built, CameraPipeline)
        self.pipeline = built
        built.catch_up()
        caller = pipeline.get_by_name(self._plan.vehicle[-1].name)
        self._acknowledgements = _AcknowledgementWatch(caller)
        return caller.get_static_pad("sink")
