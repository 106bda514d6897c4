"""usage: tod-runner demo [OVERRIDE ...] [duration_s=60] [log=DIR] [output=OUT] [models=DIR]

Both sides on this machine: vehicle and operator as two processes over real RTSP and a real control link, along a drive
through a bandwidth map in mode A. Open the page that it names, http://127.0.0.1:8090/, in a browser; the table in the
terminal shows the same. Every camera runs at 5 Hz for each core, which carries eight full HD cameras, both sides and a
browser without a GPU; give fps_max=40, or null for the cameras' own rates.

With log=DIR both sides write what they do and see to DIR. With output=OUT a report is made at the end, as by the verb
report (models= goes there); the drive then lies in OUT/drive, where no log= says otherwise. An experiment states what
is driven; one with several runs makes several drives and compares them. With link= a link of limited rate joins both
sides.

  tod-runner demo                                             synthetic drive, a minute
  tod-runner demo duration_s=3600                             an hour
  tod-runner demo vehicle=delivery_robot duration_s=20
  tod-runner demo source=file source.clip=clip.mp4            every camera shows your clip
  tod-runner demo pqos.file=tum_bandwidth_map.yaml            along another map
  tod-runner demo experiment=driving_test output=OUT          the paper's driving test, with its figures
  tod-runner demo experiment=bottleneck output=OUT            three ways to share a link that is really limited
  tod-runner demo link=netns link.file=uplink.csv output=OUT  an uplink of your own; as root
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from runner.broker import private_broker
from runner.compose import conf_directories
from runner.config import composed, load_experiment, load_run
from runner.drive.log import FILES, WITHOUT_LOG, Log, check_free
from runner.errors import RunError, UserError
from runner.experiment import LinkSettings
from runner.link import LimitedLink, limited_link
from runner.model import Vehicle
from runner.sources import render_missing
from runner.verbs import Arguments
from runner.verbs.report import check_report, report
from runner.verbs.screen import progress_bar, say, streaming

FPS_PER_CORE = 5  # Hz; what is encoded, sent, decoded and shown eight times without falling behind
LOOK_S = 0.05  # how soon after a side's end the other is stopped
DRIVE = "drive"  # where a drive lies below output=


class _Run(NamedTuple):
    """One of the drives that are made.

    arguments  with the overrides of this one
    directory  where it is logged; None: nowhere
    """

    name: str
    arguments: Arguments
    vehicle: Vehicle
    directory: Path | None
    link: LinkSettings | None


def run(arguments: Arguments) -> int:
    apply = streaming()
    arguments = _with_rate(arguments)
    experiment, link = load_experiment(arguments.overrides, arguments.conf)
    duration_s = arguments.number("duration_s")
    duration_s = experiment.duration_s if duration_s is None else duration_s
    output, models = arguments.path("output"), arguments.path("models")
    if output:
        check_report(output, models)
    elif models:
        raise UserError("command line", "models", repr(str(models)), "is for the report: give output=OUT")
    runs = [_prepared(arguments, name, words, link, apply) for name, words in (experiment.runs or {"": ()}).items()]
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: no side is left behind
    if experiment.about:
        say(experiment.about)
    status, driven = 0, list[Path]()
    for number, one in enumerate(runs, 1):
        if one.name:
            say(f"drive {number} of {len(runs)}: {one.name}, {duration_s:g} s")
        status = _drive(one, duration_s)
        if status:
            break
        driven += [one.directory] if one.directory else []
    if output and driven:
        bases = [base / "cameras" for base in conf_directories(arguments.conf)]
        say(f"report: {report(driven, output, models, bases)}")
    return status


def _prepared(
    arguments: Arguments, name: str, words: Sequence[str], link: LinkSettings | None, apply: ModuleType
) -> _Run:
    """All that a drive needs, looked at before the first begins; `link` is that of a run which adds nothing."""
    own = replace(arguments, overrides=[*arguments.overrides, *words])
    directory = _directory(arguments, name)
    if words:
        _, link = load_experiment(own.overrides, own.conf)
    if link and directory is None:
        raise UserError(
            "command line", "link", link.kind, "what it does is to be looked at: give log=DIR or output=OUT"
        )
    vehicle, _, _ = load_run(own.overrides, own.conf, check=apply.check_plan)
    with progress_bar() as progress:
        render_missing(vehicle, progress)
    return _Run(name, own, vehicle, directory, link)


def _with_rate(arguments: Arguments) -> Arguments:
    """With a frame rate that this machine carries, where neither the user nor an experiment names one."""
    if any(word.lstrip("+~").startswith("fps_max") for word in arguments.overrides):
        return arguments
    if composed(arguments.overrides, arguments.conf).document.get("fps_max") is not None:
        return arguments
    fps_max = f"fps_max={FPS_PER_CORE * len(os.sched_getaffinity(0))}"
    return replace(arguments, overrides=[fps_max, *arguments.overrides])


def _directory(arguments: Arguments, run: str) -> Path | None:
    """Where a drive is logged; None: nowhere.

    raises  UserError where one lies there already
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


def _drive(run: _Run, duration_s: float) -> int:
    """One drive of both sides; returns the operator's exit status.

    raises  RunError where the vehicle's side or the link ends before the operator's
    """
    own = [*run.arguments.overrides, *([f"conf={run.arguments.conf}"] if run.arguments.conf else [])]
    own += [f"log={run.directory}"] if run.directory else []
    with (
        tempfile.TemporaryFile("w+") as said,
        _link(run) as (link, log),
        private_broker(link.broker if link else run.vehicle.control),
        _side("vehicle", [*own, *(link.vehicle_overrides if link else ())], link, said.fileno()) as vehicle,
        _side("operator", [*own, *(link.operator_overrides if link else ()), f"duration_s={duration_s}"]) as operator,
    ):
        waiting = link is not None
        try:
            while (status := operator.poll()) is None and vehicle.poll() is None:
                if waiting and link and run.directory and (began := _began(run.directory)):
                    waiting = False
                    log.begin(began)
                    link.start(began)
                if link:
                    link.check()
                time.sleep(LOOK_S)
        finally:
            early = vehicle.poll()
            for side in (operator, vehicle):
                side.terminate()
            for side in (operator, vehicle):
                side.wait()
        said.seek(0)
        text = said.read().strip()
        if early is not None:
            raise RunError(f"the vehicle's side ended early:\n{text}")
        for line in text.splitlines():
            if WITHOUT_LOG in line:
                say(line)
    return status or 0


@contextmanager
def _link(run: _Run) -> Iterator[tuple[LimitedLink | None, Log]]:
    """The limited link between the sides, where there is one, and its log."""
    settings = run.link
    if settings is None:
        yield None, Log(None, "link", {}, {}, say)
        return
    config = composed(run.arguments.overrides, run.arguments.conf).document
    log = Log(run.directory, "link", config, {}, say)
    try:
        media, control = run.vehicle.media, run.vehicle.control
        with limited_link(settings.kind, settings.limit, media, control, log.write) as link:
            yield link, log
    finally:
        log.close()


def _began(directory: Path) -> float | None:
    """When the vehicle's side began to drive, s since 1970; None: it has not yet."""
    try:
        with (directory / FILES["vehicle"]).open(encoding="utf-8") as file:
            return float(json.loads(file.readline())["time"])
    except (OSError, ValueError):
        return None


def _side(
    verb: str, words: Sequence[str], link: LimitedLink | None = None, stderr: int | None = None
) -> subprocess.Popen[bytes]:
    """One side in a process of its own, with the same Python."""
    command = [*(link.vehicle_command if link else ()), sys.executable, "-m", "runner", verb, *words]
    root = str(Path(__file__).resolve().parents[2])
    paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
    return subprocess.Popen(command, stderr=stderr, env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)})
