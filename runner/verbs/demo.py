"""usage: tod-runner demo [OVERRIDE ...] [duration_s=60] [log=DIR]

Both sides on this machine: vehicle and operator as two processes over real RTSP and a real control link, along a drive
through a bandwidth map in mode A. Open the page that it names, http://127.0.0.1:8090/, in a browser; the table in the
terminal shows the same. Every camera runs at 5 Hz for each core, which carries eight full HD cameras, both sides and a
browser without a GPU; give fps_max=40, or null for the cameras' own rates.

  tod-runner demo                                             synthetic drive, a minute
  tod-runner demo duration_s=3600                             an hour
  tod-runner demo vehicle=delivery_robot duration_s=20
  tod-runner demo source=file source.clip=clip.mp4            every camera shows your clip
  tod-runner demo pqos.file=tum_bandwidth_map.yaml            along another map
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from runner.broker import private_broker
from runner.config import load_run
from runner.drive.log import check_free
from runner.errors import RunError
from runner.sources import render_missing
from runner.verbs import Arguments
from runner.verbs.screen import progress_bar, streaming

DURATION_S = "60"
FPS_PER_CORE = 5  # Hz; what is encoded, sent, decoded and shown eight times without falling behind


def run(arguments: Arguments) -> int:
    apply = streaming()
    duration = arguments.values.get("duration_s", DURATION_S)
    arguments.number("duration_s")
    fps_max = f"fps_max={FPS_PER_CORE * len(os.sched_getaffinity(0))}"
    arguments = replace(arguments, overrides=[fps_max, *arguments.overrides])
    vehicle, _, _ = load_run(arguments.overrides, arguments.conf, check=apply.check_plan)
    with progress_bar() as progress:
        render_missing(vehicle, progress)
    own = [*arguments.overrides, *([f"conf={arguments.conf}"] if arguments.conf else [])]
    log = [f"log={arguments.values['log']}"] if "log" in arguments.values else []
    if directory := arguments.path("log"):
        for side in ("vehicle", "operator"):
            check_free(directory, side)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: no side is left behind
    with tempfile.TemporaryFile("w+") as said, private_broker(vehicle.control):
        with (
            _side("vehicle", [*own, *log], said.fileno()) as vehicle_side,
            _side("operator", [*own, *log, f"duration_s={duration}"]) as operator_side,
        ):
            try:
                status = operator_side.wait()
            finally:
                early = vehicle_side.poll()
                operator_side.terminate()
                vehicle_side.terminate()
        if early is not None:
            said.seek(0)
            raise RunError(f"the vehicle's side ended early:\n{said.read().strip()}")
    return status


def _side(verb: str, words: Sequence[str], stderr: int | None = None) -> subprocess.Popen[bytes]:
    """One side in a process of its own, with the same Python."""
    command = [sys.executable, "-m", "runner", verb, *words]
    root = str(Path(__file__).resolve().parents[2])
    paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
    return subprocess.Popen(command, stderr=stderr, env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)})
