"""Random sequences of reception reports and other events, through all rules of modes=safe.

Whatever is reported, the total never exceeds what the operator allows or the cameras can use, what the cameras send
never exceeds the total, and the total returns to at least the prediction once all is well.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from functools import cache
from typing import Any

from soak import batches

from runner.configuration.config import configuration
from runner.core import events
from runner.core.budget import on_the_wire
from runner.core.events import LinkMeasured
from runner.core.evidence import REPORT_S, EvidenceMemory, LinkReport, ReceivedUnit, observe, rounded, summarise
from runner.core.model import Mode, Vehicle, exact
from runner.core.step import Run, start, step
from runner.schema import event_problem

SEQUENCES, BATCH = 200_000, 500
RECOVERED = 100  # one sequence in this many is followed until all is well again
RECOVERY_S, PREDICTED = 60.0, 3000
SLOWER_S = 0.1  # between two reports then
PLACES = tuple((48 + north / 2000, 11.5) for north in range(4))  # 56 m apart
START_KBPS = 3000  # of modes/safe.yaml


@cache
def vehicle() -> Vehicle:
    return configuration(["vehicle=delivery_robot", "modes=safe", "pqos=live"], runnable=False).vehicle()


def soak(seed: int, scale: float) -> list[str]:
    return batches.problems(sequence, "sequences of reports", seed, SEQUENCES, scale, BATCH)


def sequence(seed: int) -> str:
    """One random sequence; returns the problem, "" if there is none."""
    rng = random.Random(seed)
    drive = Drive(rng.uniform(-1e6, 1e6))
    for _ in range(rng.randrange(1, 40)):
        drive.pass_time(rng.choice((REPORT_S, REPORT_S, rng.expovariate(5), 0.0)))
        if rng.random() < 0.7:
            drive.report(_report(rng, drive.at))
        else:
            drive.take(**_event(rng))
        if drive.problem:
            return f"{drive.problem} at t={drive.run.state.t}"
    return _recovers(drive) if seed % RECOVERED == 0 else ""


class Drive:
    """A run of the rules, fed with an operator's reports.

    at       the operator's clock, s
    problem  the first one found
    """

    def __init__(self, at: float) -> None:
        self.run, self.at, self.problem = start(vehicle()), at, ""
        self._t, self._uplink = 0.0, EvidenceMemory()

    def pass_time(self, seconds: float) -> None:
        self._t, self.at = self._t + seconds, self.at + seconds

    def take(self, event: str, **values: Any) -> None:
        """One event; a new operator has a clock of its own."""
        if event == "control_passed":
            self._uplink = EvidenceMemory()
        self._step(events.parse({"t": self._t, "event": event, **values}))

    def report(self, report: LinkReport) -> None:
        self._uplink, evidence = observe(self._uplink, report)
        if evidence is None:
            return
        of = summarise(self._uplink, evidence)
        measured = LinkMeasured(
            t=self._t,
            kbps=exact(round(of.kbps, 1)),
            queue_ms=1000 * of.queue_s,
            loss=of.loss,
            state=of.state,
            rtt_ms=30.0,
            evidence=rounded(evidence),
        )
        self.problem = self.problem or event_problem(events.to_json(measured)) or ""
        self._step(measured)

    def _step(self, event: events.Event) -> None:
        self.run = step(vehicle(), self.run, event)
        self.problem = self.problem or next(_problems(self.run), "")


def _problems(run: Run) -> Iterator[str]:
    """What must never be decided."""
    if run.fault:
        yield run.fault
    total, copies, settings = run.decision.total, run.state.copies, run.decision.settings
    sent = sum(setting.kbps * copies.get(name, 1) for name, setting in settings.items())
    allowed = _allowed(run)
    if not 0 <= total <= allowed:
        yield f"total {float(total)} where {float(allowed)} are allowed"
    if sent > total:
        yield f"{sent} kbit/s are sent of {float(total)}"


def _allowed(run: Run) -> Any:
    """The largest total, kbit/s: of the operator, or the largest of what is predicted and what the cameras can use."""
    state = run.state
    copies = {name: state.copies.get(name, 1) for name in vehicle().cameras}
    if state.mode is Mode.SINGLE:
        return sum(state.manual[name].kbps * copies[name] for name, on in state.on.items() if on)
    if state.mode is Mode.COLLECTIVE:
        return START_KBPS if state.collective_total is None else state.collective_total
    given = START_KBPS if state.prediction is None else state.prediction.kbps
    return max(given, sum(camera.rate_quality.b_full * copies[name] for name, camera in vehicle().cameras.items()))


def _recovers(drive: Drive) -> str:
    """The problem if the total does not return to the prediction on a link that carries everything, "" if it does."""
    for event in (
        {"event": "operator_connected"},
        {"event": "mode_selected", "mode": "automatic"},
        {"event": "copies_counted", "copies": {}},
        *({"event": "camera_switched", "camera": name, "on": True} for name in vehicle().cameras),
    ):
        drive.take(**event)
    for number in range(round(RECOVERY_S / SLOWER_S)):
        drive.pass_time(SLOWER_S)
        if number % 10 == 0:
            drive.take("bitrate_predicted", kbps=PREDICTED)
        sizes = {name: setting.kbps for name, setting in drive.run.decision.settings.items() if setting.kbps}
        units = [
            ReceivedUnit(name, drive.at - 0.03, drive.at - 0.01, _on_the_wire(name, round(size * SLOWER_S * 125)))
            for name, size in sizes.items()
        ]
        drive.report(LinkReport(drive.at, tuple(units), 9, 0))
        if drive.problem or (number and drive.run.decision.total >= 0.9 * PREDICTED):
            return drive.problem
    return f"after {RECOVERY_S:g} s the total is {float(drive.run.decision.total)}: {drive.run.memory}"


def _on_the_wire(name: str, size: int) -> int:
    return on_the_wire(vehicle().cameras[name].graph, size)


def _event(rng: random.Random) -> dict[str, Any]:
    lat, lon = rng.choice(PLACES)
    name = rng.choice(tuple(vehicle().cameras))
    return rng.choice(
        (
            {"event": "clock_advanced"},
            {"event": "bitrate_predicted", "kbps": rng.choice((0, 2, 300, 3000, rng.uniform(0, 20_000)))},
            {"event": "position_reported", "lat": lat, "lon": lon},
            {"event": "operator_connected"},
            {"event": "operator_disconnected"},
            {"event": "control_passed", "operator": "another"},
            {"event": "copies_counted", "copies": {name: rng.randrange(1, 4)}},
            {"event": "camera_switched", "camera": name, "on": rng.random() < 0.7},
            {"event": "mode_selected", "mode": rng.choice(("single", "automatic", "automatic", "collective"))},
            {"event": "total_set", "kbps": rng.choice((0, 100, 3000, 12_000))},
        )
    )


def _report(rng: random.Random, at: float) -> LinkReport:
    cameras = tuple(vehicle().cameras)
    units = sorted(
        (at - rng.expovariate(20), rng.choice(cameras), rng.uniform(-10, 10) ** rng.choice((1, 3)))
        for _ in range(rng.choice((0, 1, 3, 8)))
    )
    return LinkReport(
        at,
        tuple(
            ReceivedUnit(name, arrived - delay, arrived, rng.randrange(10**5), rng.random() < 0.8)
            for arrived, name, delay in units
        ),
        rng.randrange(100),
        rng.choice((0, 0, 1, 100)),
    )
