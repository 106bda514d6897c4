"""What a driver sees for the same bits: rules that know the screen, and others.

  tod-runner model vehicle=tum_q7 source=synthetic fps_max=20 output=MODELS
  python bench/seen.py MODELS OUT [--totals 1000 2000 3000 5000 8000] [--layouts drive half configure] [--seconds 8]

The rules decide once for each total, layout and policy. Each camera's clip is then encoded with that region, size and
bitrate by the live graph's own encoder, decoded, and drawn at the size that it has on the screen. Its score is that of
the visible part against the same part of the clip (MSSIM of luma), weighted by px of the screen.
Encodings are kept in OUT, so that an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from helpers import Drive, setup

from runner.core.decision import Setting
from runner.core.model import Camera, Roi
from runner.core.view import Seen
from runner.graph import compile_graph
from runner.lanes import Lane, compile_lanes
from runner.system.files import write_whole

STRIDE = 8  # one frame in so many is scored
MODEL = ("scaling", "b_min_kbps", "b_full_kbps", "quality")


class Policy(NamedTuple):
    """Overrides, and whether the cameras' own models are used."""

    words: tuple[str, ...]
    own: bool = True


POLICIES = {
    "equal": Policy(("modes=equal",)),
    "paper, Table I": Policy(("modes=paper",), own=False),
    "paper, own models": Policy(("modes=paper",)),
    "seen": Policy(("modes=seen",)),
}
WITHOUT = {  # levers of `seen`, each switched off
    "regions": lambda camera: (
        f"cameras.{camera.name}.always={{x: 0, y: 0, width: {camera.width}, height: {camera.height}}}"
    ),
    "sizes": lambda camera: f"cameras.{camera.name}.least_scaling=1",
}


class Tile(NamedTuple):
    """A box on the screen, px; fill: the picture covers it, and what is beyond is not seen."""

    width: int
    height: int
    fill: bool = False

    def seen(self, camera: Camera) -> Seen:
        across, down = self.width / camera.width, self.height / camera.height
        scale = max(across, down) if self.fill else min(across, down)
        width, height = (
            min(side, round(box / scale)) for side, box in ((camera.width, self.width), (camera.height, self.height))
        )
        x, y = (camera.width - width) // 2, (camera.height - height) // 2
        return Seen(x, y, width, height, round(width * scale), round(height * scale))


TOPS = ("top_front", "top_left", "top_right", "top_rear")
LAYOUTS: Mapping[str, Mapping[str, Tile]] = {  # at 1920x1080
    "drive": {
        "front_left": Tile(285, 732, fill=True),
        "front_center": Tile(1350, 732),
        "front_right": Tile(285, 732, fill=True),
        "rear_center": Tile(240, 150),
        **dict.fromkeys(TOPS, Tile(294, 183)),
    },
    "half": {
        "front_left": Tile(480, 520, fill=True),
        "front_center": Tile(960, 520),
        "front_right": Tile(480, 520, fill=True),
        "rear_center": Tile(240, 150),
        **dict.fromkeys(TOPS, Tile(294, 183)),
    },
    "configure": {
        **dict.fromkeys(("front_left", "front_center", "front_right", "rear_center"), Tile(470, 300)),
        **dict.fromkeys(TOPS, Tile(470, 300)),
    },
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--totals", type=int, nargs="+", default=[1000, 2000, 3000, 5000, 8000])
    parser.add_argument("--layouts", nargs="+", choices=LAYOUTS, default=list(LAYOUTS))
    parser.add_argument("--policies", nargs="+", choices=POLICIES, default=list(POLICIES))
    parser.add_argument("--seconds", type=float, default=8)
    parser.add_argument("--fps", type=int, default=20)
    parser.add_argument("--set", nargs="*", default=[], help="further overrides of the policies that know the screen")
    parser.add_argument("--each", action="store_true", help="a line for each camera, too")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    words = ["vehicle=tum_q7", "source=synthetic", f"fps_max={options.fps}"]
    decided = {
        (policy, layout, total): decisions(words, policy, layout, total, options)
        for policy in options.policies
        for layout in options.layouts
        for total in options.totals
    }
    scores = Scores(options.output / "scores.json", words, options.seconds)
    scores.add(decided)
    for line in table(decided, scores, options):
        print(line)


def own_models(directory: Path) -> list[str]:
    """Overrides with the models that `tod-runner model` has written."""
    return [
        f"cameras.{path.stem}.rate_quality={json.dumps({k: v for k, v in own.items() if k in MODEL})}".replace('"', "")
        for path in sorted(directory.glob("*.yaml"))
        if (own := yaml.safe_load(path.read_text())["rate_quality"])
    ]


def decisions(words: Sequence[str], policy: str, layout: str, total: int, options: Any) -> Mapping[str, Setting]:
    """How each camera is sent, with the view of a layout."""
    own = POLICIES[policy]
    models = own_models(options.models) if own.own else []
    more = options.set if policy.startswith("seen") else []
    drive = Drive(*words, *own.words, *models, "mode=collective", *more)
    drive.accept("total_set", kbps=total)
    view = {name: tile.seen(drive.vehicle.cameras[name]) for name, tile in LAYOUTS[layout].items()}
    drive.accept("attention_changed", attention="watching")
    drive.accept("view_reported", view={name: seen_json(seen) for name, seen in view.items()})
    drive.accept("clock_advanced", t=5.0)
    return drive.accept("clock_advanced", t=10.0).decision.settings


def seen_json(seen: Seen) -> dict[str, int]:
    return dict(zip(("x", "y", "width", "height", "screen_width", "screen_height"), astuple(seen), strict=True))


class Encoding(NamedTuple):
    """What is encoded, and as part of which view it is scored."""

    camera: str
    roi: Roi
    lane: Lane
    seen: Seen

    @property
    def key(self) -> str:
        return json.dumps(
            [self.camera, *astuple(self.roi), str(self.lane.scaling), self.lane.kbps, *astuple(self.seen)]
        )


Decided = Mapping[tuple[str, str, int], Mapping[str, Setting]]


class Scores:
    """MSSIM on the screen and kbit/s of encodings, kept in a file."""

    def __init__(self, path: Path, words: Sequence[str], seconds: float) -> None:
        self._path, self._seconds, self._setup = path, seconds, setup(*words)
        self._known: dict[str, tuple[float, float]] = json.loads(path.read_text()) if path.exists() else {}

    def of(self, camera: str, setting: Setting, seen: Seen) -> tuple[float, float]:
        """MSSIM, and kbit/s; nothing is seen of a camera that is not sent."""
        return self._known[encoding(camera, setting, seen).key] if setting.sending else (0.0, 0.0)

    def views(self, layout: str) -> Mapping[str, Seen]:
        """By camera, what a layout shows."""
        return {name: tile.seen(self._setup.vehicle.cameras[name]) for name, tile in LAYOUTS[layout].items()}

    def add(self, decided: Decided) -> None:
        """Encode and score what is not known yet."""
        wanted: dict[tuple[str, Roi], dict[str, Encoding]] = {}
        for (_, layout, _), settings in decided.items():
            for name, setting in settings.items():
                if setting.sending:
                    each = encoding(name, setting, self.views(layout)[name])
                    if each.key not in self._known:
                        wanted.setdefault((name, each.roi), {})[each.key] = each
        for number, ((name, roi), encodings) in enumerate(wanted.items(), 1):
            print(f"{number} of {len(wanted)}: {name}, {roi.width}x{roi.height}, {len(encodings)}", file=sys.stderr)
            self._known |= self._measure(name, roi, list(encodings.values()))
            write_whole(self._path, json.dumps(self._known).encode())

    def _measure(self, name: str, roi: Roi, encodings: Sequence[Encoding]) -> dict[str, tuple[float, float]]:
        from runner.apply import run_lanes
        from runner.rate_quality.metrics import find_metric
        from runner.rate_quality.screen import on_screen
        from runner.rate_quality.sequence import decoding

        setup, metric = self._setup, find_metric("mssim")
        camera = setup.vehicle.cameras[name]
        plan, lanes = compile_graph(camera, setup.media), list(dict.fromkeys(each.lane for each in encodings))
        end = f"identity eos-after={round(self._seconds * float(camera.fps)) + 1}"
        decode = f"{decoding(self._clip(name), camera.fps)} ! {end}"
        references: dict[int, Any] = {}
        meters = {
            each.key: metric.meter((each.seen.screen_width, each.seen.screen_height), camera.fps, STRIDE, None)
            for each in encodings
        }
        views = {each.seen for each in encodings}

        def keep(frame: int, luma: Any) -> None:
            if frame % STRIDE == STRIDE // 2:
                references[frame] = {seen: on_screen(luma, camera.full_roi, seen) for seen in views}

        def score(lane: int, frame: int, luma: Any) -> None:
            if frame in references:
                for each in (each for each in encodings if each.lane == lanes[lane]):
                    meters[each.key].add(frame, references[frame][each.seen], on_screen(luma, roi, each.seen))

        results = run_lanes(compile_lanes(plan, decode, roi, lanes), keep, score, lambda frames: None)
        kbps = {
            lane: 8e-3 * sum(size for _, size in result.sent) * float(camera.fps) / result.frames
            for lane, result in zip(lanes, results, strict=True)
        }
        means = {each.key: list(meters[each.key].close().values()) for each in encodings}
        return {each.key: (sum(of := means[each.key]) / len(of), kbps[each.lane]) for each in encodings}

    def _clip(self, name: str) -> Path:
        from runner.plans import compile_plans, render_missing

        only = self._setup.with_cameras({name: self._setup.vehicle.cameras[name]})
        render_missing(only.vehicle, lambda what, share: None)
        (plan,) = compile_plans(only)
        return Path(next(str(each.properties["location"]) for each in plan.source if "location" in each.properties))


def encoding(camera: str, setting: Setting, seen: Seen) -> Encoding:
    assert setting.scaling is not None
    return Encoding(camera, setting.roi, Lane(setting.scaling, setting.kbps), seen)


class OnScreen(NamedTuple):
    """MSSIM of a layout: mean by px of the screen, and of each camera; kbit/s of all."""

    mean: float
    cameras: Mapping[str, float]
    kbps: float

    @property
    def worst(self) -> float:
        return min(self.cameras.values())

    @property
    def front(self) -> float:
        return self.cameras["front_center"]


def on_the_screen(layout: str, settings: Mapping[str, Setting], scores: Scores) -> OnScreen:
    found = {name: scores.of(name, settings[name], seen) for name, seen in scores.views(layout).items()}
    areas = {name: seen.screen_width * seen.screen_height for name, seen in scores.views(layout).items()}
    mean = sum(areas[name] * quality for name, (quality, _) in found.items()) / sum(areas.values())
    return OnScreen(mean, {name: quality for name, (quality, _) in found.items()}, sum(k for _, k in found.values()))


def table(decided: Decided, scores: Scores, options: Any) -> Iterable[str]:
    for layout in options.layouts:
        yield f"{layout:20} {'kbit/s':>7} {'mean':>6} {'worst':>6} {'front':>6} {'sent':>7}"
        for policy in options.policies:
            for total in options.totals:
                settings = decided[policy, layout, total]
                found = on_the_screen(layout, settings, scores)
                yield f"{policy:20} {total:7} {found.mean:6.4f} {found.worst:6.4f} {found.front:6.4f} {found.kbps:7.0f}"
                if options.each:
                    for name, quality in found.cameras.items():
                        own = settings[name]
                        sent = f"{own.width}x{own.height} of {own.roi.width}x{own.roi.height}"
                        yield f"    {name:16} {own.kbps:7} {quality:6.4f} {sent}"


if __name__ == "__main__":
    main()
