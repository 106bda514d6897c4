"""Signals to long-running verbs, at random moments, once or twice: each run and all its processes end in time.

    PYTHONPATH=tests/integration .venv/bin/python tests/soak/signals.py SEED COUNT [VERB ...]

The signal goes to the whole process group, as Ctrl-C in a terminal sends it. A run fails if it or any process it
started is alive after `LIMIT_S`, if a traceback is printed, or if the exit status is not one that a signal gives.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import keyed
from rig import CHECKOUT, free_port
from runner.mqtt.broker import private_broker
from runner.settings import Endpoint

LIMIT_S = 3.0  # from the first signal to the end of the last process
MARK = "TOD_SOAK_RUN"  # environment variable that marks the processes of one run
ROBOT = ("vehicle=delivery_robot", "source=test", "fps_max=5", "page.serve=false", "pqos=constant", "pqos.kbps=2000")
STATUSES = {0, 130, 143}
STATUSES_BY_VERB = {  # further valid statuses
    "record": {1},  # a camera had no frame yet
    # By the signal's default action, when the work is done and Python exits: no partial files remain.
    **{verb: {-signal.SIGINT, -signal.SIGTERM} for verb in ("report", "export", "replay")},
}


class Verb(NamedTuple):
    """words: the command line, given a free directory; span_s: signals are sent 0 to this many s after the start."""

    words: Callable[[Path], Sequence[str]]
    span_s: float


@dataclass(frozen=True)
class Run:
    """One run and its outcome. ended_s: None if it did not end in time; left: command lines of leftover processes."""

    number: int
    verb: str
    signals: tuple[str, ...]
    at_s: float
    gap_s: float
    ended_s: float | None
    status: int | None
    left: tuple[str, ...]
    output: str

    @property
    def problem(self) -> str:
        if self.ended_s is None:
            return f"not ended within {LIMIT_S:g} s: {'; '.join(self.left)}"
        if "Traceback" in self.output:
            return f"traceback: {self.output.strip()[-2000:]}"
        # Before Python has started, the default action of a signal ends the process.
        killed = self.status is not None and self.status < 0 and self.at_s < 0.5
        right = self.status in STATUSES | STATUSES_BY_VERB.get(self.verb, set())
        return "" if right or killed else f"status {self.status}: {self.output.strip()[-200:]}"

    def __str__(self) -> str:
        ended = "-" if self.ended_s is None else f"{self.ended_s:.2f} s"
        sent = f"{'+'.join(self.signals)} at {self.at_s:.2f} s" + (f" +{self.gap_s:.2f}" if self.gap_s else "")
        return f"{self.number:3} {self.verb:11} {sent:32} ended {ended:7} status {self.status}  {self.problem or 'ok'}"


def _demo(directory: Path, *more: str) -> Sequence[str]:
    return (
        "demo",
        *ROBOT,
        f"media.port={free_port()}",
        f"control.port={free_port()}",
        "duration_s=60",
        *keyed.words(),
        *more,
    )


def _side(verb: str, broker: Endpoint, *more: str) -> Sequence[str]:
    own = keyed.words(keyed.VEHICLE if verb == "vehicle" else keyed.CONTROLLER)
    return (verb, *ROBOT, f"media.port={free_port()}", f"control.port={broker.port}", *own, *more)


@contextmanager
def verbs() -> Iterator[dict[str, Verb]]:
    """Every long-running verb, with its inputs."""
    with tempfile.TemporaryDirectory() as name:
        directory, broker = Path(name), Endpoint("127.0.0.1", free_port())
        drive = directory / "drive"
        done = subprocess.run(
            _command(*_demo(directory), "duration_s=4", f"log={drive}"), capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        keys = keyed.keys()
        link = "netns" if keys else "relay"  # a relay cannot forward encrypted streams
        with private_broker(broker, keys and keys / "broker"):
            yield {
                "demo": Verb(_demo, 5.0),
                f"demo {link}": Verb(lambda free: _demo(free, f"link={link}", f"log={free / 'drive'}"), 5.0),
                "vehicle": Verb(lambda free: _side("vehicle", broker, f"log={free / 'drive'}"), 3.0),
                "operator": Verb(lambda free: _side("operator", broker, f"log={free / 'drive'}"), 3.0),
                "record": Verb(lambda free: ("record", *ROBOT[:3], f"output={free / 'rec'}"), 3.0),
                "report": Verb(lambda free: ("report", str(drive), f"output={free / 'report'}"), 4.0),
                "export": Verb(lambda free: ("export", str(drive), f"output={free / 'drive.mcap'}"), 0.6),
                "replay": Verb(lambda free: ("replay", *ROBOT), 1.0),
            }


def _print(run: Run) -> None:
    print(run, flush=True)


def soak(seed: int, count: int, chosen: Sequence[str] = (), report: Callable[[Run], None] = _print) -> list[Run]:
    """Run verbs in turn and interrupt each.

    returns  the runs that failed
    """
    rng, failed = random.Random(seed), []
    with verbs() as known:
        names = list(chosen or known)
        for number in range(count):
            run = _run(number, names[number % len(names)], known[names[number % len(names)]], rng)
            report(run)
            failed += [run] if run.problem else []
    return failed


def _run(number: int, name: str, verb: Verb, rng: random.Random) -> Run:
    kinds = [rng.choice((signal.SIGINT, signal.SIGTERM)) for _ in range(rng.choice((1, 2)))]
    at_s, gap_s = rng.uniform(0.05, verb.span_s), rng.choice((0.0, 0.001, 0.02, 0.2, 0.6))
    mark = uuid.uuid4().hex
    with tempfile.TemporaryDirectory() as free, tempfile.TemporaryFile("w+") as output:
        child = subprocess.Popen(
            _command(*verb.words(Path(free))),
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=output,
            start_new_session=True,
            cwd=CHECKOUT,
            env={**os.environ, "PYTHONPATH": str(CHECKOUT), MARK: mark},
        )
        time.sleep(at_s)
        began = time.monotonic()
        for kind in kinds:
            with suppress(ProcessLookupError):
                os.killpg(child.pid, kind)
            time.sleep(gap_s if len(kinds) > 1 else 0)
        left = _wait(child, mark, began + LIMIT_S)
        ended_s = None if left else time.monotonic() - began
        for pid in left:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        assert child.stdin
        child.stdin.close()
        status = child.wait(10)
        output.seek(0)
        sent = tuple(kind.name for kind in kinds)
        return Run(number, name, sent, at_s, gap_s, ended_s, status, tuple(left.values()), output.read())


def _wait(child: subprocess.Popen[bytes], mark: str, until: float) -> dict[int, str]:
    """Wait until every process of a run has ended; returns those that have not ended in time, by process id."""
    while True:
        child.poll()  # otherwise it would remain a zombie
        left = marked_processes(mark)
        if not left or time.monotonic() > until:
            return left
        time.sleep(0.02)


def marked_processes(mark: str) -> dict[int, str]:
    """Command lines of the processes that run with a mark in their environment, by process id."""
    wanted, found = f"{MARK}={mark}".encode(), {}
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended, or is another user's
            if wanted in (process / "environ").read_bytes():
                words = (process / "cmdline").read_bytes().decode(errors="replace").split("\0")
                found[int(process.name)] = " ".join(words)[:120]
    return found


def _command(*words: str) -> list[str]:
    return [sys.executable, "-m", "runner", *words]


if __name__ == "__main__":
    problems = soak(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:])
    sys.exit(f"{len(problems)} of {sys.argv[2]} runs failed" if problems else 0)
