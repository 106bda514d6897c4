"""A streaming vehicle: cameras, loop and control link together. For the verb `vehicle` and for programs.

with live_vehicle(["source=appsrc"]) as vehicle:
    vehicle.start()                               # the loop runs in its own thread
    while driving:
        vehicle.push("front_left", frame, format="bgr")    # an array of height x width x 3
"""

from __future__ import annotations

import queue
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from msgspec import UNSET

from runner.configuration import agreement
from runner.configuration.config import Configuration, configuration
from runner.core.driving import Driving
from runner.core.model import Progress
from runner.drive.log import Log, check_free
from runner.errors import RunError, UserError
from runner.metrics.side import SideMetrics
from runner.mqtt.link import ControlLink, login_of
from runner.mqtt.messages import (
    OFFLINE,
    JsonObject,
    MqttMessage,
    is_will,
    read_reception,
    read_request,
    read_settings,
    read_state,
    read_telemetry,
    run_of,
    topic,
)
from runner.plans import as_offered, compile_plans, drive_steering, other_plans, render_missing, stream_addresses
from runner.records import to_json
from runner.records.vehicle import ClockAnswer, Outcome, Settings, SpeedAdvice, SteeringAngle, Telemetry, VehicleState
from runner.security.exposure import may_listen, vehicle_keyring
from runner.security.keyring import Keyring
from runner.settings import Setup
from runner.system.held_up import LateCheck
from runner.system.interfaces import number_of
from runner.system.kernel_clock import clock_error_s, wall_ahead_s
from runner.system.service import notify
from runner.vehicle.access import Access
from runner.vehicle.holder import Held, KeptHolder
from runner.vehicle.inbox import QueuedReport, Request
from runner.vehicle.loop import ControlLoop

if TYPE_CHECKING:
    from runner.apply import VehicleSide
    from runner.mqtt.ways import ControlLinks
    from runner.ros.cameras import RosCameras, SharedPicture

PictureFormat = Literal["i420", "bgr", "rgb", "grey"]
DRIVING = {"pqos": "live"}  # choices in place of the packaged ones: a vehicle drives where it is, not along a map
STUCK_S = 2.0  # a thread that finishes nothing for this long is stuck
WATCH_S = 0.25  # how often that is checked
END_S = 5.0  # a loop that does not end within this is abandoned
NAME_CHECK_S = 0.5  # telemetry is sent five times a second; without any within this time, the name is free
CONSOLE_LINES = 1000
TOPICS = {
    VehicleState: "state",
    Telemetry: "telemetry",
    Settings: "configuration",
    SpeedAdvice: "advice",
    SteeringAngle: "steering",
}


class LiveVehicle:
    """The parts of a streaming vehicle.

    side     the cameras
    loop     events in, commands out; `loop.post` takes events from any thread
    driving  who drives it now
    failure  why the vehicle had to end; None: it is running, or was stopped
    """

    def __init__(
        self, side: VehicleSide, loop: ControlLoop, holder: KeptHolder, on_driving: Callable[[Driving], None]
    ) -> None:
        self.side, self.loop = side, loop
        self.driving = Driving()
        self._holder, self._on_driving = holder, on_driving
        loop.on_driving = self._follow
        self.failure: RunError | None = None
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()
        self._watchdog = threading.Thread(target=self._watch, name="watchdog", daemon=True)

    def _follow(self, driving: Driving) -> None:
        self.driving = driving
        self._holder.keep(Held(driving.holder or "", driving.stop or ""))
        self._on_driving(driving)

    def start(self) -> None:
        """Run the loop in a thread, until the vehicle is stopped."""
        self._thread = threading.Thread(target=self._run_in_thread, name="loop", daemon=True)
        self._thread.start()

    def run(self, duration_s: float | None = None) -> None:
        """Run the loop in this thread, until `stop` or for a given time.

        raises  RunError if the vehicle had to end, for example because another one has its name
        """
        self._watchdog.start()
        notify("READY=1")
        try:
            self.loop.run(duration_s)
        finally:
            notify("STOPPING=1")
            self._ended.set()
        if self.failure:
            raise self.failure

    def _run_in_thread(self) -> None:
        try:
            self.run()
        except RunError as error:
            self.failure = error
            self.loop.on_report(str(error))

    def push(
        self, camera: str, frame: Any, *, format: PictureFormat | None = None, captured: float | None = None
    ) -> bool:
        """One frame of a camera whose source is `appsrc`, of the camera's (native) size; in order of capture.

        frame     bytes, or an array of uint8: height x width is grey, height * 3 / 2 x width, like bytes, I420, and
                  height x width x 3 needs `format`
        format    what it is; None: by its shape
        captured  s since 1970 by this machine's clock; None: now
        returns   False if the frame was discarded: nobody is watching, or it was captured before the last one
        raises    ValueError for a frame of another size, a capture time more than a minute from now, or an unknown
                  camera
        """
        return self.side.push(camera, frame, format, captured)

    def fail(self, error: RunError) -> None:
        """End with an error, from any thread."""
        self.failure = error
        self.loop.stop()

    def stop(self) -> None:
        self.loop.stop()
        if self._thread:
            self._thread.join(END_S)

    def _watch(self) -> None:
        """Report a part that hangs, for example a rule that never returns, and its recovery."""
        before: dict[str, str] = {}
        late = LateCheck()
        while not self._ended.wait(WATCH_S):
            hanging = self._hanging()
            if late.is_excused(time.monotonic()):  # the next check shows which part hangs
                hanging = {part: why for part, why in hanging.items() if part in before}
            for part in hanging.keys() - before.keys():
                self.loop.on_report(hanging[part])
            for part in before.keys() - hanging.keys():
                self.loop.on_report(f"{part} runs again")
            before = hanging
            if not hanging:
                notify("WATCHDOG=1")

    def problem(self) -> str | None:
        """Why the vehicle does not work; None if it works."""
        return "; ".join(self._hanging().values()) or None

    def _hanging(self) -> dict[str, str]:
        """By part that makes no progress, what to say about it."""
        now = time.monotonic()
        parts = {
            "the control loop": (self.loop.beat, f" in {self.loop.busy_with or 'nothing'}"),
            "GStreamer's thread": (self.side.beat, ""),
        }
        return {part: f"{part} hangs{where}" for part, (beat, where) in parts.items() if now - beat > STUCK_S}


class _Console:
    """Prints lines in a separate thread, so that a stopped terminal (Ctrl-S) blocks nothing else."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._lines: queue.Queue[str | None] = queue.Queue(CONSOLE_LINES)
        self._thread = threading.Thread(target=self._run, name="console", daemon=True)
        self._thread.start()

    def say(self, line: str) -> None:
        with suppress(queue.Full):
            self._lines.put_nowait(line)

    def close(self) -> None:
        with suppress(queue.Full):
            self._lines.put(None, timeout=WATCH_S)
        self._thread.join(WATCH_S)

    def _run(self) -> None:
        while (line := self._lines.get()) is not None:
            with suppress(OSError):  # a closed pipe or a full disk must not end it
                self._say(line)


class _VehicleControl:
    """The vehicle's end of the control link: requests in, replies, state, telemetry and configuration out.

    Nothing is published until it is certain that no other vehicle of this name is connected to the broker.
    """

    def __init__(
        self,
        setup: Setup,
        document: Mapping[str, Any],
        on_report: Callable[[str], None],
        keyring: Keyring | None = None,
    ) -> None:
        self._name, self._on_report = setup.vehicle.name, on_report
        self._settings = Settings(uuid.uuid4().hex, agreement.settings(document))
        self._others: set[str] = set()
        self._is_name_free = threading.Event()
        self._announce_timer: threading.Timer | None = None
        listen = {
            self._topic("request", "+"): self._on_request,
            self._topic("reception", "+"): self._on_reception,
            self._topic("telemetry"): self._on_telemetry,
            self._topic("state"): self._on_state,
            self._topic("configuration"): self._on_configuration,
        }
        will = (self._topic("state"), OFFLINE)
        self.link = _link(setup, will, listen, self._on_connected, on_report, keyring)

    def connect(self, live: LiveVehicle) -> None:
        self._live = live
        self.link.connect()

    def publish(self, record: VehicleState | Telemetry | Settings | SpeedAdvice | SteeringAngle) -> bool:
        """Publish a record; returns False if it has to wait because the link is behind."""
        ends = self.link.certificate_ends().get("own")
        if isinstance(record, VehicleState) and ends is not None:
            record = replace(record, certificate_ends=ends)
        return not self._is_name_free.is_set() or self.link.publish(self._topic(TOPICS[type(record)]), to_json(record))

    def close(self) -> None:
        if self._announce_timer:
            self._announce_timer.cancel()
        self.link.close(*([(self._topic("state"), OFFLINE)] if self._is_name_free.is_set() else []))

    def _topic(self, *parts: str) -> str:
        return topic(self._name, *parts)

    def _on_connected(self, connected: bool) -> None:
        if self._announce_timer and not connected:
            self._announce_timer.cancel()  # it has not listened for long enough
            self._announce_timer = None
        elif connected and self._is_name_free.is_set():
            self._announce()
        elif connected and not self._announce_timer:
            self._announce_timer = threading.Timer(NAME_CHECK_S, self._announce)
            self._announce_timer.daemon = True
            self._announce_timer.start()

    def _announce(self) -> None:
        if self._live.failure:
            return
        self._is_name_free.set()
        self.publish(self._settings)
        self._live.loop.publish_again()  # the broker may have published the last will, or lost everything

    def _on_request(self, message: MqttMessage) -> None:
        if self._live.loop.refusals.overrun(message.sender):
            return
        parsed = read_request(message)
        reply = self._topic("reply", message.sender)

        def answer(outcome: Outcome) -> None:
            self.link.publish(reply, {"id": parsed.identity, **to_json(outcome)})

        will, run = is_will(parsed.identity), run_of(parsed.identity)
        request = Request(message.sender, parsed.document, answer, parsed.as_of, will, run)
        if parsed.problem:
            self._live.loop.refusals.refuse(request, parsed.problem)
        else:
            self._live.loop.take(request)

    def _on_reception(self, message: MqttMessage) -> None:
        received = time.time()
        if self._live.loop.refusals.overrun(message.sender, reports=True):
            return
        try:
            report = read_reception(message)
        except ValueError:
            self._live.loop.refusals.reject(message.sender)
            raise
        clock_topic = self._topic("clock", message.sender)

        def state_clock() -> None:
            assert report.sent is not UNSET
            now = time.time()
            answer = ClockAnswer(report.sent, received, now, wall_ahead_s(), clock_error_s())
            self.link.publish(clock_topic, to_json(answer))

        self._live.loop.take(QueuedReport(message.sender, report, None if report.sent is UNSET else state_clock))

    def _on_telemetry(self, message: MqttMessage) -> None:
        """Before this vehicle has published anything, live telemetry comes from another vehicle."""
        if not self._is_name_free.is_set() and not message.retained and read_telemetry(message.payload):
            rule = "choose another `name`, or stop the other vehicle"
            self._live.fail(RunError(f"a vehicle named {self._name} is already connected to the broker; {rule}"))

    def _on_state(self, message: MqttMessage) -> None:
        """Correct a last will: of another uplink, or one that the broker publishes late, when the vehicle is back."""
        if self._is_name_free.is_set() and not isinstance(read_state(message.payload), VehicleState):
            self._live.loop.publish_again()

    def _on_configuration(self, message: MqttMessage) -> None:
        run = read_settings(message.payload).run
        own = run == self._settings.run
        if self._is_name_free.is_set() and not message.retained and not own and run not in self._others:
            self._others.add(run)
            self._on_report(f"another vehicle named {self._name} connected to the broker: operators see both")


def _link(
    setup: Setup,
    will: tuple[str, JsonObject],
    listen: Mapping[str, Callable[[MqttMessage], None]],
    on_connected: Callable[[bool], None],
    on_report: Callable[[str], None],
    keyring: Keyring | None,
) -> ControlLink | ControlLinks:
    """The control link, over each of several uplinks."""
    control, new_login = setup.control, partial(login_of, setup.control, keyring)
    if len(setup.uplinks) > 1:
        from runner.mqtt.ways import ControlLinks, ways_to

        if len(ways := ways_to(control, setup.uplinks)) > 1:
            return ControlLinks(control, ways, will, listen, on_connected, on_report, new_login, control.prefix)
    return ControlLink(control, will, listen, on_connected, on_report, new_login(on_report), prefix=control.prefix)


@contextmanager
def _embedded_broker(setup: Setup, report: Callable[[str], None]) -> Iterator[None]:
    """raises UserError also for a vehicle of which no address is the one"""
    if not setup.control.embedded:
        yield
        return
    if len(setup.uplinks) > 1:
        rule = "a vehicle with several uplinks has several addresses: give it to the operator's side"
        raise UserError("", "control.broker", "embedded", rule)
    from runner.mqtt.embedded import embedded_broker

    with embedded_broker(setup, report):
        yield


def _check_ros(setup: Setup) -> None:
    """raises UserError if the ROS node would discover unauthenticated nodes"""
    if any(camera.topic for camera in setup.vehicle.cameras.values()):
        from runner.ros.process import check_discovery

        check_discovery(setup.ros, setup.insecure)


def missing_devices(setup: Setup) -> list[str]:
    """Uplinks whose device does not exist, or not yet. raises RunError if the vehicle must not start without one"""
    missing = [
        f"uplink {name}: {uplink.interface}: no such device"
        for name, uplink in setup.uplinks.items()
        if uplink.interface and not number_of(uplink.interface)
    ]
    if missing and setup.strict:
        raise RunError("; ".join(missing))
    return [f"{each}; it is used once there is one" for each in missing]


def ros_cameras(
    setup: Setup, push: Callable[[str, SharedPicture], bool], report: Callable[[str], None]
) -> RosCameras | None:
    """The node that subscribes to the topics of a vehicle's cameras; None if no camera has one."""
    if not any(camera.topic for camera in setup.vehicle.cameras.values()):
        return None
    from runner.ros.cameras import RosCameras

    def on_report(camera: str, what: str) -> None:
        report(f"{camera}: {what}" if camera else what)

    return RosCameras(setup.ros, setup.vehicle.cameras.values(), push, on_report, setup.insecure)


def _checked(overrides: Sequence[str], conf: Path | str | None, site: Path | None) -> Configuration:
    from runner import apply

    config = configuration(overrides, conf, files=False, check=apply.check_vehicle, site=site, instead=DRIVING)
    return config.drivable(apply.check_vehicle) if config.document.get("strict") else config


@contextmanager
def live_vehicle(
    overrides: Sequence[str] = (),
    conf: Path | str | None = None,
    *,
    log: Path | str | None = None,
    state: Path | str | None = None,
    say: Callable[[str], None] = print,
    progress: Progress = lambda what, done: None,
    site: Path | None = None,
    on_driving: Callable[[Driving], None] = lambda driving: None,
) -> Iterator[LiveVehicle]:
    """Run the vehicle's side; at the end it is stopped and disconnected.

    overrides, conf, site  as in `live_operator`; pqos is live unless stated
    log         directory that the drive is recorded to
    state       directory that keeps who is in control over a restart; None: the next process does not know
    say         called, from a separate thread, with one line per event
    progress    called with the progress of rendering a synthetic drive
    on_driving  called, in the loop's thread, with who drives whenever that changes: for a steering stack
    raises      ConfigError, RunError
    """
    from runner import apply

    log = Path(log) if log else None
    config = _checked(overrides, conf, site)
    (pqos, track), document, rates = config.pqos(), config.document, list[str]()
    setup = as_offered(config.setup(), rates.append)
    keyring = vehicle_keyring(setup)
    _check_ros(setup)
    render_missing(setup.vehicle, progress)
    plans, (sound, voice) = compile_plans(setup), other_plans(setup)
    lost, missing = apply.check_machine(plans, sound, voice, strict=setup.strict), missing_devices(setup)
    if log and setup.strict:
        check_free(log, "vehicle")
    console = _Console(say)
    with ExitStack() as ending:  # in reverse order, also of a vehicle that cannot start
        ending.callback(console.close)
        versions = apply.versions(e for p in (*plans, sound, voice) if p for e in (*p.source, *p.vehicle))
        drive = Log(log, "vehicle", document if log else {}, versions, console.say)
        ending.callback(drive.close)

        def report(what: str) -> None:
            console.say(what)
            drive.note(what)

        for found in (*rates, *missing):
            report(found)
        video = apply.VideoFiles(log, drive.video, drive.video_shift) if log and setup.log.video else None
        lossless = apply.LosslessFiles(log, drive.lossless) if log else None
        side = apply.VehicleSide(
            plans,
            setup.media,
            lambda camera, what: report(f"{camera}: {what}"),
            video,
            keyring,
            lost,
            setup.uplinks,
            partial(may_listen, setup),
            sound,
            voice,
            lossless,
        )
        ending.callback(side.stop)
        ending.enter_context(_embedded_broker(setup, report))
        control = _VehicleControl(setup, document, report, keyring)
        ending.callback(control.close)
        metrics = SideMetrics(setup.vehicle.name, setup.metrics.vehicle_port, log)
        ending.callback(metrics.close)

        def publish(record: VehicleState | Telemetry | SpeedAdvice | SteeringAngle) -> bool:
            metrics.take(record)
            return control.publish(record)

        holder = KeptHolder(Path(state) / f"{setup.vehicle.name}.json" if state else None, report)
        ending.callback(holder.close)
        access, steering = Access(keyring, report), drive_steering(setup)
        loop = ControlLoop(setup, side, pqos, track, drive, publish, report, access, steering, holder.former)
        side.on_turned = loop.wake
        live = LiveVehicle(side, loop, holder, on_driving)
        if ros := ros_cameras(setup, side.push_shared, report):
            ending.callback(ros.close)
        ending.callback(live.stop)
        if ros:
            ros.start(patient=not setup.strict)
        metrics.serve(live.problem, control.link)
        control.connect(live)
        for line in stream_addresses(setup.media, plans, sound, voice):
            console.say(line)
        yield live
