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

from runner.broker import private_broker
from runner.compose import conf_directories
from runner.config import composed, load_experiment, load_run
from runner.drive.log import FILES, Log, check_free
from runner.errors import RunError, UserError
from runner.experiment import LinkSettings
from runner.link import LimitedLink, limited_link
from runner.model import Vehicle
from runner.sources import render_missing
from runner.verbs import Arguments
from runner.verbs.screen import progress_bar, say, streaming

FPS_PER_CORE = 5  # Hz; what is encoded, sent, decoded and shown eight times without falling behind
LOOK_S = 0.05  # how soon after a side's end the other is stopped
DRIVE = "drive"  # where a drive lies below output=


def run(arguments: Arguments) -> int:
    apply = streaming()
    arguments = _with_rate(arguments)
    experiment, link = load_experiment(arguments.overrides, arguments.conf)
    duration_s = arguments.number("duration_s")
    duration_s = experiment.duration_s if duration_s is None else duration_s
    runs = experiment.runs or {"": ()}
    drives = {name: _directory(arguments, name) for name in runs}
    if link and None in drives.values():
        raise UserError(
            "command line", "link", link.kind, "what it does is to be looked at: give log=DIR or output=OUT"
        )
    vehicles = {}
    for name, words in runs.items():
        overrides = [*arguments.overrides, *words]
        vehicles[name], _, _ = load_run(overrides, arguments.conf, check=apply.check_plan)
        with progress_bar() as progress:
            render_missing(vehicles[name], progress)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: no side is left behind
    status = 0
    for number, (name, words) in enumerate(runs.items(), 1):
        if name:
            say(f"drive {number} of {len(runs)}: {name}, {duration_s:g} s")
        own = replace(arguments, overrides=[*arguments.overrides, *words])
        status = status or _drive(own, vehicles[name], drives[name], duration_s, link)
    if output := arguments.path("output"):
        from runner.verbs.report import report

        bases = [base / "cameras" for base in conf_directories(arguments.conf)]
        page = report([drive for drive in drives.values() if drive], output, arguments.path("models"), bases)
        say(f"report: {page}")
    return status


def _with_rate(arguments: Arguments) -> Arguments:
    """With a frame rate that this machine carries, where neither the user nor an experiment names one."""
    if composed(arguments.overrides, arguments.conf).document.get("fps_max") is not None:
        return arguments
    if any(word.lstrip("+~").startswith("fps_max") for word in arguments.overrides):
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


def _drive(
    arguments: Arguments, vehicle: Vehicle, directory: Path | None, duration_s: float, settings: LinkSettings | None
) -> int:
    """One drive of both sides; returns the operator's exit status."""
    own = [*arguments.overrides, *([f"conf={arguments.conf}"] if arguments.conf else [])]
    own += [f"log={directory}"] if directory else []
    with (
        tempfile.TemporaryFile("w+") as said,
        _link(arguments, vehicle, directory, settings) as (link, log),
        private_broker(link.broker if link else vehicle.control),
        _side("vehicle", [*own, *(link.vehicle_overrides if link else ())], link, said.fileno()) as vehicle_side,
        _side("operator", [*own, *(link.operator_overrides if link else ()), f"duration_s={duration_s}"]) as operator,
    ):
        waiting = link is not None
        try:
            while (status := operator.poll()) is None:
                if waiting and link and directory and (began := _began(directory)):
                    waiting = False
                    log.begin(began)
                    link.start(began)
                time.sleep(LOOK_S)
        finally:
            early = vehicle_side.poll()
            operator.terminate()
            vehicle_side.terminate()
            vehicle_side.wait()
        if early is not None:
            said.seek(0)
            raise RunError(f"the vehicle's side ended early:\n{said.read().strip()}")
    return status


@contextmanager
def _link(
    arguments: Arguments, vehicle: Vehicle, directory: Path | None, settings: LinkSettings | None
) -> Iterator[tuple[LimitedLink | None, Log]]:
    """The limited link between the sides, where there is one, and its log."""
    config = composed(arguments.overrides, arguments.conf).document
    log = Log(directory if settings else None, "link", config, {}, say)
    if settings is None:
        yield None, log
        return
    with limited_link(settings.kind, settings.limit, vehicle.media, vehicle.control, log.write) as link:
        yield link, log
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
