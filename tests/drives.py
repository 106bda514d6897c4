"""Drives as the two sides would log them: the real core decides, noise simulates encoder and network."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from runner.configuration.config import configuration
from runner.core.events import ClockAdvanced, Event, PositionReported, to_json
from runner.core.model import plain
from runner.core.step import Run, start, step
from runner.drive.log import FILES, FORMAT
from runner.records.decisions import DecisionMade
from runner.records.lines import LinkSample, line_to_json
from runner.records.operator import CameraSample, LatencyStages, Sample
from runner.records.vehicle import CameraReading, CameraState, CameraTelemetry, Position, Telemetry, VehicleState

EPOCH = 1_770_000_000.0  # 2026-02-02T02:40:00Z
OPERATOR_LATER_S = 1.5  # the operator starts logging later than the vehicle
TICK_S, TELEMETRY_S, SAMPLE_S, LINK_S = 0.1, 0.2, 0.25, 0.1
FOLLOWS_S = 0.4  # time constant of the encoder's rate control
VERSIONS = {"tod-runner": "0.1.0", "Python": "3.11.2", "GStreamer": "1.22.0"}
Lines = list[dict[str, Any]]


def write_drive(
    directory: Path,
    sides: Iterable[str] = FILES,
    *,
    seconds: float = 100.0,
    seed: int = 1,
    overrides: Sequence[str] = (),
    events: Sequence[Event] = (),
    freezes: Mapping[str, Sequence[tuple[float, float]]] | None = None,
    congested: float = 0.0,
    change: Callable[[str, Lines], Lines] = lambda _side, lines: lines,
    ended: bool = True,
) -> Path:
    """Write a drive.

    seconds    length
    overrides  of the configuration; by default the paper's vehicle on the demo's map
    events     of the operator, with their times
    freezes    by camera, (start s, length s) without arrivals
    congested  how much latency and loss the network adds where the predicted bitrate is low; 0: none
    change     transforms each side's lines after the first
    """
    config, lines = _drive(tuple(overrides), seconds, seed, tuple(events), congested, _frozen(freezes))
    directory.mkdir(parents=True, exist_ok=True)
    for side in sides:
        shift = OPERATOR_LATER_S if side == "operator" else 0.0
        began = {"t": 0.0, "log": "began", "side": side, "format": FORMAT, "time": EPOCH + shift}
        began |= {"versions": VERSIONS, "config": config}
        logged = [began, *change(side, json.loads(json.dumps(lines[side])))]
        if ended:
            logged.append({"t": round(seconds - shift, 6), "log": "ended"})
        text = "".join(json.dumps(line, ensure_ascii=False) + "\n" for line in logged)
        (directory / FILES[side]).write_text(text, encoding="utf-8")
    return directory


def _frozen(freezes: Mapping[str, Sequence[tuple[float, float]]] | None) -> tuple[tuple[str, float, float], ...]:
    return tuple((name, t, t + seconds) for name, each in (freezes or {}).items() for t, seconds in each)


@cache
def _drive(
    overrides: tuple[str, ...],
    seconds: float,
    seed: int,
    events: tuple[Event, ...],
    congested: float,
    frozen: tuple[tuple[str, float, float], ...],
) -> tuple[dict[str, Any], dict[str, Lines]]:
    config = configuration(["source=test", *overrides])
    made = _Made(np.random.default_rng(seed), config.vehicle(), *config.pqos(), seconds, congested, frozen)
    made.drive(sorted(events, key=lambda event: event.t))
    return config.document, {"vehicle": made.vehicle_log, "operator": made.operator_log, "link": made.link_log}


@dataclass
class _Made:
    """A drive being generated."""

    random: np.random.Generator
    vehicle: Any
    pqos: Any
    track: Any
    seconds: float
    congested: float
    frozen: tuple[tuple[str, float, float], ...]
    vehicle_log: Lines = field(default_factory=list)
    operator_log: Lines = field(default_factory=list)
    link_log: Lines = field(default_factory=list)
    now: Run = field(init=False)
    position: PositionReported | None = None
    refused: int = 0

    def __post_init__(self) -> None:
        names = list(self.vehicle.cameras)
        self.now = start(self.vehicle)
        self.rate = dict.fromkeys(names, 0.0)  # kbit/s out of each encoder
        self.count = {
            name: dict.fromkeys(("frames", "bytes", "got", "got_bytes", "lost", "rebuilt"), 0) for name in names
        }
        self.due = dict.fromkeys(names, 0.0)  # when the next frame is captured
        self.arrivals: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
        self.past: list[tuple[float, dict[str, tuple[int, int]]]] = []
        self.dropped = self.passed = self.packets = 0

    def drive(self, events: Sequence[Event]) -> None:
        waiting = list(events)
        for tick in range(round(self.seconds / TICK_S) + 1):
            t = round(tick * TICK_S, 6)
            while waiting and waiting[0].t <= t:
                self._take(replace(waiting.pop(0), t=t), "operator")
            if self.track:
                self.position = replace(self.track.at(t), t=t)
                self._take(self.position, "position_reported")
            self._take(ClockAdvanced(t=t), "clock_advanced")
            self._encode(t)
            self.link_log.append(self._link(t))
            if tick % round(TELEMETRY_S / TICK_S) == 0:
                self.vehicle_log.append(self._telemetry(t))
            if t >= OPERATOR_LATER_S and tick % 5 in (0, 2):  # every 0.2 and 0.3 s
                self.operator_log.append(self._sample(t))

    def _take(self, event: Event, cause: str) -> None:
        self._step(event, cause)
        for prediction in self.pqos.observe(event):
            self._step(prediction, f"bitrate_predicted kbps {plain(prediction.kbps)}")

    def _step(self, event: Event, cause: str) -> None:
        before, self.now = self.now, step(self.vehicle, self.now, event)
        self.refused += bool(self.now.refused)
        self.vehicle_log.append(to_json(event))
        if not self.now.commands and self.now.decision == before.decision:
            return
        decision = self.now.decision
        made = DecisionMade.of(event.t, cause, decision, self.now.commands)
        self.vehicle_log.append(line_to_json(made))
        if event.t >= OPERATOR_LATER_S or not self.operator_log:
            shifted = max(0.0, round(event.t - OPERATOR_LATER_S + 0.02, 6))
            unread = CameraReading()
            cameras = {name: CameraState.at(setting, 1, name, unread) for name, setting in decision.settings.items()}
            state = VehicleState(shifted, cause, decision.mode, made.total_kbps, plain(decision.asked), cameras)
            self.operator_log.append(line_to_json(state))

    def _predicted(self) -> float:
        prediction = self.now.state.prediction
        return float(prediction.kbps) if prediction else 3000.0

    def _encode(self, t: float) -> None:
        """The frames of the last tick and their arrivals."""
        load = self.congested * max(0.0, (5500.0 - self._predicted()) / 2500.0)
        for name, setting in self.now.decision.settings.items():
            count = self.count[name]
            wanted = setting.kbps * 0.97 if setting.sending else 0.0
            self.rate[name] += (wanted - self.rate[name]) * (1 - np.exp(-TICK_S / FOLLOWS_S))
            fps = float(self.vehicle.cameras[name].fps)
            while self.due[name] <= t:
                captured, self.due[name] = self.due[name], self.due[name] + 1 / fps
                if not setting.sending:
                    continue
                size = int(self.rate[name] * 125 / fps * self.random.lognormal(0, 0.25))
                count["frames"], count["bytes"] = count["frames"] + 1, count["bytes"] + size
                self._send(name, captured, size, load)

    def _send(self, name: str, captured: float, size: int, load: float) -> None:
        count = self.count[name]
        lost = self.random.random() < 0.0004 + 0.01 * load
        count["lost"] += lost
        self.dropped += lost
        self.passed, self.packets = self.passed + size, self.packets + 1 + size // 1200
        ms = 18 + self.random.gamma(2.0, 2.5) + 60 * load * self.random.gamma(1.5, 1.0)
        arrived = captured + ms / 1000
        still = any(each == name and begin < arrived < end for each, begin, end in self.frozen)
        if lost or still or arrived < OPERATOR_LATER_S:
            return
        count["got"], count["got_bytes"] = count["got"] + 1, count["got_bytes"] + size
        self.arrivals[name].append((round(arrived - OPERATOR_LATER_S, 6), round(ms, 2)))

    def _telemetry(self, t: float) -> dict[str, Any]:
        cameras = {name: CameraTelemetry(count["frames"], count["bytes"], {}) for name, count in self.count.items()}
        return line_to_json(Telemetry(t, self._predicted(), self._place(), cameras, self.refused))

    def _place(self) -> Position | None:
        return Position.of(self.position) if self.position else None

    def _sample(self, t: float) -> dict[str, Any]:
        self.past = [each for each in self.past if each[0] >= t - 1.25]
        self.past.append((t, {name: (count["got"], count["got_bytes"]) for name, count in self.count.items()}))
        first = next((each for each in reversed(self.past) if each[0] <= t - 1.0 + 1e-6), self.past[0])
        seconds = max(t - first[0], 1e-6)
        cameras = {name: self._received(name, first[1][name], seconds) for name in self.count}
        sample = Sample(
            t=round(t - OPERATOR_LATER_S, 6),
            predicted_kbps=self._predicted(),
            allocated_kbps=sum(camera.allocated_kbps for camera in cameras.values()),
            actual_kbps=round(sum(camera.kbps for camera in cameras.values()), 1),
            position=self._place(),
            refused=self.refused,
            cameras=cameras,
        )
        return line_to_json(sample)

    def _received(self, name: str, first: tuple[int, int], seconds: float) -> CameraSample:
        count, setting, arrivals = self.count[name], self.now.decision.settings[name], self.arrivals[name]
        self.arrivals[name] = []
        new = seconds > 0.1
        return CameraSample(
            fps=round((count["got"] - first[0]) / seconds, 2) if new else 0.0,
            kbps=round((count["got_bytes"] - first[1]) * 8 / 1000 / seconds, 1) if new else 0.0,
            allocated_kbps=setting.kbps,
            demand_kbps=plain(setting.demand),
            scaling=None if setting.scaling is None else plain(setting.scaling),
            width=setting.width if count["got"] else 0,
            height=setting.height if count["got"] else 0,
            latency_ms=round(arrivals[-1][1] + 4 + self.random.gamma(2.0, 1.0), 2) if arrivals else None,
            lost=count["lost"],
            rebuilt=count["rebuilt"],
            frames=count["got"],
            bytes=count["got_bytes"],
            damaged=0,
            stages_ms=LatencyStages(),
            arrivals=tuple(arrivals),
        )

    def _link(self, t: float) -> dict[str, Any]:
        kbps = round(self._predicted() * 1.1)
        queue = max(0.0, float(self.random.normal(4, 2)))
        return line_to_json(LinkSample(t, kbps, round(queue, 2), self.passed, self.packets, self.dropped))


def measured(side: str, lines: Lines) -> Lines:
    """As if the vehicle had measured the link, and that had limited the total."""
    for line in lines:
        if line.get("log") == "state":
            line["asked_kbps"] = 2 * line["total_kbps"]
    if side != "vehicle":
        return lines
    event = {"event": "link_measured", "kbps": 1000, "queue_ms": 60, "loss": 0, "state": "filling", "rtt_ms": 30}
    return [each for line in lines for each in (line, {"t": line["t"], **event, "evidence": {}})]


def believing(
    kbps: Callable[[float], float], deviation: Callable[[float], float] = lambda _: 0.1
) -> Callable[[str, Lines], Lines]:
    """A change of lines: as if a rule had believed so much of the link, at a time."""

    def change(_: str, lines: Lines) -> Lines:
        for line in lines:
            if line.get("log") in ("decision", "state"):
                t = line["t"]
                known = {"kbps": round(kbps(t)), "deviation": deviation(t), "margin": 0.1, "bias": -0.2, "error": 0.1}
                line["believed"] = {**known, "gain": 0.5, "policer_kbps": None}
        return lines

    return change


def write_model(path: Path, name: str, factors: Sequence[float], full_kbps: float) -> Path:
    """A rate-quality model whose curves cross as measured ones do: quality saturates earlier for smaller factors."""
    points = []
    for factor in factors:
        for kbps in (50, 100, 200, 400, 800, 1600, 3200, 6400):
            best = 0.97 - 0.16 * (1 - factor) ** 2
            quality = best - 0.5 * factor * np.exp(-kbps / (full_kbps * 0.12 * factor + 40))
            points.append(
                {"scaling": factor, "target_kbps": kbps, "actual_kbps": kbps * 0.97, "encode_ms": 3.0, "mssim": quality}
            )
    clip = {
        "file": "clip.mkv",
        "sha256": "0",
        "width": 1920,
        "height": 1040,
        "fps": 40,
        "codec": "FFV1",
        "lossless": True,
    }
    clip |= {"frames": 100, "si": 50.0, "ti": 20.0, "si_mean": 45.0, "ti_mean": 15.0}
    document = {
        "version": 1,
        "tod_runner": "0.1.0",
        "name": name,
        "content": "0",
        "sequences": {name: clip},
        "masks": {},
        "encoder": {"graph": "x264enc", "versions": {}},
        "metric": "mssim",
        "metrics": {"mssim": "MSSIM of luma (Wang 2004)"},
        "plan": "full",
        "metric_every": 1,
        "points": points,
        "scaling": list(factors),
        "b_min_kbps": [0, 300, 950][: len(factors)],
        "b_full_kbps": int(full_kbps),
        "b_full_quality": 0.95,
        "crossings": [],
        "regret": [],
        "dropped": [],
        "cores": [],
        "warnings": [],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))
    return path


def write_models(directory: Path, config: Mapping[str, Any]) -> Path:
    """A model for each camera of a configuration."""
    for name, camera in config["cameras"].items():
        ladder = camera["rate_quality"]
        write_model(directory / f"{name}.model.json", name, ladder["scaling"], ladder["b_full_kbps"])
    return directory
