"""The vehicle's live loop: take an event, step, apply, log, publish. Kept simple; survives exceptions."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from msgspec import UNSET

from runner.core.commands import Command
from runner.core.events import (
    NAMES,
    OWN,
    Attention,
    AttentionChanged,
    ClockAdvanced,
    ControlPassed,
    CopiesCounted,
    Event,
    OperatorConnected,
    OperatorDisconnected,
    PositionReported,
    SourceReported,
    SteeringReported,
    describe,
    parse,
)
from runner.core.model import plain
from runner.core.step import Run, start, step
from runner.mqtt.messages import APPLY_S
from runner.pqos import Pqos
from runner.records import (
    CameraReading,
    CameraState,
    CameraTelemetry,
    Outcome,
    Position,
    ReceptionReport,
    ReceptionReported,
    SentFrame,
    SpeedAdvice,
    SteeringAngle,
    Telemetry,
    VehicleState,
    applied_to_json,
)
from runner.schema import event_problem, shortened
from runner.settings import Setup
from runner.system.held_up import LateCheck
from runner.system.reports import LimitedReports
from runner.vehicle.access import Access
from runner.vehicle.inbox import MAX_QUEUED, Answer, Inbox, Item, QueuedReport, Request
from runner.vehicle.operators import SILENT_S, Operators
from runner.vehicle.sending import SendingTimes
from runner.vehicle.uplink import PRESENT_S, MeasuredUplink

if TYPE_CHECKING:
    from runner.pqos.track import Track

TICK_S = 0.1  # time between clock_advanced events
TELEMETRY_TICKS = 2  # also the vehicle's heartbeat
STATE_S = 0.2  # between two states, unless a request waits for its answer: each takes some kB of a limited link
REASONS_S, UNSEEN_REASONS_S = 1.0, 10.0  # between two that differ in reasons only; the second without an operator
CLOCK_S = 0.1  # between two answers about the clock to an operator, which asks five times a second
KEY_FRAME_S = 0.5  # between two key frames that repair a camera's pictures: each costs bits of the next pictures
STEERING_S = 0.05  # between two published steering angles: each costs the video 0.2 kB of the link
UNSEEN = (Attention.HIDDEN, Attention.ABSENT)  # the driver sees no picture
ADVICE_S = 0.2  # how long a reported latency, and the advice based on it, is valid
POSITION_S = 5.0  # an older position is stale
SPEED_S = 2.0  # an older speed is stale; receivers of GNSS report once a second or more often
REPEAT_S = 10.0  # the same fault is reported no more often than this
REFUSALS = 10  # refusals answered per sender between two ticks; further ones are only counted


class Applier(Protocol):
    """What the loop needs from the streaming side."""

    def turn(self, commands: Iterable[Command]) -> None: ...
    def read(self) -> Mapping[str, CameraReading]: ...
    def stages(self) -> Mapping[str, tuple[float, float]]: ...
    def sent_frames(self) -> Mapping[str, Iterable[SentFrame]]: ...
    def give_control(self, operator: str) -> None: ...
    def send_key_frames(self, cameras: Iterable[str]) -> None: ...


class Listener(Protocol):
    """What hears of a drive, from the loop's thread: the log."""

    def begin(self) -> None: ...
    def on_step(self, before: Run, event: Event, after: Run) -> None: ...
    def record(self, record: ReceptionReported | Telemetry) -> None: ...


_Kind = tuple[type, str | None]  # of a request: its event, and the camera that it names


class _PendingReply(NamedTuple):
    """An accepted request, answered once its commands are read back as applied."""

    answer: Answer
    knobs: Sequence[tuple[str, str]]  # camera, knob
    until: float
    kind: _Kind


@dataclass
class ControlLoop:
    """Events in, commands out, in one thread. Other threads `post` their events.

    publish      called with the state (decided and applied) whenever it has changed, and telemetry a few times a
                 second; returns False for a record that has to wait because the control link is behind
    on_report    called with one line per event and its result
    access       who may request what

    An exception in the loop is reported and counted in `errors`; the loop continues. `beat` is when the loop last
    finished a piece of work (time.monotonic), `busy_with` what it is doing.
    """

    setup: Setup
    applier: Applier
    pqos: Pqos
    track: Track | None
    listener: Listener
    publish: Callable[[VehicleState | Telemetry | SpeedAdvice | SteeringAngle], bool]
    on_report: Callable[[str], None]
    access: Access = field(default_factory=Access)
    refused: int = 0
    errors: int = 0
    beat: float = 0.0
    busy_with: str = ""
    _inbox: Inbox = field(default_factory=Inbox)
    _stopped: bool = False
    _ticks: int = 0
    _pending: list[_PendingReply] = field(default_factory=list)
    _timed_out: dict[_Kind, list[tuple[str, str]]] = field(default_factory=dict)  # knobs of the last request of a kind
    _published: VehicleState | None = None  # the state as last published
    _publish_again: bool = False
    _cause: str = ""  # the event that the decision in force came from
    _position: PositionReported | None = None
    _reported: dict[str, float] = field(default_factory=dict)  # by fault, time of its last report
    _clock_stated: dict[str, float] = field(default_factory=dict)  # by operator, time of the last answer
    _latency: tuple[float, float | None] = (-ADVICE_S, None)  # time of the last reported latency, and its value, ms
    _runs: dict[tuple[str, int], float] = field(default_factory=dict)  # by operator and process, the last report
    _attention_stated: tuple[str, float] = ("", 0.0)  # by whom and when
    _key_frames: dict[str, float] = field(default_factory=dict)  # by camera, time of the last request for one
    _steering_published: float = -STEERING_S  # when the steering angle was last published
    _refusals: dict[str, int] = field(default_factory=dict)  # by sender, since the last tick

    def __post_init__(self) -> None:
        self.vehicle = self.setup.vehicle
        self._cameras: Mapping[str, CameraReading] = dict.fromkeys(
            self.vehicle.cameras, CameraReading()
        )  # as last read
        self._operators = Operators(self.setup.expires_s, self.access.may_control)
        self._uplink, self._sending = MeasuredUplink(self.vehicle), SendingTimes()
        self._report_denial = LimitedReports(self.on_report)
        self._in_control = ""
        self._operators_checked = 0.0  # when operators were last checked for silence
        self._began = time.monotonic()

    def post(self, document: Mapping[str, Any], answer: Answer | None = None) -> None:
        """An event as JSON without `t`, from this process, from any thread.

        answer  called with its outcome: applied, refused, expired or timed out
        """
        self.take(Request("", document, answer))

    def take(self, item: Item) -> None:
        """Queue a request or a report, from any thread; refused if its sender's queue is full."""
        dropped = self._inbox.put(item)
        if isinstance(dropped, QueuedReport):
            self.reject(dropped.sender)
        elif dropped is item:
            self.refuse(dropped, f"too many: {MAX_QUEUED} requests of this sender are waiting")
        elif dropped:
            self.refuse(dropped, "superseded by a newer measurement")

    def overrun(self, sender: str, *, reports: bool = False) -> bool:
        """Whether a sender floods the vehicle, so that its message is only counted, not parsed. From any thread.

        reports  of reception reports, which are not answered: an invalid report counts like an excess one
        """
        answers = self._refusals.get(sender, 0)
        if answers < REFUSALS or not (reports or self._inbox.is_full(sender)):
            return False
        self.refused += 1
        return True

    def reject(self, sender: str) -> None:
        """Count an invalid or excess reception report. From any thread."""
        self.refused += 1
        self._refusals[sender] = self._refusals.get(sender, 0) + 1

    def refuse(self, request: Request, problem: str) -> None:
        """Refuse a request, from any thread; answers to one sender between two ticks are limited."""
        self.refused += 1
        answers = self._refusals[request.sender] = self._refusals.get(request.sender, 0) + 1
        if request.answer and (not request.sender or answers <= REFUSALS):
            request.answer(Outcome(self._now(), "refused", problem))

    def wake(self) -> None:
        """Knobs were turned: check what is applied now. From any thread."""
        self._inbox.wake()

    def publish_again(self) -> None:
        """Publish the state even if unchanged, because the broker may have lost it. From any thread."""
        self._publish_again = True
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
        self._warned = 0
        self._run = start(self.vehicle)
        self._guarded("cameras", self._read)
        self._guarded("sources", lambda: self._check_sources(0.0))
        self._guarded("start", lambda: self._take(ClockAdvanced(t=0.0)))
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

    def _report_once(self, text: str) -> None:
        """Report a fault; the same one at most every REPEAT_S."""
        now = self._now()
        if now - self._reported.get(text, -REPEAT_S) >= REPEAT_S:
            self._reported = {t: at for t, at in self._reported.items() if now - at < REPEAT_S} | {text: now}
            self.on_report(text)

    def _now(self) -> float:
        return round(time.monotonic() - self._began, 6)

    def _tick(self) -> None:
        """Work that is due ten times a second. A failing step does not stop the others."""
        t = self._now()
        self._refusals = {}
        self._ticks += 1
        if self.track is not None:
            position_at = self.track.at
            self._guarded("position_reported", lambda: self._take(replace(position_at(t), t=t)))
        self._guarded("clock_advanced", lambda: self._take(ClockAdvanced(t=t)))
        self._guarded("cameras", self._read)
        self._guarded("sources", lambda: self._check_sources(t))
        self._guarded("copies_counted", lambda: self._count_copies(t))
        if self._ticks % TELEMETRY_TICKS == 0:
            self._guarded("telemetry", lambda: self._publish_measured(t))
        self._guarded("operators", lambda: self._watch_operators(t))
        self._guarded("advice", lambda: self._advise(t))

    def _read(self) -> None:
        self._cameras = self.applier.read()

    def _count_copies(self, t: float) -> None:
        copies = {name: camera.copies for name, camera in self._cameras.items() if camera.copies > 1}
        if copies != self._run.state.copies:
            self._take(CopiesCounted(t=t, copies=copies))

    def _check_sources(self, t: float) -> None:
        """Let the rules know which cameras cannot be opened."""
        known = self._run.state.lost
        for name, why in ((name, camera.lost) for name, camera in self._cameras.items()):
            if why != known.get(name):
                self._take(SourceReported(t=t, camera=name, works=why is None, reason=why))
                self.on_report(f"{name}: lost: {why}; trying again" if why else f"{name}: found again")

    def _take_request(self, request: Request) -> None:
        try:
            self._answer_request(request)
        except Exception as error:
            if request.answer:
                request.answer(Outcome(self._now(), "refused", f"failed: {type(error).__name__}: {error}"))
            raise

    def _answer_request(self, request: Request) -> None:
        t = self._now()
        name = str(request.document.get("event"))
        if request.sender and (denied := self.access.denial(request.sender, name, self._operators.in_control)):
            self._report_denial(f"refused {shortened(name)} of {request.sender}: {denied}", request.sender)
            self.refuse(request, denied)
            return
        stamped = {**request.document, "t": t}
        problem = event_problem(stamped)
        event = None if problem else parse(stamped)
        if isinstance(event, OperatorDisconnected) and self._goes_on(request, t):
            self._answer(request.answer, Outcome(t, "applied", "another process of this operator goes on"))
            return
        self._update_presence(request.sender, t, event, signed_off=not request.will)
        if event is None:
            assert problem
            self.refuse(request, problem)
        elif request.sender and isinstance(event, OWN):
            self.refuse(request, f"{NAMES[type(event)]}: only the vehicle itself makes this event")
        elif request.as_of is not None and (expired := self._operators.expired(request.sender, t, request.as_of)):
            self.refused += 1
            self._answer(request.answer, Outcome(t, "expired", expired))
        elif isinstance(event, OperatorConnected | OperatorDisconnected):
            self._answer(request.answer, Outcome(t, "applied", ""))  # presence is already updated
        else:
            self._take(event, request.answer)

    def _take_report(self, item: QueuedReport) -> None:
        t = self._now()
        if self.access.denial(item.sender, NAMES[OperatorConnected], ""):
            self.reject(item.sender)  # for example revoked since it connected
            return
        self._update_presence(item.sender, t, None)
        if item.sender not in self._operators.present:
            return
        self._state_clock(item, t)
        if item.report.run is not UNSET:
            self._runs = {key: at for key, at in self._runs.items() if t - at < PRESENT_S} | {
                (item.sender, item.report.run): t
            }
        reported = ReceptionReported(t, item.sender, item.sender == self._operators.in_control, item.report)
        is_rival = self._uplink.is_rival(reported)
        if reported.in_control and not is_rival:
            self._sending.add(self.applier.sent_frames())
            reported = self._sending.judge(reported, time.time() - (t - item.report.as_of))
        self.listener.record(reported if reported.in_control else replace(reported, report=_totals(reported.report)))
        link = self._uplink.take(reported)
        if is_rival:
            self._report_once(f"{item.sender}: two processes of this operator send reception reports; one is ignored")
            return
        if reported.in_control:
            latency_ms = item.report.latency_ms
            overdue_s = self._operators.overdue_s(item.sender, t, item.report.as_of)
            self._latency = (t - overdue_s, None if latency_ms is UNSET else latency_ms)
        if link:
            self._take(link)
        if reported.in_control and item.report.damaged is not UNSET:
            self._repair(item.report.damaged, t)

    def _goes_on(self, goodbye: Request, t: float) -> bool:
        """Whether another process of the operator that says goodbye still sends reports."""
        others = [at for (name, run), at in self._runs.items() if name == goodbye.sender and run != goodbye.run]
        return goodbye.run is not None and any(t - at < PRESENT_S for at in others)

    def _repair(self, damaged: Iterable[str], t: float) -> None:
        """Send key frames of cameras with unrecovered packet loss; a camera that is not sent needs none."""
        sending = {name for name, setting in self._run.decision.settings.items() if setting.sending}
        affected = sending.intersection(damaged)
        due = sorted(name for name in affected if t - self._key_frames.get(name, -KEY_FRAME_S) >= KEY_FRAME_S)
        self._key_frames |= dict.fromkeys(due, t)
        if due:
            self.applier.send_key_frames(due)

    def _advise(self, t: float) -> None:
        """Publish the speed that the latency of the operator's pictures allows; 0 without a recent report or driver."""
        if (factor := self._speed_factor(t)) is not None:
            _, measured_ms = self._latency
            limit = self.setup.latency
            total_ms = None if not factor or measured_ms is None else round(measured_ms + (limit.fixed_ms or 0.0), 1)
            self.publish(SpeedAdvice(t, factor, total_ms, ADVICE_S))

    def _speed_factor(self, t: float) -> float | None:
        at, measured_ms = self._latency
        is_seen = t - at <= ADVICE_S and self._run.state.attention not in UNSEEN
        factor = self.setup.latency.speed_factor(measured_ms if is_seen else None)
        return None if factor is None else round(factor, 3)

    def _state_clock(self, item: QueuedReport, t: float) -> None:
        """Answer an operator that compares clocks, at a limited rate: answers to a flood would fill the uplink."""
        if item.state_clock and t - self._clock_stated.get(item.sender, -CLOCK_S) >= CLOCK_S:
            present = self._operators.present
            self._clock_stated = {name: at for name, at in self._clock_stated.items() if name in present}
            self._clock_stated[item.sender] = t
            item.state_clock()

    def _update_presence(self, sender: str, t: float, event: Event | None, *, signed_off: bool = True) -> None:
        """Any message of an operator shows its presence. The core sees the first to arrive and the last to leave."""
        before = self._operators.present
        if isinstance(event, OperatorConnected):
            self._operators.connected(sender, t)
        elif isinstance(event, OperatorDisconnected):
            self._operators.disconnected(sender, t, signed_off=signed_off)
        else:
            self._operators.message_received(sender, t)
        self._presence_changed(before, t, "disconnected")
        if isinstance(event, OperatorConnected) and sender and sender == self._operators.in_control:
            self._update_attention(sender, event.attention, t)

    def _update_attention(self, operator: str, attention: Attention | None, t: float) -> None:
        """Pass on the driver's attention as stated by the operator in control.

        A heartbeat without it, such as of a ROS interface with the same keys, leaves what a page stated just before.
        """
        stated_by, at = self._attention_stated
        if attention is None and stated_by == operator and t - at < SILENT_S:
            return
        if attention is not None:
            self._attention_stated = (operator, t)
        if attention is not self._run.state.attention:
            self._take(AttentionChanged(t=t, attention=attention))
            self.on_report(f"operator {operator} is {attention or 'no longer reporting its attention'}")

    def _watch_operators(self, t: float) -> None:
        """Detect operators that have fallen silent, unless this loop itself has stalled."""
        stalled, self._operators_checked = t - self._operators_checked > SILENT_S / 2, t
        before = self._operators.present
        if not stalled:
            self._operators.expire_silent(t, self._inbox.senders())
        self._presence_changed(before, t, f"has been silent for {SILENT_S:g} s")

    def _presence_changed(self, before: frozenset[str], t: float, why: str) -> None:
        now, in_control = self._operators.present, self._operators.in_control
        for name in sorted(now - before):
            self.on_report(f"operator {name} is present")
        for name in sorted(before - now):
            self.on_report(f"operator {name} {why}")
        if in_control != self._in_control:
            self._in_control = in_control
            self._guarded("control", lambda: self._pass_control(in_control, t))
        if bool(now) != (
            self._run.state.operator_since is not None
        ):  # compared with the core: an event may have failed
            self._take(OperatorConnected(t=t) if now else OperatorDisconnected(t=t))

    def _pass_control(self, operator: str, t: float) -> None:
        self.applier.give_control(operator)
        self._take(ControlPassed(t=t, operator=operator))

    def _answer(self, answer: Answer | None, outcome: Outcome) -> None:
        if answer:
            answer(outcome)

    def _take(self, event: Event, answer: Answer | None = None) -> None:
        self._take_run(step(self.vehicle, self._run, event), event, answer)
        prediction = self.pqos.observe(event)
        for warning in self.pqos.warnings[self._warned :]:
            self._warned += 1
            self.on_report(warning)
        if prediction is not None:
            self._take_run(step(self.vehicle, self._run, prediction), prediction)

    def _take_run(self, after: Run, event: Event, answer: Answer | None = None) -> None:
        before, self._run = self._run, after
        try:
            self.applier.turn(after.commands)
        except Exception:
            self._run = replace(after, commanded=before.commanded)  # the next event repeats the commands
            raise
        finally:
            self.listener.on_step(before, event, after)  # decided all the same, as a replay will decide
        if isinstance(event, PositionReported):
            self._position = event
        if isinstance(event, SteeringReported):
            self._publish_steering(event)
        if after.fault:
            self._report_once(f"{after.fault}; the previous decision stays in force")
        elif before.fault:
            self.on_report("the rules decide again")
        if after.refused:
            self.refused += 1
            self._report_once(f"refused: {after.refused}")
            self._answer(answer, Outcome(event.t, "refused", after.refused))
        elif answer:
            kind = (type(event), getattr(event, "camera", None))
            commanded = [(command.camera, command.knob) for command in after.commands]
            # A request that is repeated commands nothing, but what it asks for may still not be applied.
            waited = [knob for pending in self._pending if pending.kind == kind for knob in pending.knobs]
            knobs = list(dict.fromkeys([*commanded, *waited, *self._timed_out.get(kind, ())]))
            self._pending.append(_PendingReply(answer, knobs, event.t + APPLY_S, kind))
        if after.commands or after.decision != before.decision:
            self._report_decision(before, event)

    def _publish_steering(self, event: SteeringReported) -> None:
        if event.t - self._steering_published >= STEERING_S:
            self._steering_published = event.t
            self.publish(SteeringAngle(round(time.time() - (self._now() - event.t), 4), event.rad))

    def _report_decision(self, before: Run, event: Event) -> None:
        self._cause = describe(event)
        reported = event.camera if isinstance(event, SourceReported) else None  # which says this itself
        for name, now in self._run.decision.settings.items():
            was = before.decision.settings[name]
            if name != reported and (was.scaling, was.sending) != (now.scaling, now.sending):
                self.on_report(f"{self._cause} -> {name}: {now.reason}")

    def _publish_state(self) -> None:
        """Publish the decided and the applied values if either has changed; answer requests that are now applied."""
        due = self._published is None or self._now() - self._published.t >= STATE_S or bool(self._pending)
        if not due and not self._publish_again:
            return
        self._read()
        state = self._state()
        if self._is_news(state) and self.publish(state):
            self._publish_again, self._published = False, state
        self._pending = [pending for pending in self._pending if not self._answered(pending)]

    def _is_news(self, state: VehicleState) -> bool:
        """Whether to publish a state. Changed reasons or beliefs alone, which change all the time, are not urgent."""
        last = self._published
        if last is None or self._publish_again:
            return True
        if state == last:
            return False
        interval_s = REASONS_S if self._operators.present else UNSEEN_REASONS_S
        return state.t - last.t >= interval_s or _without_reasons(state) != _without_reasons(last)

    def _state(self) -> VehicleState:
        decision = self._run.decision
        # A source that is awaited says for what; the rules know only that it does not open.
        cameras = {
            name: CameraState.at(
                decision.settings[name],
                plain(self._run.state.weights[name]),
                applied_to_json(name, camera.applied),
                camera.fault or camera.lost,
                camera.untimed,
                camera.slow_fps,
            )
            for name, camera in self._cameras.items()
        }
        fault = self._run.fault
        total, asked = plain(decision.total), plain(decision.asked)
        decided = (decision.mode, total, asked, cameras, fault)
        return VehicleState(
            self._now(),
            self._cause,
            *decided,
            attention=self._run.state.attention or UNSET,
            operator=self._in_control or UNSET,
            believed=decision.believed or UNSET,
        )

    def _answered(self, pending: _PendingReply) -> bool:
        """Answer a request if all its knob values are applied or it has timed out; returns whether it is answered."""
        now, commanded = self._now(), self._run.commanded
        applied = {name: camera.applied for name, camera in self._cameras.items()}
        settings = self._run.decision.settings  # what is not sent keeps the other values
        relevant = [(name, knob) for name, knob in pending.knobs if knob == "sending" or settings[name].sending]
        watched = [(name, knob) for name, knob in relevant if applied[name]]
        waiting = [(name, knob) for name, knob in watched if applied[name].get(knob) != commanded[name][knob]]
        if waiting and now < pending.until:
            return False
        self._timed_out.pop(pending.kind, None)
        if waiting:
            self._timed_out[pending.kind] = waiting
            missing = ", ".join(f"{name} {knob}" for name, knob in waiting)
            pending.answer(Outcome(now, "timed out", f"not applied within {APPLY_S:g} s: {missing}"))
            return True
        unwatched = dict.fromkeys(name for name, _ in pending.knobs if not applied[name])
        reason = f"no viewer for {', '.join(unwatched)}: applied when one connects" if unwatched else ""
        pending.answer(Outcome(now, "applied", reason))
        return True

    def _publish_measured(self, t: float) -> None:
        """Publish what was read back from the elements, and what the encoders have output so far."""
        stages = self.applier.stages()
        cameras = {
            name: CameraTelemetry(
                applied_to_json(name, camera.applied),
                camera.frames,
                camera.bytes,
                *(round(ms, 2) for ms in stages.get(name, ())),
            )
            for name, camera in self._cameras.items()
        }
        prediction = self._run.state.prediction
        predicted = plain(prediction.kbps) if prediction else None
        position = self._current_position(t)
        factor = self._speed_factor(t)
        telemetry = Telemetry(t, predicted, position, cameras, self.refused, self.errors, factor)
        self.listener.record(telemetry)
        self.publish(telemetry)

    def _current_position(self, t: float) -> Position | None:
        """The position, while it is not stale; its speed becomes stale earlier."""
        if self._position is None or (age_s := t - self._position.t) > POSITION_S:
            return None
        return Position.of(self._position if age_s <= SPEED_S else replace(self._position, speed_mps=None))


def _totals(report: ReceptionReport) -> ReceptionReport:
    """A report without its frames and cameras. Nothing uses those of a watcher, who could fill the disk by them."""
    return replace(report, units=(), damaged=UNSET)


def _without_reasons(state: VehicleState) -> VehicleState:
    cameras = {name: replace(camera, reason="") for name, camera in state.cameras.items()}
    return replace(state, cameras=cameras, believed=UNSET)
