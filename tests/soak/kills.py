"""kill -9 of each process: after a restart everything recovers within 5 s, and a demo leaves no process behind."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from contextlib import suppress
from functools import partial
from pathlib import Path

from signals import MARK, ROBOT, marked_processes
from system import CAMERAS, System, flowing, running

import keyed
from rig import CHECKOUT, free_port, until

BACK_S = 5.0
END_S = 6.0  # in which a demo that has lost a part must end the others, eventually by force
START_S = 3.0  # for a process to start, in addition to BACK_S


def soak(seed: int, scale: float) -> list[str]:
    rng = random.Random(seed)
    return [*_restarted(rng, max(3, round(12 * scale))), *_demos(rng, max(4, round(16 * scale)))]


def _restarted(rng: random.Random, count: int) -> list[str]:
    problems = []
    with running("page.serve=false") as (system, operator):
        for number in range(count):
            name, away_s = ("vehicle", "operator", "broker")[number % 3], rng.uniform(0.2, 4)
            system.processes[name].kill()
            system.processes[name].wait()
            time.sleep(away_s)
            frames, telemetry = _received(system), len(operator.telemetry)
            system.start(name)
            began = time.monotonic()
            limit = BACK_S + (START_S if name != "broker" else 0)

            def is_back(
                before: dict[str, int] = frames, telemetry: int = telemetry, new: bool = name == "operator"
            ) -> bool:
                now = _received(system)
                rising = set(now) == set(CAMERAS) and all(now[c] > (0 if new else before[c]) for c in CAMERAS)
                return rising and len(operator.telemetry) > telemetry and flowing(operator)

            try:
                until(is_back, seconds=30, every_s=0.05)
            except AssertionError:
                problems.append(f"{name} killed: not back within 30 s")
                continue
            back_s = time.monotonic() - began
            print(f"{number:3} {name} killed, away {away_s:.1f} s, all back {back_s:.1f} s after its start", flush=True)
            if back_s > limit:
                problems.append(f"{name} killed: back after {back_s:.1f} s, limit {limit:g} s")
    return problems


def _received(system: System) -> dict[str, int]:
    """Frames that the operator's side has received of each camera; empty before its first sample."""
    try:
        return {name: camera["frames"] for name, camera in system.samples().items()}
    except (OSError, StopIteration):
        return {}


def _demos(rng: random.Random, count: int) -> list[str]:
    problems = []
    for number in range(count):
        relay = rng.random() < 0.5
        # A relay cannot forward encrypted streams.
        link, process = ("netns", "tunnel") if keyed.keys() else ("relay", "relay")
        victim = ("demo", "vehicle", "operator", "mosquitto", process if relay else "vehicle")[number % 5]
        mark = uuid.uuid4().hex
        with tempfile.TemporaryDirectory() as directory, tempfile.TemporaryFile("w+") as output:
            words = [f"media.port={free_port()}", f"control.port={free_port()}", "duration_s=60"]
            words += keyed.words()
            words += [f"link={link}", f"log={Path(directory) / 'drive'}"] if relay else []
            demo = subprocess.Popen(
                [sys.executable, "-m", "runner", "demo", *ROBOT, *words],
                stdout=output,
                stderr=output,
                start_new_session=True,
                cwd=CHECKOUT,
                env={**os.environ, "PYTHONPATH": str(CHECKOUT), MARK: mark},
            )
            at_s = rng.uniform(2, 5)
            time.sleep(at_s)
            pid = demo.pid if victim == "demo" else until(partial(_part, mark, demo.pid, victim), 10 * START_S)
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
            began = time.monotonic()
            while (left := _left(mark, demo)) and time.monotonic() - began < END_S:
                time.sleep(0.05)
            ended_s = time.monotonic() - began
            with suppress(subprocess.TimeoutExpired):  # its parts may end shortly before it
                demo.wait(1)
            status = demo.poll()
            name = f"demo over {link}" if relay else "demo"
            print(f"{number:3} {name}: {victim} killed at {at_s:.1f} s, all ended in {ended_s:.1f} s, status {status}")
            for pid in left:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            demo.wait()
            output.seek(0)
            text = output.read()
        if left:
            problems.append(f"{victim} killed: left {'; '.join(left.values())}")
        elif victim != "demo" and status in (0, None):
            problems.append(f"{victim} killed: status {status}")
        if "Traceback" in text:
            problems.append(f"{victim} killed: traceback {text[-500:]}")
    return problems


def _part(mark: str, demo: int, wanted: str) -> int | None:
    """Process id of a part of a demo."""
    signs = (f"-m runner {wanted} ", f"/{wanted} ", f"runner.link.{wanted} ")
    return next(
        (p for p, words in marked_processes(mark).items() if p != demo and any(s in f"{words} " for s in signs)), None
    )


def _left(mark: str, demo: subprocess.Popen[bytes]) -> dict[int, str]:
    demo.poll()  # otherwise it would remain a zombie
    return marked_processes(mark)
