"""What a driver sees for the same bits: rules that know the screen, and others.

  tod-runner model vehicle=tum_q7 source=synthetic fps_max=20 output=MODELS
  python bench/seen.py MODELS OUT [--totals 1000 2000 3000 5000 8000] [--layouts drive half configure]
  python bench/seen.py MODELS OUT --clips CLIPS       recorded clips, as bench/clips.py makes them

Columns: total, MSSIM mean, of the worst and of the front camera; kbit/s sent; bits for the mean that the paper's rules
reach with that total, as a share of theirs; and by how much a camera looks worse than by them at most.

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

import numpy as np
import yaml
from helpers import Drive, setup

from runner.core.decision import Setting
from runner.core.model import Camera, Roi
from runner.core.view import Seen
from runner.graph import compile_graph
from runner.lanes import Lane, compile_lanes
from runner.settings import Setup
from runner.system.files import write_whole

STRIDE = 8  # one frame in so many is scored


class Policy(NamedTuple):
    """Overrides of the rules and of the graph, and what of the cameras' own models is used; None: Table I."""

    words: tuple[str, ...]
    graph: tuple[str, ...] = ()
    own: tuple[str, ...] | None = ("scaling", "b_min_kbps", "b_full_kbps", "quality", "shown")


TABLE = ("scaling", "b_min_kbps", "b_full_kbps")
REFERENCE = "paper, own models"
SEEN = ("modes=seen",)
ENCODER = ("graph.effort=exact", "graph.key_interval_s=6")
SIDES = {"front_left": 1040, "front_center": 1040, "front_right": 1040, "rear_center": 1200}
WHOLE = tuple(f"cameras.{name}.always={{x: 0, y: 0, width: 1920, height: {height}}}" for name, height in SIDES.items())
POLICIES = {
    "equal parts": Policy(("modes=equal",), own=TABLE),
    "paper, Table I": Policy(("modes=paper",), own=None),
    REFERENCE: Policy(("modes=paper",), own=TABLE),
    "seen": Policy(SEEN, ENCODER),
    "seen, whole images": Policy((*SEEN, *WHOLE), ENCODER),
    "seen, ranges of full images": Policy(SEEN, ENCODER, own=(*TABLE, "quality")),
    "seen, shared by demand": Policy(SEEN, ENCODER, own=TABLE),
    "seen, refresh every 1.5 s": Policy(SEEN, ENCODER[:1]),
    "seen, paper's encoder": Policy(SEEN),
}
DRAWN = ("paper, Table I", REFERENCE, "seen, paper's encoder", "seen")


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
    "drive": {  # as the page states it
        **dict.fromkeys(("front_left", "front_right"), Tile(511, 277)),
        "front_center": Tile(1476, 799),
        "rear_center": Tile(443, 277),
        **dict.fromkeys(TOPS, Tile(217, 136)),
    },
    "narrow": {  # its form on small windows: the sides show 21 % of their images
        **dict.fromkeys(("front_left", "front_right"), Tile(285, 732, fill=True)),
        "front_center": Tile(1350, 732),
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
    parser.add_argument("--fps", type=int, default=20)
    parser.add_argument("--clips", type=Path, help="a directory with a clip for each camera; else the synthetic drive")
    parser.add_argument("--set", nargs="*", default=[], help="further overrides of the policies that know the screen")
    parser.add_argument("--each", action="store_true", help="a line for each camera, too")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    words = ["vehicle=tum_q7", "source=synthetic", f"fps_max={options.fps}"]
    options.policies = list(dict.fromkeys((REFERENCE, *options.policies)))
    decided = {
        (policy, layout, total): decisions(words, policy, layout, total, options)
        for policy in options.policies
        for layout in options.layouts
        for total in options.totals
    }
    scores = Scores(options.output / "scores.json", words, options.clips)
    scores.add(decided)
    found = {key: on_the_screen(*key[:2], settings, scores) for key, settings in decided.items()}
    for line in table(found, decided, options):
        print(line)
    draw(found, options, options.output / "seen.png")


def own_models(models: Path, output: Path, keys: Sequence[str]) -> list[str]:
    """Overrides with parts of the models that `tod-runner model` has written."""
    conf, names = output / "own" / "-".join(keys), []
    (conf / "cameras").mkdir(parents=True, exist_ok=True)
    for path in models.glob("*.yaml"):
        kind = yaml.safe_load(path.read_text())
        kind["rate_quality"] = {key: value for key, value in kind["rate_quality"].items() if key in keys}
        (conf / "cameras" / path.name).write_text(yaml.safe_dump(kind))
        names.append(path.stem)
    return [f"conf={conf}", *(f"cameras@cameras.{name}={name}" for name in names)]


def decisions(words: Sequence[str], policy: str, layout: str, total: int, options: Any) -> Mapping[str, Setting]:
    """How each camera is sent, with the view of a layout."""
    own = POLICIES[policy]
    models = own_models(options.models, options.output, own.own) if own.own else []
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

    graph: tuple[str, ...]
    camera: str
    roi: Roi
    lane: Lane
    seen: Seen

    @property
    def key(self) -> str:
        return json.dumps(
            [*self.graph, self.camera, *astuple(self.roi), str(self.lane.scaling), self.lane.kbps, *astuple(self.seen)]
        )


Decided = Mapping[tuple[str, str, int], Mapping[str, Setting]]


class Scores:
    """MSSIM on the screen and kbit/s of encodings, kept in a file."""

    def __init__(self, path: Path, words: Sequence[str], clips: Path | None) -> None:
        self._path, self._clips = path, clips
        self._setups = {graph: setup(*words, *graph) for graph in {policy.graph for policy in POLICIES.values()}}
        self._known: dict[str, tuple[float, float]] = json.loads(path.read_text()) if path.exists() else {}

    def of(self, graph: tuple[str, ...], camera: str, setting: Setting, seen: Seen) -> tuple[float, float]:
        """MSSIM, and kbit/s; nothing is seen of a camera that is not sent."""
        return self._known[encoding(graph, camera, setting, seen).key] if setting.sending else (0.0, 0.0)

    def views(self, layout: str) -> Mapping[str, Seen]:
        """By camera, what a layout shows."""
        return {name: tile.seen(self._setups[()].vehicle.cameras[name]) for name, tile in LAYOUTS[layout].items()}

    def add(self, decided: Decided) -> None:
        """Encode and score what is not known yet."""
        wanted: dict[tuple[tuple[str, ...], str, Roi], dict[str, Encoding]] = {}
        for (policy, layout, _), settings in decided.items():
            for name, setting in settings.items():
                if setting.sending:
                    each = encoding(POLICIES[policy].graph, name, setting, self.views(layout)[name])
                    if each.key not in self._known:
                        wanted.setdefault(each[:3], {})[each.key] = each
        for number, ((graph, name, roi), encodings) in enumerate(wanted.items(), 1):
            print(f"{number} of {len(wanted)}: {name}, {roi.width}x{roi.height}, {len(encodings)}", file=sys.stderr)
            self._known |= self._measure(self._setups[graph], name, roi, list(encodings.values()))
            write_whole(self._path, json.dumps(self._known).encode())

    def _measure(
        self, setup: Setup, name: str, roi: Roi, encodings: Sequence[Encoding]
    ) -> dict[str, tuple[float, float]]:
        from runner.apply import run_lanes
        from runner.rate_quality.metrics import find_metric
        from runner.rate_quality.screen import on_screen
        from runner.rate_quality.sequence import decoding

        metric = find_metric("mssim")
        camera = setup.vehicle.cameras[name]
        plan, lanes = compile_graph(camera, setup.media), list(dict.fromkeys(each.lane for each in encodings))
        decode = decoding(self._clip(setup, name), camera.fps)
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

    def _clip(self, setup: Setup, name: str) -> Path:
        from runner.plans import compile_plans, render_missing

        if self._clips:
            return self._clips / f"{name}.mkv"
        only = setup.with_cameras({name: setup.vehicle.cameras[name]})
        render_missing(only.vehicle, lambda what, share: None)
        (plan,) = compile_plans(only)
        return Path(next(str(each.properties["location"]) for each in plan.source if "location" in each.properties))


def encoding(graph: tuple[str, ...], camera: str, setting: Setting, seen: Seen) -> Encoding:
    assert setting.scaling is not None
    return Encoding(graph, camera, setting.roi, Lane(setting.scaling, setting.kbps), seen)


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


def on_the_screen(policy: str, layout: str, settings: Mapping[str, Setting], scores: Scores) -> OnScreen:
    graph = POLICIES[policy].graph
    found = {name: scores.of(graph, name, settings[name], seen) for name, seen in scores.views(layout).items()}
    areas = {name: seen.screen_width * seen.screen_height for name, seen in scores.views(layout).items()}
    mean = sum(areas[name] * quality for name, (quality, _) in found.items()) / sum(areas.values())
    return OnScreen(mean, {name: quality for name, (quality, _) in found.items()}, sum(k for _, k in found.values()))


Found = Mapping[tuple[str, str, int], OnScreen]


def table(found: Found, decided: Decided, options: Any) -> Iterable[str]:
    for layout in options.layouts:
        heads = ("kbit/s", "mean", "worst", "front", "sent", "bits", "lost")
        yield " ".join((f"{layout:28}", *(f"{head:>7}" for head in heads)))
        for policy in options.policies:
            for total in options.totals:
                own, paper = found[policy, layout, total], found[REFERENCE, layout, total]
                lost = max(paper.cameras[name] - quality for name, quality in own.cameras.items())
                bits = bits_for_equal(found, policy, layout, total, options.totals)
                figures = (f"{one:7.4f}" for one in (own.mean, own.worst, own.front))
                yield " ".join((f"{policy:28} {total:7}", *figures, f"{own.kbps:7.0f} {bits:7.2f} {max(0, lost):7.4f}"))
                if options.each:
                    yield from each_camera(own, decided[policy, layout, total])


def each_camera(found: OnScreen, settings: Mapping[str, Setting]) -> Iterable[str]:
    for name, quality in found.cameras.items():
        own = settings[name]
        yield f"    {name:24} {own.kbps:7} {quality:7.4f} {own.width}x{own.height} of {own.roi.width}x{own.roi.height}"


def bits_for_equal(found: Found, policy: str, layout: str, total: int, totals: Sequence[int]) -> float:
    """Bits that the policy needs for the mean that the paper's rules reach with this total, as a share of their bits.

    Between totals, quality is interpolated over log bitrate; NaN: no total of the policy reaches as much, or as little.
    """
    paper, own = found[REFERENCE, layout, total], [found[policy, layout, each] for each in totals]
    quality, bits = [each.mean for each in own], np.log([each.kbps for each in own])
    return float(np.exp(np.interp(paper.mean, quality, bits, left=np.nan, right=np.nan)) / paper.kbps)


def draw(found: Found, options: Any, path: Path) -> None:
    """Quality on the screen over bits, a panel for each layout."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * len(options.layouts), 4), layout="constrained")
    every = np.atleast_1d(figure.subplots(1, len(options.layouts), sharey=True))
    for axes, layout in zip(every, options.layouts, strict=True):
        for policy in (policy for policy in options.policies if policy in DRAWN):
            own = [found[policy, layout, total] for total in options.totals]
            axes.plot([one.kbps / 1000 for one in own], [one.mean for one in own], ".-", label=policy)
        axes.set(title=f"layout: {layout}", xlabel="sent, Mbit/s", xscale="log")
        axes.set_xticks(ticks := [1, 2, 3, 5, 8], [str(tick) for tick in ticks])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    every[0].set_ylabel("MSSIM on the screen, mean by px")
    every[-1].legend(fontsize=9, loc="lower right")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
