"""usage: tod-runner demo [-m] [OVERRIDE ...] [camera=CAMERA] [duration_s=60] [log=DIR] [output=OUT] [models=DIR]

Runs both sides on this machine: vehicle and operator as two processes over real RTSP and a real control link, along a
drive through a bandwidth map in mode A. Open the page that it prints, http://127.0.0.1:8090/, in a browser; the table
in the terminal shows the same. It shows as many cameras, the front one first, as this machine's cores draw at 15 Hz or
more without a GPU, and says which ones it left out. A vehicle, cameras, a rate or an experiment that you name is driven
as it is: vehicle=tum_q7 for all eight cameras; fps_max=40 for another rate, or null for the cameras' own.

With camera= it shows one camera of yours: a V4L2 device, a topic of ROS, an IP camera or a clip. A device is asked for
the size and rate that are nearest to 1280x720 at 30 Hz; `tod-runner doctor cameras` lists what it offers.

With log=DIR both sides write their logs to DIR. With output=OUT a report is written at the end, as by the verb report
(models= is passed to it); the drive is stored in OUT/drive, unless log= names another directory. An experiment defines
the drives; one with several runs makes several drives and compares them. With link= a rate-limited link connects both
sides; without it, predictions limit the total, since the loopback of this machine does not. keys= names the directory
with everyone's keys, see the verb keys.

With -m, commas and range() define a sweep: each combination of values is a run. Runs follow one another, each as if
started separately with output=OUT/0, OUT/1, ... and log=DIR/0, DIR/1, ...; all are checked before the first one starts.
OUT/runs.jsonl, or DIR/runs.jsonl, has a line for each run: its directory and its overrides.

  tod-runner demo                                             synthetic drive, a minute
  tod-runner demo vehicle=tum_q7                              all its cameras
  tod-runner demo camera=/dev/video0                          your webcam; or ros:/TOPIC, rtsp://..., CLIP.mp4
  tod-runner demo camera=/dev/video0 cameras.camera.capture.format=YUY2
  tod-runner demo duration_s=3600                             an hour
  tod-runner demo vehicle=delivery_robot duration_s=20
  tod-runner demo source=file source.clip=clip.mp4            every camera shows your clip
  tod-runner demo pqos.file=tum_bandwidth_map.yaml            along another map
  tod-runner demo experiment=driving_test output=OUT          the paper's driving test, with its figures
  tod-runner demo experiment=bottleneck output=OUT            three ways to share a rate-limited link
  tod-runner demo experiment=two_uplinks output=OUT           two uplinks, of which one is cut
  tod-runner demo -m modes=paper,safe output=OUT              the same drive under other rules
  tod-runner demo link=netns link.file=uplink.csv output=OUT  an uplink of your own; as root
"""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from runner.configuration.config import Configuration, configuration, with_choice
from runner.configuration.experiment import LinkSettings, lane_overrides
from runner.configuration.files import SITE_VARIABLE, conf_directories
from runner.drive.log import FILES, WITHOUT_LOG, Log, check_free
from runner.errors import ArgumentError, os_errors_as
from runner.link import LimitedLink, check_possible, limited_link
from runner.mqtt.broker import private_broker
from runner.plans import render_missing
from runner.security.exposure import KeysOfAll
from runner.settings import Setup
from runner.system import children, signals
from runner.system.children import VerbProcess
from runner.system.files import write_whole
from runner.verbs import Arguments
from runner.verbs.demo_choice import highest_rate, showable
from runner.verbs.own_camera import camera_words, check_device
from runner.verbs.report import check_report, report
from runner.verbs.screen import command_name, progress_bar, say, streaming

AS_GIVEN = ("vehicle", "cameras", "fps_max", "experiment")  # what keeps all cameras, if the user gives one of them
OTHER_VEHICLE = ("vehicle", "source", "experiment")  # of these, camera= chooses its own
FAREWELL_S = 0.3  # of the operator's side to its pages
LOOK_S = 0.05  # how soon the other side is stopped once one has ended
SIDE_END_S = signals.END_S + 0.2  # a side ends itself by force before it is killed
END_S = 2.8  # both sides, link and broker
DIRECTORIES = ("output", "log")  # arguments that get a directory for each run of a sweep
WITHOUT_SITE = {SITE_VARIABLE: ""}  # both sides are on this machine, whatever it is otherwise a part of
DRIVE = "drive"  # subdirectory of output= in which a drive is stored


class _Run(NamedTuple):
    """One of the drives.

    arguments   with the overrides of this one
    directory   where it is logged; None: not logged
    document    composed configuration
    duration_s  of the drive
    keys        of broker and both sides; None: nothing is encrypted
    """

    name: str
    arguments: Arguments
    setup: Setup
    directory: Path | None
    link: LinkSettings | None
    document: dict[str, Any]
    duration_s: float
    keys: KeysOfAll | None


class _Demo(NamedTuple):
    """The drives of an experiment, or the only one, and the report on them.

    shown  what is said of cameras and rate, if they were chosen for this machine
    """

    about: str
    shown: list[str]
    runs: list[_Run]
    output: Path | None
    models: Path | None
    bases: list[Path]


def run(arguments: Arguments) -> int:
    apply = streaming()
    if arguments.sweeps:
        return _sweep(arguments, apply)
    _run_demo(_prepare_demo(arguments, apply))
    return 0


def _sweep(arguments: Arguments, apply: ModuleType) -> int:
    """The demos of a sweep, one after the other."""
    from runner.verbs.sweep import prepare_all

    places = {key: path for key in DIRECTORIES if (path := arguments.path(key))}
    for key, place in places.items():
        _check_empty(key, place)
    numbers = count()
    demos = prepare_all(arguments, lambda own: _prepare_demo(own.in_directory(str(next(numbers)), DIRECTORIES), apply))
    lines = [json.dumps({"directory": str(number), "overrides": words}) for number, (words, _) in enumerate(demos)]
    for place in places.values():
        write_whole(place / "runs.jsonl", "".join(f"{line}\n" for line in lines).encode())
    for number, (words, demo) in enumerate(demos, 1):
        say(f"run {number} of {len(demos)}: {' '.join(words)}, {sum(one.duration_s for one in demo.runs):g} s")
        _run_demo(demo)
    return 0


def _prepare_demo(arguments: Arguments, apply: ModuleType) -> _Demo:
    """Collect and check everything a demo needs, before it begins."""
    arguments = _with_camera(arguments)
    arguments, config, shown = with_shown(arguments)
    experiment, link = config.experiment(), config.link()
    output, models = arguments.path("output"), arguments.path("models")
    if output:
        check_report(output, models)
        _check_empty("output", output)
    elif models:
        raise ArgumentError("models", models, "is for the report: give output=OUT")
    runs = [
        _prepare_run(arguments, name, words, config, link, apply)
        for name, words in (experiment.runs or {"": ()}).items()
    ]
    bases = [base / "cameras" for base in conf_directories(arguments.conf)]
    return _Demo(experiment.about, shown, runs, output, models, bases)


def _run_demo(demo: _Demo) -> None:
    for line in (*([demo.about] if demo.about else []), *demo.shown):
        say(line)
    with progress_bar() as progress:
        for one in demo.runs:
            render_missing(one.setup.vehicle, progress)
    driven = list[Path]()
    for number, one in enumerate(demo.runs, 1):
        if one.name:
            say(f"drive {number} of {len(demo.runs)}: {one.name}, {one.duration_s:g} s")
        _drive(one)
        driven += [one.directory] if one.directory else []
    if demo.output and driven:
        with signals.interruptible():
            say(f"report: {report(driven, demo.output, demo.models, demo.bases)}")


def _check_empty(key: str, directory: Path) -> None:
    """Check that everything in the directory of an argument will come from this demo.

    raises  UserError
    """
    wrong = partial(ArgumentError, key, directory)
    with os_errors_as(wrong):
        found = sorted(path.name for path in directory.iterdir()) if directory.exists() else []
    if found:
        names = f"{', '.join(found[:3])}{', ...' if len(found) > 3 else ''}"
        raise wrong(f"must be a new or empty directory, but contains {names}")


def _prepare_run(
    arguments: Arguments,
    name: str,
    words: Sequence[str],
    config: Configuration,
    link: LinkSettings | None,
    apply: ModuleType,
) -> _Run:
    """Check what a drive needs before the first one begins; `config` and `link` are those of a run without words."""
    own = replace(arguments, overrides=[*arguments.overrides, *words])
    directory = _directory(arguments, name)
    if words:
        config = configuration(own.overrides, own.conf, runnable=False)
        link = config.link()
    if link is None and "follow_link" in config.document["modes"]["automatic"]:
        # A prediction is a limit here: this machine's loopback carries more than two cores can encode.
        own = replace(own, overrides=["++modes.automatic.follow_link.ceiling=prediction", *own.overrides])
        config = configuration(own.overrides, own.conf, runnable=False)
    if link and directory is None:
        raise ArgumentError("link", link.kind, "needs a log to show its effect: give log=DIR or output=OUT")
    if link:
        check_possible(link.kind)
    own = replace(own, overrides=[*_calibrated(config), *with_choice(own.overrides, "pqos", config)])
    config = config.drivable(apply.check_plan)
    config.pqos()
    setup = config.setup()
    # In network namespaces of its own, a link replaces the hosts.
    is_open = setup.keys is None and not (setup.control.foreign or setup.control.embedded)
    keys = None if is_open and link and link.kind == "netns" else KeysOfAll.of(setup)
    if keys and link and link.kind == "relay":
        rule = "rewrites ports in RTSP, which keys encrypt; link=netns passes it unread"
        raise ArgumentError("link", link.kind, rule)
    duration_s = arguments.number("duration_s")
    duration_s = config.experiment().duration_s if duration_s is None else duration_s
    return _Run(name, own, setup, directory, link, config.document, duration_s, keys)


def _calibrated(config: Configuration) -> list[str]:
    """Overrides that state what the demo knows of both sides: a rendered clip has its camera's very pose and lens."""
    rendered = [camera.name for camera in config.vehicle().cameras.values() if camera.source.render]
    return [f"++cameras.{name}.calibrated=true" for name in rendered]


def _with_camera(arguments: Arguments) -> Arguments:
    """With the overrides of camera=, if it is given.

    raises  UserError
    """
    camera = arguments.values.get("camera")
    if camera is None:
        return arguments
    if named := next((key for key in OTHER_VEHICLE if _about(arguments.overrides, [key])), None):
        raise ArgumentError("camera", camera, f"must not be given with {named}=: it is a vehicle of one camera")
    chosen = replace(arguments, overrides=[*camera_words(camera), *arguments.overrides])
    cameras = configuration(chosen.overrides, chosen.conf, runnable=False).vehicle().cameras
    for each in cameras.values():
        check_device(each)
    return chosen


def with_shown(arguments: Arguments) -> tuple[Arguments, Configuration, list[str]]:
    """Add cameras and frame rate that this machine can show, where neither the user nor an experiment states them.

    returns  also what to say about it
    raises   ConfigError
    """
    config = configuration(arguments.overrides, arguments.conf, runnable=False)
    if config.document.get("fps_max") is not None or _about(arguments.overrides, ["fps_max"]):
        return arguments, config, []
    cameras, cores = list(config.vehicle().cameras.values()), len(os.sched_getaffinity(0))
    names = [camera.name for camera in cameras]
    every = choice = highest_rate(cameras, cores)
    if arguments.conf is None and not _about(arguments.overrides, AS_GIVEN, names):
        choice = showable(cameras, cores)
    left_out = [name for name in names if name not in choice.cameras]
    words = [f"~cameras.{name}" for name in left_out]
    words += [f"fps_max={choice.fps_max}"] if choice.fps_max else []
    if not words:
        return arguments, config, []
    chosen = replace(arguments, overrides=[*words, *arguments.overrides])
    if left_out:
        told = [
            f"{len(choice.cameras)} of {len(names)} cameras{choice.rate}: as many as {cores} cores show smoothly",
            f"left out: {', '.join(left_out)}",
            f"all {len(names)}{every.rate}: {_command(arguments, config)}",
        ]
    else:
        told = [
            f"{len(names)} cameras{choice.rate}: as fast as {cores} cores show them; fps_max=null: at their own rates"
        ]
    return chosen, configuration(chosen.overrides, chosen.conf, runnable=False), told


def _about(overrides: Iterable[str], keys: Sequence[str], names: Sequence[str] = ()) -> bool:
    """Whether one of the overrides sets one of these keys, or mentions one of these names."""
    mentioned = re.compile(rf"\b({'|'.join(map(re.escape, names))})\b") if names else None
    return any(
        re.split("[.=@]", word.lstrip("+~/"))[0] in keys or (mentioned and mentioned.search(word)) for word in overrides
    )


def _command(arguments: Arguments, config: Configuration) -> str:
    """The command line that drives all cameras of the vehicle."""
    given = [*arguments.overrides, *(f"{key}={value}" for key, value in arguments.values.items())]
    return shlex.join([command_name(), "demo", *given, f"vehicle={config.choices['vehicle']}"])


def _directory(arguments: Arguments, run: str) -> Path | None:
    """Where a drive is logged; None: not logged.

    raises  UserError if there is one already
    """
    output, log = arguments.path("output"), arguments.path("log")
    if log is None and output is None:
        return None
    directory = log or (output / DRIVE if output and not run else output)
    assert directory is not None
    directory = directory / run if run else directory
    for side in FILES:
        check_free(directory, side)
    return directory


def _drive(run: _Run) -> None:
    """Run one drive of both sides.

    raises  RunError if a part of it ends early, KeyboardInterrupt after a signal
    """
    own = [*run.arguments.overrides, *([f"conf={run.arguments.conf}"] if run.arguments.conf else [])]
    own += [f"log={run.directory}"] if run.directory else []
    began = time.monotonic()
    with (
        signals.stopping(END_S),
        _link(run) as (link, log),
        private_broker(
            link.broker if link else run.setup.control, run.keys.broker if run.keys else None, say
        ) as broker,
        _sides(own, link, run) as (vehicle, operator),
    ):
        for note in link.notes if link else ():
            say(note)
        waiting = link is not None
        while True:
            signals.check()
            for part in (broker, link, vehicle):
                if part:
                    part.check()
            status = operator.poll()  # polled once: it may end at any moment, and after duration_s that is expected
            if status == 0 and time.monotonic() >= began + run.duration_s:
                break
            if status is not None:
                operator.check()
            if waiting and link and run.directory and (at := _began(run.directory)):
                waiting = False
                log.begin(at)
                link.start(at)
            time.sleep(LOOK_S)


@contextmanager
def _sides(words: Sequence[str], link: LimitedLink | None, run: _Run) -> Iterator[tuple[VerbProcess, ...]]:
    """Both sides as processes, vehicle and operator. The vehicle's error output is shown only if it failed."""
    to_vehicle, to_operator = (link.vehicle_overrides, link.operator_overrides) if link else ((), ())
    to_vehicle = (*to_vehicle, *(lane_overrides(run.document) if link else ()))
    if run.keys:
        to_vehicle = (*to_vehicle, f"keys={run.keys.vehicle}")
        to_operator = (*to_operator, f"keys={run.keys.controller}")
    to_operator = (*to_operator, f"duration_s={run.duration_s}")
    with tempfile.TemporaryFile("w+") as stderr, tempfile.TemporaryDirectory() as state, ExitStack() as stack:
        before = link.vehicle_command if link else ()
        own = {**WITHOUT_SITE, "XDG_STATE_HOME": state}  # each drive is a new one
        sides = (
            VerbProcess("the vehicle's side", "vehicle", [*words, *to_vehicle], before, stderr, own),
            VerbProcess("the operator's side", "operator", [*words, *to_operator], env=own),
        )
        for side in sides:
            stack.enter_context(signals.urgent(side.kill))
        try:
            yield sides
        finally:
            _end(sides)
            stderr.seek(0)
            for line in stderr:
                if WITHOUT_LOG in line:
                    say(line.rstrip())


def _end(sides: Sequence[VerbProcess]) -> None:
    """Ask both sides to end, and kill those that do not.

    sides  vehicle and operator: the page is told that the operator's side ends before it learns that the vehicle is
           gone, which is an alarm
    """
    until = time.monotonic() + SIDE_END_S
    vehicle, operator = sides
    operator.request_end()
    with suppress(subprocess.TimeoutExpired):
        operator.process.wait(FAREWELL_S)
    vehicle.request_end()
    for side in sides:
        if not children.end(side.process, max(0.0, until - time.monotonic())):
            left = " but still runs, blocked in the kernel" if side.poll() is None else ""
            say(f"{side.name} did not end within {SIDE_END_S:g} s and was killed{left}")


@contextmanager
def _link(run: _Run) -> Iterator[tuple[LimitedLink | None, Log]]:
    """The limited link between the sides, if there is one, and its log."""
    settings = run.link
    if settings is None:
        yield None, Log(None, "link", {}, {}, say)
        return
    log = Log(run.directory, "link", run.document, {}, say)
    try:
        media, control = run.setup.media, run.setup.control
        dials = any(camera.graph.transport != "rtsp" for camera in run.setup.vehicle.cameras.values())
        with limited_link(
            settings.kind, settings.limit, media, control, log.record, dials=dials, lanes=settings.lanes
        ) as link:
            yield link, log
    finally:
        log.close()


def _began(directory: Path) -> float | None:
    """Start time of the vehicle's side, s since 1970; None: it has not started yet."""
    try:
        with (directory / FILES["vehicle"]).open(encoding="utf-8") as file:
            return float(json.loads(file.readline())["time"])
    except (OSError, ValueError):
        return None
