"""A drive that anyone can repeat: how long, how often, over which link. Read from the `experiment` and `link` sections."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from runner.events import ClockAdvanced, Event
from runner.model import exact
from runner.pqos import Pqos, build_pqos, trace
from runner.pqos.table import find_file
from runner.pqos.track import Track, build_track

STEP_S = 0.1  # at which the rate of a link follows a map


@dataclass(frozen=True)
class Experiment:
    """What the demo drives.

    about       what it shows, in a sentence
    duration_s  length of each drive, s
    claims      name of what a publication reports of such a drive, or ""
    runs        by name, the overrides that each of several drives adds; empty: one drive
    """

    about: str
    duration_s: float
    claims: str = ""
    runs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class LinkSettings:
    """A link of limited rate between the two sides.

    kind      netns or relay
    kbps_at   rate in force at a time of the drive (s), kbit/s
    queue_ms  longest wait before the link
    delay_ms  one way, without any queue
    """

    kind: str
    kbps_at: Callable[[float], float]
    queue_ms: float
    delay_ms: float


def read_experiment(data: Mapping[str, Any]) -> Experiment:
    runs = {name: tuple(words) for name, words in (data.get("runs") or {}).items()}
    return Experiment(data["about"], float(data["duration_s"]), data.get("claims") or "", runs)


def read_link(
    data: Mapping[str, Any], pqos: Mapping[str, Any], duration_s: float, bases: Sequence[Path]
) -> LinkSettings:
    """The link that the `link` section describes.

    pqos        the section of that name, which the rate follows where the link names no file
    duration_s  how long the rate is known ahead
    raises      ModelError with the key of the link's or of the pqos section, what was found and what is right
    """
    share = float(data["share"])
    if data["file"]:
        path = find_file(data, "file", bases)
        rates = trace(path, data["loop"], exact(0))
        kbps_at: Callable[[float], float] = lambda t: share * float(rates(t))
    else:
        truth = build_pqos({**pqos, "look_ahead_s": 0}, bases)
        known = _sampled(truth, build_track(pqos, bases), duration_s)
        kbps_at = lambda t: share * known[min(max(0, int(t / STEP_S)), len(known) - 1)]
    return LinkSettings(data["kind"], kbps_at, float(data["queue_ms"]), float(data["delay_ms"]))


def _sampled(source: Pqos, track: Track | None, duration_s: float) -> list[float]:
    """What a source of predictions states for each moment of a drive, kbit/s, every STEP_S."""
    rates: list[float] = []
    last = 0.0
    for step in range(int(duration_s / STEP_S) + 1):
        t = step * STEP_S
        event: Event = ClockAdvanced(t=t) if track is None else track.at(t)
        prediction = source.observe(event)
        last = last if prediction is None else float(prediction.kbps)
        rates.append(last)
    return rates
