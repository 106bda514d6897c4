"""The vehicle's live loop: take an event, step, apply, log, publish. Kept simple; survives exceptions."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

from msgspec import UNSET

from runner.core.commands import Command
from runner.core.driving import Driving
from runner.core.events import (
    NAMES,
    OWN,
    AttentionChanged,
    ClockAdvanced,
    ControlAccepted,
    ControlPassed,
    ControlRestored,
    Departure,
    Event,
    OperatorConnected,
    OperatorDisconnected,
    PositionReported,
    SourceReported,
    SteeringReported,
    describe,
    parse,
)
from runner.core.roles import CONTROL_EVENTS, STOP_REQUESTED
from runner.core.step import Run, start, step
from runner.pqos import Predictions
from runner.records.reception import ReceptionReport, ReceptionReported, SentFrame, UplinkSent
from runner.records.vehicle import CameraTelemetry, Outcome, SenderStages, Telemetry
from runner.schema import event_problem
from runner.settings import Setup
from runner.system.held_up import LateCheck
from runner.system.interfaces import addresses_by
from runner.system.reports import RepeatedReports
from runner.vehicle.access import Access
from runner.vehicle.attention import StatedAttention
from runner.vehicle.holder import NOBODY, Held
from runner.vehicle.inbox import MAX_QUEUED, Answer, Inbox, Item, QueuedReport, Request
from runner.vehicle.noticed import Streams, copies_events, presence_events, source_events
from runner.vehicle.operators import SILENT_S, Operators
from runner.vehicle.publishing import Publish, Publisher
from runner.vehicle.readings import Reader, Readings
from runner.vehicle.refusals import Refusals
from runner.vehicle.repair import KeyFrames, cut_off
from runner.vehicle.replies import Replies
from runner.vehicle.seen import SeenPictures
from runner.vehicle.sending import SendingTimes
from runner.vehicle.uplink import MeasuredUplinks
from runner.vehicle.views import StatedViews

if TYPE_CHECKING:
    from runner.pqos.track import Track

TICK_S = 0.1  # time between clock_advanced events
ASKED_BY = CONTROL_EVENTS | {"control_taken"}  # events that say which operator asks
TELEMETRY_TICKS = 2  # also the vehicle's heartbeat


class Applier(Reader, Protocol):
    """What the loop needs from the streaming side."""

    def turn(self, commands: Iterable[Command]) -> None: ...
    def stages(self) -> Mapping[str, SenderStages]: ...
    def sent_frames(self) -> Mapping[str, Iterable[SentFrame]]: ...
    def sent(self) -> Mapping[str, Mapping[str, UplinkSent]]: ...
    def give_control(self, drivers: Sequence[str], in_control: str) -> None: ...
    def send_key_frames(self, cameras: Iterable[str], *, begin_anew: bool = False) -> None: ...


class Listener(Protocol):
    """What hears of a drive, from the loop's thread: the log."""

    def begin(self) -> None: ...
    def on_step(self, before: Run, event: Event, after: Run) -> None: ...
    def record(self, record: ReceptionReported | Telemetry) -> None: ...


@dataclass
class ControlLoop:
    """Events in, commands out, in one thread. Other threads `post` their events.

    publish      called with the state (decided and applied) whenever it has changed, and telemetry a few times a
                 second; returns False for a record that has to wait because the control link is behind
    on_report    called with one line per event and its result
    access       who may request what
    steering     the angle of a synthetic drive, rad, by time.monotonic, until somebody else reports one; None: not one
    former       who was in control, and who had asked to stop, when this vehicle's last process ended
    on_driving   called, in the loop's thread, with who drives whenever that changes

    An exception in the loop is reported and counted in `errors`; the loop continues. `beat` is when the loop last
    finished a piece of work (time.monotonic), `busy_with` what it is doing.
    """

    setup: Setup
    applier: Applier
    pqos: Predictions
    track: Track | None
    listener: Listener
    publish: Publish
    on_report: Callable[[str], None]
    access: Access
    steering: Callable[[float], float] | None = None
    former: Held = NOBODY
    on_driving: Callable[[Driving], None] = lambda driving: None
    errors: int = 0
    beat: float = 0.0
    busy_with: str = ""
    _stopped: bool = False
    _ticks: int = 0

    def __post_init__(self) -> None:
        vehicle = self.vehicle = self.setup.vehicle
        self._readings = Readings(self.applier, self.setup, self.on_report)
        self._inbox = Inbox()
        self.refusals = Refusals(self._now, self._inbox.is_full, self.on_report)
        self._operators, self._attention, self._replies = Operators(self.setup.expires_s), StatedAttention(), Replies()
        self._pictures, self._views = SeenPictures(vehicle), StatedViews(vehicle)
        self._uplinks, self._sending, self._key_frames = MeasuredUplinks(self.vehicle), SendingTimes(), KeyFrames()
        self._streams = Streams(vehicle.fixed, vehicle.lowest)
        self._publisher = Publisher(self.setup.latency, self.publish)
        self._report_once = RepeatedReports(self.on_report)
        self._began, self._operators_checked = time.monotonic(), 0.0  # when operators were last checked for silence
        self._steered: SteeringReported | None = None  # the last one of the synthetic drive

    def post(self, document: Mapping[str, Any], answer: Answer | None = None) -> None:
        """An event as JSON without `t`, from this process, from any thread.

        answer  called with its outcome: applied, refused, expired or timed out
        """
        self.take(Request("", document, answer))

    def take(self, item: Item) -> None:
        """Queue a request or a report, from any thread; refused if its sender's queue is full."""
        dropped = self._inbox.put(item)
        if isinstance(dropped, QueuedReport):
            self.refusals.reject(dropped.sender)
        elif dropped is item:
            self.refusals.refuse(dropped, f"too many: {MAX_QUEUED} requests of this sender are waiting")
        elif dropped:
            self.refusals.refuse(dropped, "superseded by a newer measurement")

    def wake(self) -> None:
        """Knobs were turned: check what is applied now. From any thread."""
        self._inbox.wake()

    def publish_again(self) -> None:
        """Publish the state even if unchanged, because the broker may have lost it. From any thread."""
        self._publisher.again = True
        self._inbox.wake()

    def stop(self) -> None:
        """End soon. From any thread, including a signal handler's, any number of times."""
        self._stopped = True
        self._inbox.wake()

    def run(self, duration_s: float | None = None) -> None:
        """Work until stopped, or for a given time.

        raises  RuleFailed if the first decision cannot be made
        """
        self._began = self.beat = time.monotonic()
        self.listener.begin()
        self._warned = set[str]()
        self._run = start(self.vehicle)
        self._guarded("cameras", self._readings.read)
        self._guarded("sources", lambda: self._notice(source_events(self._run.state, self._readings.cameras, 0.0)))
        self._guarded("start", lambda: self._take(ClockAdvanced(t=0.0)))
        if any(self.former):
            holder, stop = self.former
            self._guarded("control", lambda: self._take(ControlRestored(t=0.0, operator=holder, stop=stop or None)))
        next_tick, late = TICK_S, LateCheck(2 * TICK_S)
        late.is_excused(0)
        while not self._stopped and (duration_s is None or self._now() < duration_s):
            if (now := self._now()) >= next_tick and late.is_excused(now):  # first handle what has arrived meanwhile
                next_tick = now + TICK_S / 2
            elif now >= next_tick:
                self._tick()
                next_tick = max(next_tick + TICK_S, self._now() - TICK_S)
            item = self._inbox.get(self._began + next_tick)
            if isinstance(item, QueuedReport):
                self._guarded("reception report", lambda r=item: self._take_report(r))  # type: ignore[misc]
            elif item:
                self._guarded(str(item.document.get("event")), lambda r=item: self._take_request(r))  # type: ignore[misc]
            self._guarded("state", self._publish_state)

    def _guarded(self, what: str, work: Callable[[], None]) -> None:
        """Run a piece of work; an exception must not end the streams of a moving vehicle."""
        self.busy_with = what
        try:
            work()
        except Exception as error:
            self.errors += 1
            self._report_once(f"{what}: {type(error).__name__}: {error}")
        self.busy_with, self.beat = "", time.monotonic()

    def _now(self) -> float:
        return round(time.monotonic() - self._began, 6)

    def _tick(self) -> None:
        """Work that is due ten times a second. A failing step does not stop the others."""
        t = self._now()
        self.refusals.tick()
        self._ticks += 1
        if self.track is not None:
            position_at = self.track.at
            self._guarded("position_reported", lambda: self._take(replace(position_at(t), t=t)))
        if self.steering is not None:
            self._guarded("steering_reported", lambda: self._steer(t))
        self._guarded("clock_advanced", lambda: self._take(ClockAdvanced(t=t)))
        self._guarded("cameras", self._readings.read)
        self._guarded("sources", lambda: self._notice(source_events(self._run.state, self._readings.cameras, t)))
        self._guarded("copies_counted", lambda: self._notice(copies_events(self._run.state, self._readings.streams, t)))
        self._guarded("streams", lambda: self._notice(self._streams.events(self._run, self._readings.cameras, t)))
        if self._ticks % TELEMETRY_TICKS == 0:
            self._guarded("telemetry", lambda: self._publish_measured(t))
        self._guarded("operators", lambda: self._watch_operators(t))
        self._guarded("views", lambda: self._notice(self._views.events(self._run.state, t)))
        self._guarded("advice", lambda: self._publisher.advise(self._run, t))

    def _steer(self, t: float) -> None:
        """Report the angle of the synthetic drive."""
        if self.steering is None or self._run.state.steering is not self._steered:
            return  # somebody else steers
        self._steered = SteeringReported(t=t, rad=self.steering(self._began + t))
        self._take(self._steered)

    def _notice(self, events: Iterable[Event]) -> None:
        for event in events:
            self._take(event)
            if isinstance(event, SourceReported):
                found = "found again" if event.works else f"lost: {event.reason}; trying again"
                self.on_report(f"{event.camera}: {found}")
            elif isinstance(event, AttentionChanged):
                what = event.attention or "no longer reporting its attention"
                self.on_report(f"operator {self._run.state.driving.in_control} is {what}")

    def _take_request(self, request: Request) -> None:
        try:
            self._answer_request(request)
        except Exception as error:
            request.reply(Outcome(self._now(), "refused", f"failed: {type(error).__name__}: {error}"))
            raise

    def _answer_request(self, request: Request) -> None:
        t = self._now()
        name = str(request.document.get("event"))
        if request.sender and (denied := self.access.denial(request.sender, name)):
            self.refusals.deny(request, name, denied)
            return
        stamped = {**request.document, "t": t}
        if request.sender and name in ASKED_BY:
            stamped["operator"] = request.sender
        problem = event_problem(stamped)
        event = None if problem else parse(stamped)
        is_goodbye = isinstance(event, OperatorDisconnected)
        if is_goodbye and (why := self._operators.stays(request.sender, t, request.run, request.will)):
            request.reply(Outcome(t, "applied", why))
            return
        self._update_presence(request.sender, t, event)
        if event is None:
            assert problem
            self.refusals.refuse(request, problem)
        elif request.sender and (denied := self.access.unheld(request.sender, name, self._run.state.driving)):
            self.refusals.deny(request, name, denied)
        elif request.sender and isinstance(event, OWN):
            self.refusals.refuse(request, f"{NAMES[type(event)]}: only the vehicle itself makes this event")
        elif expired := self._expired(request, name, t):
            self.refusals.count += 1
            request.reply(Outcome(t, "expired", expired))
        elif isinstance(event, OperatorConnected | OperatorDisconnected):
            request.reply(Outcome(t, "applied", ""))  # presence is already updated
        elif isinstance(event, ControlAccepted):
            seen = self._pictures.of(event.operator, t)
            self._take(replace(event, live=tuple(name for name in event.live if name in seen)), request.answer)
        else:
            self._take(event, request.answer)

    def _expired(self, request: Request, name: str, t: float) -> str | None:
        """Why a request is too old to be carried out; one to stop never is."""
        if request.as_of is None or name == STOP_REQUESTED:
            return None
        return self._operators.expired(request.sender, t, request.as_of)

    def _take_report(self, item: QueuedReport) -> None:
        t = self._now()
        if self.access.denial(item.sender, NAMES[OperatorConnected]):
            self.refusals.reject(item.sender)  # for example revoked since it connected
            return
        self._update_presence(item.sender, t, None)
        if item.sender not in self._operators.present:
            return
        if item.state_clock and self._operators.may_ask_clock(item.sender, t):
            item.state_clock()
        if item.report.run is not UNSET:
            self._operators.reported(item.sender, t, item.report.run)
        self._pictures.add(item.sender, t, item.report)
        self._notice(self._views.take(self._run.state, item.sender, t, item.report))
        reported = ReceptionReported(t, item.sender, item.sender == self._run.state.driving.in_control, item.report)
        uplink = self._uplinks.of(item.report)
        if uplink is None:
            self._report_once(f"{item.sender}: its reports name an uplink that this vehicle does not have; ignored")
            return
        is_rival = uplink.is_rival(reported)
        if reported.in_control and not is_rival:
            self._sending.add(self.applier.sent_frames())
            placed = {name: each.uplinks for name, each in self._run.decision.settings.items() if each.uplinks}
            reported = self._sending.judge(reported, time.time() - (t - item.report.as_of), placed)
        self.listener.record(reported if reported.in_control else replace(reported, report=_totals(reported.report)))
        link = uplink.take(reported)
        if is_rival:
            self._report_once(f"{item.sender}: two processes of this operator send reception reports; one is ignored")
            return
        if reported.in_control:
            latency_ms = item.report.latency_ms
            overdue_s = self._operators.overdue_s(item.sender, t, item.report.as_of)
            self._publisher.latency = (t - overdue_s, None if latency_ms is UNSET else latency_ms)
        if link:
            self._take(link)
        if (lost := item.report.damaged) is not UNSET:
            self.applier.send_key_frames(self._key_frames.to_repair(lost, self._run.decision, t, reported.in_control))

    def _update_presence(self, sender: str, t: float, event: Event | None) -> None:
        """Any message of an operator shows its presence."""
        before = self._operators.present
        if isinstance(event, OperatorConnected):
            self._operators.connected(sender, t, watching=event.watching is True)
        elif isinstance(event, OperatorDisconnected):
            self._operators.signed_off(sender)
        else:
            self._operators.message_received(sender, t)
        self._presence_changed(before, t, Departure.SIGNED_OFF)
        if isinstance(event, OperatorConnected) and sender and sender == self._run.state.driving.in_control:
            self._notice(self._attention.events(self._run.state, sender, event.attention, t))

    def _watch_operators(self, t: float) -> None:
        """Detect operators that have fallen silent, unless this loop itself has stalled."""
        stalled, self._operators_checked = t - self._operators_checked > SILENT_S / 2, t
        before = self._operators.present
        if not stalled:
            self._operators.expire_silent(t, self._inbox.senders())
        self._presence_changed(before, t, Departure.SILENT)

    def _presence_changed(self, before: frozenset[str], t: float, departure: Departure) -> None:
        now = self._operators.present
        for name in sorted(now - before):
            self.on_report(f"operator {name} is present")
        for name in sorted(before - now):
            self.on_report(f"operator {name} {departure}")
        watching = self._operators.watching
        self._notice(presence_events(self._run.state, now, watching, self.access.role, t, departure))

    def _take(self, event: Event, answer: Answer | None = None) -> None:
        driving = self._run.state.driving
        self._take_run(step(self.vehicle, self._run, event), event, answer)
        predictions = list(self.pqos.observe(event))
        for warning in self.pqos.warnings:
            if warning not in self._warned:
                self._warned.add(warning)
                self.on_report(warning)
        for prediction in predictions:
            self._take_run(step(self.vehicle, self._run, prediction), prediction)
        if self._run.state.driving is not driving:
            self._follow(driving, event.t)

    def _follow(self, before: Driving, t: float) -> None:
        """Let everybody know who drives now."""
        now = self._run.state.driving
        if now == before:
            return
        self._publisher.again = True
        if now.why != before.why:
            self.on_report(now.why)
        self._guarded("driving", lambda: self.on_driving(now))
        if now.drivers != before.drivers:
            self._notice(copies_events(self._run.state, self._readings.streams, t))
        if (now.drivers, now.in_control) != (before.drivers, before.in_control):
            self._guarded("control", lambda: self.applier.give_control(now.drivers, now.in_control))
        if now.in_control != before.in_control:
            self._take(ControlPassed(t=t, operator=now.in_control))

    def _take_run(self, after: Run, event: Event, answer: Answer | None = None) -> None:
        before, self._run = self._run, after
        try:
            self.applier.turn(after.commands)
            if cameras := cut_off(before.decision, after.decision):
                self.applier.send_key_frames(self._key_frames.due(cameras, event.t), begin_anew=True)
        except Exception:
            self._run = replace(after, commanded=before.commanded)  # the next event repeats the commands
            raise
        finally:
            self.listener.on_step(before, event, after)  # decided all the same, as a replay will decide
        if isinstance(event, PositionReported):
            self._publisher.position = event
        if isinstance(event, SteeringReported):
            self._publisher.steering(event, self._now())
        if after.fault:
            self._report_once(f"{after.fault}; the previous decision stays in force")
        elif before.fault:
            self.on_report("the rules decide again")
        if after.refused:
            self.refusals.count += 1
            self._report_once(f"refused: {after.refused}")
            if answer:
                answer(Outcome(event.t, "refused", after.refused))
        elif answer:
            self._replies.expect(answer, event, after.commands)
        if after.commands or after.decision != before.decision:
            self._publisher.cause = describe(event)
            for line in _changes(before, after, event):
                self.on_report(line)

    def _publish_state(self) -> None:
        """Publish the decided and the applied values if either has changed; answer requests that are now applied."""
        now = self._now()
        if not (self._replies.is_awaited or self._publisher.is_state_due(now, self._run.decision)):
            return
        self._readings.read()
        self._publisher.state(self._run, self._readings, now, has_viewer=bool(self._operators.present))
        self._replies.settle(self._run, self._readings.cameras, now)

    def _publish_measured(self, t: float) -> None:
        addresses = {name: addresses_by(each) for name, each in self.setup.uplinks.items()}
        sent = self.applier.sent() if addresses else {}
        telemetry = self._publisher.telemetry(
            self._run, t, self._readings, self.applier.stages(), self.refusals.count, self.errors, addresses, sent
        )
        self.listener.record(telemetry)
        self.publish(replace(telemetry, cameras=dict(_unsent(telemetry))) if sent else telemetry)


def _unsent(telemetry: Telemetry) -> Iterator[tuple[str, CameraTelemetry]]:
    """The cameras of telemetry without what only the log needs: each message takes from a limited link."""
    return ((name, replace(each, sent=UNSET)) for name, each in telemetry.cameras.items())


def _changes(before: Run, after: Run, event: Event) -> Iterator[str]:
    """What an event has changed of what the cameras send."""
    reported = event.camera if isinstance(event, SourceReported) else None  # which says this itself
    for name, now in after.decision.settings.items():
        was = before.decision.settings[name]
        if name != reported and (was.scaling, was.sending) != (now.scaling, now.sending):
            yield f"{describe(event)} -> {name}: {now.reason}"


def _totals(report: ReceptionReport) -> ReceptionReport:
    """A report without its frames and cameras. Nothing uses those of a watcher, who could fill the disk by them."""
    return replace(report, units=(), damaged=UNSET)
