"""A running operator's side: control link, receivers and log together. For the verb `operator` and for programs.

with live_operator(["vehicle=delivery_robot"]) as operator:
    operator.station.listeners.append(mine)       # a runner.operator.station.Listener
    operator.start()                              # receives and samples in separate threads
    operator.station.ask({"event": "mode_selected", "mode": "collective"}, print)
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from math import inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import UNSET

from runner.configuration import agreement
from runner.configuration.config import configuration
from runner.core.budget import SAMPLE_BYTES, VOICE_HZ
from runner.core.evidence import REPORT_S
from runner.core.model import Roi
from runner.core.view import View
from runner.drive.log import Log
from runner.errors import RunError, UserError, suggest
from runner.metrics.side import SideMetrics
from runner.operator.log import DriveLog
from runner.operator.station import Listener, Station, holds_control
from runner.plans import compile_plans, sound_plan, voice_plan
from runner.records.operator import Sample
from runner.records.vehicle import Outcome, VehicleState
from runner.security.exposure import viewer_keyring
from runner.settings import Setup
from runner.system.held_up import LateCheck
from runner.system.service import notify

if TYPE_CHECKING:
    from runner.apply import OnSound, OnUnit, OperatorSide, SoundPacket, VoiceSender
    from runner.configuration.experiment import TimedRequest
    from runner.operator.demand import Demand
    from runner.operator.recorded_sound import RecordedSound
    from runner.ros.pictures import DecodedPictures
    from runner.security.keyring import Keyring

SAMPLE_S = 0.25
START_S = 20.0  # how long a given duration waits for the vehicle
CONTROL_FIRST_S, POLL_S = 1.0, 0.01  # how long the streams wait for the vehicle, and how often they check
STUCK_S = 2.0  # a side that samples nothing for this long hangs
GIVE_UP_S = 60.0  # after this long it ends; an overloaded machine may recover before
END_S = 1.0  # how long the last sample may take
SOONEST_S = 0.01  # between two reports, however often something else is seen
SPOKEN_S = 1.0  # of voice that a program hands over at a time, at most


class LiveOperator:
    """The parts of an operator's side.

    setup    as this side's configuration describes it
    station  this end of the control link; its listeners must be added before `start`

    requests  in order of time; each is sent at its time since the vehicle came online
    demand    what to receive, see `show`; None: every camera, all the time
    voice     of this operator; None: it cannot speak
    """

    def __init__(
        self,
        setup: Setup,
        station: Station,
        log: Log,
        build: Callable[[OnUnit | None, OnSound | None], OperatorSide],
        requests: Sequence[TimedRequest] = (),
        demand: Demand | None = None,
        voice: VoiceSender | None = None,
    ) -> None:
        self.setup, self.station, self._voice = setup, station, voice
        self._demand, self._following = demand, threading.Lock()
        self._received = frozenset[str]()  # as the demand was last followed
        self._lacking = frozenset[str]()  # see `lack`
        self._holds = False  # whether this operator held control when the vehicle was last heard
        self.on_dropped: Callable[[Collection[str]], None] = lambda cameras: None  # that are no longer received
        self._log, self._build = log, build
        self._side: OperatorSide | None = None
        self._stopped, self._sees_else = threading.Event(), threading.Event()
        self._duration_s, self._latest_start = inf, inf
        self._online_at: float | None = None  # time.monotonic
        self._requests = deque(requests)
        self._failure: RunError | None = None
        self._sampled = time.monotonic()
        self._drivers: Sequence[str] = ()  # whom the vehicle sends pictures first, as of the last sample
        self._late = LateCheck(2.5 * REPORT_S)
        self._thread = threading.Thread(target=self._run, name="sampling", daemon=True)
        self._reporting = threading.Thread(target=self._report, name="reporting", daemon=True)

    def start(
        self, on_unit: OnUnit | None = None, duration_s: float | None = None, on_sound: OnSound | None = None
    ) -> None:
        """Connect, receive, and sample, until stopped or for a given time.

        on_unit     called, from the camera's streaming thread, with each access unit that arrives
        duration_s  from the moment the vehicle is online, or START_S after this call; None: until stopped
        on_sound    called, from its streaming thread, with each packet of sound
        """
        if self._demand:
            self._follow(self._demand)
        self.station.seen.on_change = self._sees_else.set  # what is newly seen arrives a report earlier
        self.station.connect()
        if not self._demand:
            self._await_vehicle()
        with self._announcing():
            self._side = self._build(on_unit, on_sound)
        self._log.begin()
        self._duration_s = inf if duration_s is None else duration_s
        self._latest_start = time.monotonic() + START_S
        self._thread.start()
        self._reporting.start()
        notify("READY=1")

    def _await_vehicle(self) -> None:
        """Let the vehicle learn of this operator before its cameras start to fill the link."""
        deadline = time.monotonic() + CONTROL_FIRST_S
        while not self.station.state and time.monotonic() < deadline and not self._stopped.wait(POLL_S):
            pass

    @contextmanager
    def _announcing(self) -> Iterator[None]:
        """Within the block the vehicle hears of this operator: building takes seconds on a busy machine."""
        is_built = threading.Event()

        def announce() -> None:
            while not is_built.wait(SAMPLE_S):
                self.station.announce()

        thread = threading.Thread(target=announce, name="announcing", daemon=True)
        thread.start()
        try:
            yield
        finally:
            is_built.set()
            thread.join(END_S)

    def show(self, cameras: Collection[str], is_open: bool) -> None:
        """Receive these cameras, and drive while a page is open. From any thread; for a side that follows a demand."""
        assert self._demand
        with self._following:
            self._demand.ask(cameras, is_open=is_open, now=time.monotonic())
        self._follow(self._demand)

    def lack(self, cameras: Collection[str]) -> None:
        """Ask for key pictures of these cameras, and no others, until the next call. From any thread."""
        self._lacking = frozenset(cameras)

    def see(self, view: View | None, for_s: float = inf) -> None:
        """State to the vehicle what this program shows, or uses, of each camera; from any thread.

        view   by camera, the region of its full image and the size at which it is used; NOWHERE: nothing of it. Cameras
               that are not named are used in full. None: nothing is stated any more, as without a call
        for_s  how long it holds at most, s; then all is used in full
        raises UserError if the vehicle has no such camera, or its image no such region; what was stated before holds
        """
        cameras = self.setup.vehicle.cameras
        for name, seen in (view or {}).items():
            if name not in cameras:
                raise UserError("view", name, None, f"unknown camera{suggest(name, cameras)}")
            if problem := seen.problem(cameras[name]):
                raise UserError("view", name, str(seen), problem)
        self.station.seen.state(view, for_s)

    def speak(self, samples: bytes, spoken: float, clock: float = 0.0) -> None:
        """Speak at the vehicle's loudspeaker, while this operator is in control. From any one thread.

        samples  S16LE at 48 kHz of one channel
        spoken   when, s, by any clock that runs steadily
        clock    which one: a number
        raises   UserError for no sample, half a one, or more than SPOKEN_S: what is spoken must not be heard long after
        """
        if not 0 < len(samples) <= SPOKEN_S * VOICE_HZ * SAMPLE_BYTES or len(samples) % SAMPLE_BYTES:
            rule = (
                f"must be whole samples of {SAMPLE_BYTES} bytes, at least one, at most {SPOKEN_S:g} s of {VOICE_HZ} Hz"
            )
            raise UserError("samples", "", f"{len(samples)} bytes", rule)
        if not isfinite(spoken):
            raise UserError("spoken", "", str(spoken), "must be s by a clock")
        if self._voice:
            self._voice.push(samples, spoken, clock)

    def _follow_voice(self, voice: VoiceSender, state: VehicleState | None) -> None:
        """Be connected to the vehicle's loudspeaker whenever the vehicle would let this operator speak."""
        identity, driving = self.station.identity, state.driving if state else UNSET
        played = UNSET if state is None else state.voice
        is_open = played is not UNSET and played.fault is None
        voice.follow(
            may_speak=is_open and driving is not UNSET and driving.in_control == identity,
            is_heard=played is not UNSET and played.operator == identity,
        )

    def _follow(self, demand: Demand) -> None:
        with self._following:
            now = time.monotonic()
            cameras = demand.cameras(now)
            if self.station.state:  # an operator does not leave a vehicle that is silent for a moment
                self._holds = holds_control(self.station)
            self.station.appear(demand.presence(now, holds_control=self._holds))
            if self._side is None or cameras == self._received:
                return
            dropped, self._received = self._received - cameras, cameras
            self._side.receive(cameras)
        if dropped:
            self.on_dropped(dropped)

    def runs(self, wait_s: float = 0.0) -> bool:
        """Whether it is still sampling after a time; returns immediately if not.

        raises  RunError if it has ended early because of an error
        """
        self._thread.join(wait_s)
        if self._failure:
            raise self._failure
        return self._thread.is_alive()

    def end(self) -> None:
        """Stop sampling soon. From any thread, any number of times."""
        self._stopped.set()
        self._sees_else.set()

    def stop(self) -> None:
        """Sign off from the vehicle, and end."""
        notify("STOPPING=1")
        self.end()
        for thread in (self._thread, self._reporting):
            if thread.ident:
                thread.join(END_S)
        if self._voice:
            self._voice.follow(may_speak=False, is_heard=False)
        self.station.close()
        try:
            if self._side:
                self._side.stop()
        finally:
            self._log.close()

    def problem(self) -> str | None:
        """Why this side does not work; None if it works."""
        silent = time.monotonic() - self._sampled
        return f"nothing was sampled for {silent:.1f} s" if silent > STUCK_S else None

    def _run(self) -> None:
        """In its own thread, so that a stopped terminal (Ctrl-S) does not block it."""
        side = self._side
        assert side
        try:
            self._repeat("sample", lambda: self._stopped.wait(SAMPLE_S), lambda: self._sample(side))
        except RunError as error:  # GStreamer has hung for GIVE_UP_S; the main thread raises it
            self._failure = error
        for request in self._requests:
            self.station.note(f"the request at {request.at_s:g} s was not made: the drive ended before")

    def _report(self) -> None:
        """In its own thread, since a sample waits for GLib: to the vehicle a missing report means a bad link."""
        side = self._side
        assert side
        self._repeat("reception report", self._await_report, lambda: self._report_reception(side))

    def _await_report(self) -> None:
        """Until the next report is due, or something else is seen."""
        self._stopped.wait(SOONEST_S)
        self._sees_else.wait(REPORT_S - SOONEST_S)
        self._sees_else.clear()

    def _report_reception(self, side: OperatorSide) -> None:
        is_held_up = self._late.is_excused(time.monotonic())  # other threads first read what has arrived meanwhile
        if not is_held_up and not self.station.link.is_behind():  # else they accumulate for the next report
            arrivals = side.take_arrivals()
            if lacking := self._lacking:
                arrivals = {
                    uplink: own._replace(damaged=[*lacking.union(own.damaged)]) for uplink, own in arrivals.items()
                }
            self.station.report_reception(arrivals)

    def _repeat(self, what: str, pause: Callable[[], object], work: Callable[[], None]) -> None:
        """Repeat a piece of work until stopped; an exception must not end the operator's view of a moving vehicle.

        raises  RunError if nothing was sampled for GIVE_UP_S
        """
        last_fault = ""
        while True:
            pause()
            if self._stopped.is_set() or self._elapsed_s() >= self._duration_s:
                return
            try:
                work()
            except Exception as error:
                if isinstance(error, RunError) and time.monotonic() - self._sampled > GIVE_UP_S:
                    raise
                why = error if isinstance(error, RunError) else f"{type(error).__name__}: {error}"
                if last_fault != (last_fault := f"a {what} failed: {why}"):
                    self.station.note(last_fault)

    def _sample(self, side: OperatorSide) -> None:
        if self._demand:
            self._follow(self._demand)
        if addresses := self.station.addresses:
            side.admit(addresses)
        state = self.station.state  # another thread may replace it
        driving = state.driving if state else UNSET
        if self._voice:
            self._follow_voice(self._voice, state)
        before, self._drivers = self._drivers, () if driving is UNSET else driving.drivers
        samples = side.sample(self.station.sending(), anew=self._drivers != before)
        self.station.take(samples, side.received(), side.sound)
        self._sampled = time.monotonic()
        notify("WATCHDOG=1")
        while self._requests and self._elapsed_s() >= self._requests[0].at_s:
            request = self._requests.popleft()
            self.station.ask(request.event, partial(self._note_reply, request))

    def _note_reply(self, request: TimedRequest, reply: Outcome) -> None:
        if reply.result != "applied":
            self.station.note(f"the request at {request.at_s:g} s was not applied: {reply.result}, {reply.reason}")

    def _elapsed_s(self) -> float:
        """Time since the vehicle came online; negative before."""
        now = time.monotonic()
        if self._online_at is None:
            if not self.station.state and now < self._latest_start:
                return -1.0
            self._online_at = now
        return now - self._online_at


class _MetricsListener(Listener):
    """Updates the metrics."""

    def __init__(self, metrics: SideMetrics) -> None:
        self._metrics = metrics
        metrics.show_online(False)  # until its state arrives, if it ever does: alerts need a value

    def on_state(self, state: VehicleState | None) -> None:
        self._metrics.show_online(state is not None)

    def on_sample(self, sample: Sample) -> None:
        self._metrics.take(sample)


def _recorded_sound() -> RecordedSound:
    from runner.operator.recorded_sound import RecordedSound

    return RecordedSound()


def _all_of(*handlers: OnSound | None) -> OnSound | None:
    """Calls each handler that there is."""
    given = [handler for handler in handlers if handler]

    def handle(packet: SoundPacket) -> None:
        for handler in given:
            handler(packet)

    return handle if given else None


def _demand() -> Demand:
    from runner.operator.demand import Demand

    return Demand()


def _voice(setup: Setup, station: Station, keyring: Keyring | None) -> VoiceSender | None:
    """What sends this operator's voice; None: the configuration has none."""
    plan = voice_plan(setup)
    if plan is None:
        return None
    from runner import apply

    def report(stream: str, what: str) -> None:
        station.note(f"{stream}: {what}")

    return apply.VoiceSender(plan, report, station.identity, keyring, setup.vehicle.name)


def _ros_pictures(setup: Setup, station: Station) -> DecodedPictures | None:
    """The ROS node that publishes decoded pictures; None if they are not published.

    raises  UserError
    """
    if not setup.ros.pictures:
        return None
    from runner.ros.pictures import DecodedPictures

    station.seen.state(None, by="ros")
    return DecodedPictures(setup, station.note, partial(station.seen.state, by="ros"))


@contextmanager
def live_operator(
    overrides: Sequence[str] = (),
    conf: Path | str | None = None,
    *,
    log: Path | None = None,
    site: Path | None = None,
    on_demand: bool = False,
) -> Iterator[LiveOperator]:
    """Run an operator's side; at the end it signs off from the vehicle and stops.

    overrides  Hydra overrides, as on the command line, also conf=DIR
    conf       directory of files of your own, which shadow the packaged ones
    log        directory that the drive is recorded to
    site       the site file of this machine; None: none is read
    on_demand  receive, and show itself to the vehicle, only as `LiveOperator.show` says
    raises     ConfigError, RunError, UserError if the directory already holds a drive
    """
    from runner import apply

    config = configuration(overrides, conf, runnable=False, check=apply.check_operator, site=site)
    setup, document = config.setup(), config.document
    plans, sound = compile_plans(setup), sound_plan(setup)
    keyring = viewer_keyring(setup)
    station = Station(setup, agreement.settings(document), keyring)
    versions = apply.versions(element for plan in (*plans, sound) if plan for element in plan.operator)
    pictures, requests = _ros_pictures(setup, station), config.experiment().requests
    drive = Log(log, "operator", document if log else {}, versions, station.note)
    recorded = _recorded_sound() if log and setup.log.sound and sound else None
    station.records_sound = recorded is not None
    if log:
        station.listeners.append(DriveLog(station, drive, recorded))
    video = apply.VideoFiles(log, drive.video, drive.video_shift) if log and setup.log.video else None

    def publish(camera: str, captured: float | None, width: int, height: int, data: bytes, region: Roi | None) -> None:
        assert pictures
        state = station.state
        pictures.put(camera, captured, width, height, data, state.cameras.get(camera) if state else None, region)

    def build(on_unit: OnUnit | None, on_sound: OnSound | None) -> OperatorSide:
        logged = log is not None
        return apply.OperatorSide(
            plans,
            lambda camera, what: station.note(f"{camera}: {what}"),
            on_unit,
            publish if pictures else None,
            arrivals=logged,
            video=video,
            operator=station.identity,
            keyring=keyring,
            vehicle=setup.vehicle.name,
            uplinks=station.addresses if setup.uplinks else None,
            cameras=() if on_demand else None,
            sound=sound,
            on_sound=_all_of(on_sound, recorded.add if recorded else None),
        )

    demand, voice = _demand() if on_demand else None, _voice(setup, station, keyring)
    operator = LiveOperator(setup, station, drive, build, requests, demand, voice)
    with ExitStack() as ending:  # in reverse order
        ending.callback(drive.close)
        if setup.control.embedded:
            from runner.mqtt.embedded import embedded_broker

            ending.enter_context(embedded_broker(setup, station.note))
        metrics = SideMetrics(setup.vehicle.name, setup.metrics.operator_port, log)
        station.listeners.append(_MetricsListener(metrics))
        ending.callback(metrics.close)
        if pictures:
            ending.callback(pictures.close)
        ending.callback(operator.stop)
        if pictures:
            pictures.start()
        metrics.serve(operator.problem, station.link)
        yield operator
