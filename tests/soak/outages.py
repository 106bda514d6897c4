"""Faults during a drive with keys: a table of how long each path is interrupted, and of frames missed.

The link is cut, clocks are set, certificates expire, keys are replaced and the broker restarts, while predictions
change every second. Video and control recover soon after the end of the fault; the applied bitrates follow the newest
prediction; latencies are right to within their bound, or unknown; no process is left.
"""

from __future__ import annotations

import json
import random
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime, timedelta
from math import inf
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from signals import MARK, marked_processes
from system import CAMERAS, System, ended, newest, running

import keyed
from rig import Operator, clock_ahead, free_port, set_clock, until
from runner.link import limited_link
from runner.link.limit import Limit, OneWay
from runner.security.authority import VALID, Authority
from runner.settings import Endpoint

BACK_S, LONG_BACK_S, LONG_S = 3.0, 5.0, 20.0  # limits after the end of a fault, and of one at least LONG_S long
MISSED = 3  # most frames missed by a camera that a fault should not affect
STALE_S = 1.5  # control.expires_s and the round trip
FPS = 15
QUIET_S = 4.0  # before and after a fault, to count frames
WAIT_S = 20.0
SETTINGS = 10
STEP_S = 5.0  # by which clocks are set, forwards and backwards
QUICKEST_MS, SLOWEST_MS = 1.0, 1000.0  # possible latencies here, on a busy machine
PREDICTED = tuple(range(3000, 1500, -100))  # kbit/s, each for a second, repeated
EXPIRE_S = 12.0  # lifetime of the certificates that expire: on a slow machine new ones take seconds to be in use


class Fault(NamedTuple):
    """A fault while driving; `cause` returns when it ends.

    cuts  whether it interrupts video
    """

    name: str
    cause: Callable[[], None]
    lasts_s: float = 0.0
    cuts: bool = False


class Row(NamedTuple):
    """Effects of a fault: s until each path recovered, None if it did not; frames missed, by camera."""

    fault: Fault
    back: dict[str, float | None]
    missed: dict[str, float]
    problems: list[str]

    def __str__(self) -> str:
        back = "".join(f"{'-' if s is None else f'{s:.2f} s':>10}" for s in self.back.values())
        row = f"{self.fault.name:40}{back}" + "".join(f"{frames:10.1f}" for frames in self.missed.values())
        return "\n  ".join((row, *self.problems))


class Paths(threading.Thread):
    """Counts the cameras' frames and sends requests, several times a second.

    frames    by camera: (time, number so far)
    answered  of requests that were applied: (sent, answered)
    """

    def __init__(self, system: System, operator: Operator) -> None:
        super().__init__(daemon=True)
        self._system, self._operator = system, operator
        self.frames: dict[str, list[tuple[float, int]]] = {name: [] for name in CAMERAS}
        self._sent: dict[str, float] = {}
        self.answered: list[tuple[float, float]] = []
        self._stopped = threading.Event()

    def run(self) -> None:
        while not self._stopped.wait(0.05):
            now = time.monotonic()
            for name, camera in self._system.samples().items():
                seen = self.frames[name]
                if not seen or camera["frames"] != seen[-1][1]:
                    seen.append((now, camera["frames"]))
            identity = f"paths{now}"
            self._sent[identity] = now
            self._operator.send(identity, event="weights_set", weights={"rear": 1})
            for name in self._sent.keys() & self._operator.replies.keys():
                sent = self._sent.pop(name)
                if self._operator.replies.pop(name)["result"] == "applied":
                    self.answered.append((sent, now))

    def stop(self) -> None:
        self._stopped.set()
        self.join(5)

    def back(self, since: float) -> dict[str, float | None]:
        """s from a time until each path worked: frames arrived, and a request sent since then was applied."""
        control = next((answered - since for sent, answered in self.answered if sent >= since), None)
        return {"control": control, **{name: self._video(name, since) for name in CAMERAS}}

    def _video(self, name: str, since: float) -> float | None:
        # The first sample after the end may count earlier frames.
        after = [at for at, _ in self.frames[name] if at > since]
        return after[1] - since if len(after) > 1 else None

    def missed(self, name: str, begin: float, end: float) -> float:
        """Frames missing between two times, extrapolated from those before and after; inf if there are none."""
        frames = list(self.frames[name])
        before = [number - FPS * at for at, number in frames if begin - QUIET_S < at < begin]
        after = [number - FPS * at for at, number in frames if end < at < end + QUIET_S]
        return median(before) - median(after) if before and after else inf


def soak(seed: int, scale: float) -> list[str]:
    """Each fault once, at a scale of 1 three times."""
    problems: list[str] = []
    rounds = max(1, round(3 * scale))
    mark = uuid.uuid4().hex
    with tempfile.TemporaryDirectory(prefix="tod-soak-outages-") as directory, ExitStack() as stack:
        drive = stack.enter_context(_drive(Path(directory), mark, random.Random(seed)))
        print(f"{'fault':40}" + "".join(f"{name:>10}" for name in ("control", *CAMERAS, *CAMERAS)))
        for _ in range(rounds):
            for fault in drive.faults():
                row = drive.inject(fault)
                print(row, flush=True)
                problems += row.problems
        problems += drive.system.tracebacks()
        problems += _ends(drive.system, mark)
    return problems


def _ends(system: System, mark: str) -> list[str]:
    """Both sides end promptly on SIGTERM, and leave no process."""
    for name in ("operator", "vehicle", "broker"):
        system.processes[name].terminate()
        if not ended(system.processes[name], 5):
            return [f"{name} did not end"]
    left = marked_processes(mark)
    return [f"left: {'; '.join(left.values())}"] if left else []


class _Drive:
    """A drive with keys over a link that can be cut."""

    def __init__(
        self,
        rng: random.Random,
        system: System,
        operator: Operator,
        paths: Paths,
        passing: list[bool],
        clocks: dict[str, Path],
    ) -> None:
        self._rng, self.system, self._operator, self._paths = rng, system, operator, paths
        self._passing, self._clocks, self._requested_at = passing, clocks, 0.0

    def faults(self) -> Iterator[Fault]:
        for cut_s in (0.2, 2.0, LONG_S):
            yield Fault(f"link cut for {cut_s:g} s", lambda s=cut_s: self._cut(s), cut_s, cuts=True)  # type: ignore[misc]
        for side in self._clocks:
            for ahead_s in (STEP_S, 0.0):
                what = f"{side}'s clock set {'forwards' if ahead_s else 'back'} by {STEP_S:g} s"
                yield Fault(what, lambda s=side, a=ahead_s: set_clock(self._clocks[s], a))  # type: ignore[misc]
            yield Fault(f"{side}'s clock set {SETTINGS} times", lambda s=side: self._set_often(s))  # type: ignore[misc]
        yield Fault("broker restarted", self._restart_broker)
        yield Fault("all keys replaced, broker restarted", self._replace_keys, cuts=True)
        self._replace_keys(timedelta(seconds=EXPIRE_S))
        ends = time.monotonic() + EXPIRE_S
        until(lambda: all(self._paths.back(ends - EXPIRE_S).values()), WAIT_S)
        time.sleep(max(0.0, ends - QUIET_S / 2 - time.monotonic()))
        yield Fault("all certificates expire", lambda: time.sleep(max(0.0, ends - time.monotonic())))
        yield Fault("expired keys replaced", self._replace_keys, cuts=True)

    def inject(self, fault: Fault) -> Row:
        time.sleep(QUIET_S)
        begin, at = time.monotonic(), self.system.operator_log.stat().st_size
        stale = f"stale{begin}"
        if fault.cuts:
            threading.Timer(fault.lasts_s / 10, self._request_late, (stale,)).start()
        fault.cause()
        end = time.monotonic()
        limit_s = LONG_BACK_S if fault.lasts_s >= LONG_S else BACK_S
        deadline = end + WAIT_S
        while None in self._paths.back(end).values() and time.monotonic() < deadline:
            time.sleep(0.05)
        back = self._paths.back(end)
        problems = [f"{path} is not back within {WAIT_S:g} s" for path, s in back.items() if s is None]
        late = {path: s for path, s in back.items() if s and s > limit_s}
        problems += [f"{path} is back after {s:.2f} s, limit {limit_s:g} s" for path, s in late.items()]
        if not problems:
            problems += self._stale()
        time.sleep(QUIET_S + 1)
        all_back = end + max(s or 0.0 for s in back.values())
        missed = {name: self._paths.missed(name, begin, all_back) for name in CAMERAS}
        if not fault.cuts:
            problems += [f"{name} missed {n:.1f} frames, limit {MISSED}" for name, n in missed.items() if n > MISSED]
        problems += self._applied_late(stale)
        problems += self._wrong_latencies(at, SLOWEST_MS + 1000 * fault.lasts_s)
        return Row(fault, back, missed, [f"{fault.name}: {problem}" for problem in problems])

    def _request_late(self, identity: str) -> None:
        """Send a request that is delayed until the end of the fault."""
        self._requested_at = self._operator.as_of()
        self._operator.send(identity, event="weights_set", weights={"rear": 1})

    def _applied_late(self, identity: str) -> list[str]:
        """Whether such a request was applied although it was too old."""
        reply = self._operator.replies.get(identity)
        if reply is None or reply["result"] != "applied" or reply["t"] - self._requested_at < STALE_S:
            return []
        return [f"a request was applied {reply['t'] - self._requested_at:.1f} s after it was made"]

    # --- causes -------------------------------------------------------------------------------------------------------

    def _cut(self, seconds: float) -> None:
        self._passing.append(False)
        time.sleep(seconds)
        self._passing.append(True)

    def _set_often(self, side: str) -> None:
        """At random moments: latencies must be right whatever happens between two comparisons of the clocks."""
        for _ in range(SETTINGS):
            time.sleep(self._rng.uniform(0.3, 1.2))
            set_clock(self._clocks[side], self._rng.choice((-STEP_S, 0.0, STEP_S)))
        set_clock(self._clocks[side], 0.0)

    def _restart_broker(self) -> None:
        self.system.processes["broker"].kill()
        self.system.processes["broker"].wait()
        self.system.start("broker")

    def _replace_keys(self, term: timedelta = VALID) -> None:
        """Replace everybody's keys, one after the other, and restart the broker with its own."""
        assert self.system.keys
        authority = Authority(self.system.keys, lambda: datetime.now(UTC) - VALID + term)
        with authority.opened():
            for name in ("broker", keyed.VEHICLE, keyed.CONTROLLER):
                authority.rotate(name)
        self._restart_broker()

    # --- what must be right afterwards --------------------------------------------------------------------------------

    def _stale(self) -> list[str]:
        """Whether the applied bitrates differ from the newest decision, or that from the newest prediction."""
        try:
            until(lambda: self._is_current(newest(self._operator), self._operator.telemetry[-1]), 2.0)
        except AssertionError:
            state, telemetry = newest(self._operator), self._operator.telemetry[-1]
            rates = {name: (camera["kbps"], camera["applied"]) for name, camera in state["cameras"].items()}
            predicted = f"at {telemetry['t']} s predicted {telemetry['predicted_kbps']}"
            return [f"stale: {predicted}, decided and applied {rates}"]
        return []

    @staticmethod
    def _is_current(state: Any, telemetry: Any) -> bool:
        second = int(telemetry["t"])
        predicted = {PREDICTED[at % len(PREDICTED)] for at in (second - 1, second)}
        cameras = state.get("cameras", {}).values()  # none while it is offline
        return (
            state["online"]
            and telemetry["predicted_kbps"] in predicted
            and all(camera["sending"] and camera["applied"].get("bitrate") == camera["kbps"] for camera in cameras)
        )

    def _wrong_latencies(self, since: int, slowest_ms: float) -> list[str]:
        """Impossible latencies in the operator's log since an offset."""
        with self.system.operator_log.open("rb") as file:
            file.seek(since)
            lines = [json.loads(line) for line in file.read().split(b"\n")[1:-1]]
        samples = [line for line in lines if line.get("log") == "sample"]
        wrong = [
            f"{name} {camera['latency_ms']:.1f} ± {sample['clock_bound_ms']} ms"
            for sample in samples
            for name, camera in sample["cameras"].items()
            if camera["latency_ms"] is not None
            and not is_possible(camera["latency_ms"], sample["clock_bound_ms"], slowest_ms)
        ]
        return [f"{len(wrong)} latencies are wrong, such as {wrong[0]}"] if wrong else []


def is_possible(latency_ms: float, bound_ms: float | None, slowest_ms: float) -> bool:
    """Whether a picture can have had a latency stated with this bound."""
    return bound_ms is not None and latency_ms + bound_ms >= QUICKEST_MS and latency_ms - bound_ms <= slowest_ms


@contextmanager
def _drive(directory: Path, mark: str, rng: random.Random) -> Iterator[_Drive]:
    passing = [True]

    def kbps(t: float) -> float:
        return 20_000 if passing[-1] else 0

    wide = Limit(kbps, queue_ms=200, delay_ms=10, reverse=OneWay(kbps, queue_ms=200, delay_ms=10))
    trace = directory / "predicted.csv"
    trace.write_text("t_s,kbps\n" + "".join(f"{t},{kbps}\n" for t, kbps in enumerate(PREDICTED)))
    clocks = {side: directory / side for side in ("vehicle", "operator")}
    environment = {side: {**clock_ahead(path, 0.0, side), MARK: mark} for side, path in clocks.items()}
    environment["broker"] = {MARK: mark}
    media, control = (Endpoint("127.0.0.1", free_port()) for _ in range(2))
    predictions = ("pqos=trace", f"pqos.file={trace}")
    with limited_link("netns", wide, media, control, lambda line: None) as link:
        link.start(time.time())
        keys = keyed.issue(directory / "keys")
        given = {"keys": keys, "link": link, "environment": environment, "predictions": predictions}
        with running("page.serve=false", **given) as (system, operator):
            paths = Paths(system, operator)
            paths.start()
            try:
                yield _Drive(rng, system, operator, paths, passing, clocks)
            finally:
                paths.stop()
