"""Right and wrong predictions over recorded uplinks, in paired runs: what the operator saw.

  python bench/uplinks.py OUT UPLINK.csv...                   5 runs of each, hours
  python bench/uplinks.py OUT UPLINK.csv --runs 1 --seconds 30 --only right high_50
  python bench/uplinks.py OUT NARROW.csv --set vehicle=delivery_robot      three cameras fill a narrow uplink

Drives `experiment=wrong_prediction` over each uplink, measures each drive, and prints a table: medians over the runs,
and their range. A drive over an unlimited link first shows how much of their bitrate the cameras use: if that is
little, or a busy machine drops frames, a row says nothing about the link and is marked void. OUT keeps the drives,
OUT/uplinks.json all figures and OUT/uplinks.png a chart of them; existing drives are not repeated. Run it on an
otherwise idle machine.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import fmean, median
from textwrap import fill

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from runner.configuration.config import configuration
from runner.core.budget import wire_kbps
from runner.core.model import Camera, exact, plain
from runner.drive.camera_series import CameraSeries
from runner.drive.log import FILES
from runner.drive.quality_file import DOCUMENT, DeliveredQuality, read_quality
from runner.drive.read import Drive, read_drive
from runner.drive.series import Series, series
from runner.drive.statistics import statistics
from runner.records.decisions import DecisionMade
from runner.records.lines import LinkSample
from runner.system.files import write_whole

EXPERIMENT = "experiment=wrong_prediction"
FPS = 15  # of eight cameras on two cores, which also do everything else; less for a wide uplink or a slow machine
SETTLED_S = 3.0  # a drive counts from here on
USABLE_KBPS = 500  # latency counts while the link carries at least this much
OUTAGE_KBPS, OUTAGE_S = 50, 1.0  # an outage: less than this for longer, until the link is usable again
FIGURES = {
    "frozen": "frozen %",
    "back_s": "back after outage, p95 s",
    "p50_ms": "p50 ms",
    "p99_ms": "p99 ms",
    "queue_p50": "queue p50 ms",
    "queue_p95": "p95",
    "queue_p99": "p99",
    "used": "used %",
    "damaged": "damaged %",
    "lost": "lost",
    "mssim": "MSSIM mean",
    "worst": "MSSIM worst",
    "switches": "sizes/min",
    "dropped": "frames dropped by the cameras %",
}
FILLED, DROPPED = 95, 1  # %, at least and at most; otherwise a row is void
# Panels of the picture: their scale, and which way is better.
PANELS = {
    "frozen": ("frozen, % of the time (less is better)", "linear"),
    "p99_ms": ("capture to arrival, p99, ms (less is better)", "log"),
    "used": ("link used, % (more is better)", "linear"),
    "mssim": ("MSSIM of delivered pictures (more is better)", "linear"),
}
COLOURS = ("#0072B2", "#56B4E9", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#8C564B", "#7F7F7F", "#000000")
MARKERS = ("o", "s", "^")  # one for each round through the colours
Figures = dict[str, float]
Floats = NDArray[np.float64]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("uplinks", type=Path, nargs="+")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--fps", type=int, default=FPS, help="frames a second of each camera, at most")
    parser.add_argument("--only", nargs="*", help="conditions of the experiment; all if not given")
    parser.add_argument("--set", nargs="*", default=[], help="further overrides, such as vehicle=delivery_robot")
    options = parser.parse_args()
    common = [EXPERIMENT, "~experiment.runs", f"fps_max={options.fps}", f"duration_s={options.seconds}", *options.set]
    found: dict[str, dict[str, list[Figures]]] = {}
    filled: dict[str, float] = {}
    for uplink in options.uplinks:
        filled[uplink.stem] = _bitrate_use(options.output / uplink.stem / "unlimited", [*common, _trace(uplink)])
        print(f"{uplink.stem}: the cameras use {filled[uplink.stem]:.0f} % of their bitrate", flush=True)
        conditions = _conditions(uplink)
        drives: dict[str, list[Figures]] = {name: [] for name in options.only or conditions}
        found[uplink.stem] = drives
        for number in range(options.runs):  # paired: other load on the machine affects all conditions
            for name, done in drives.items():
                path = options.output / uplink.stem / f"{name}.{number}"
                measured_drive(path, [*common, _trace(uplink), *conditions[name]])
                done.append(figures(path))
                print(uplink.stem, path.name, {key: round(value, 3) for key, value in done[-1].items()}, flush=True)
            write_whole(options.output / "uplinks.json", json.dumps(found, indent=1).encode())
    picture(found).savefig(options.output / "uplinks.png", dpi=100)
    print("\n".join(table(found, filled)))


def _bitrate_use(path: Path, words: Sequence[str]) -> float:
    """Share of the allocated bitrate that the cameras send over an unlimited link, %."""
    ensure_drive(path, [*words, "modes=open_loop", "link=null"])
    return 100 * statistics(series(read_drive(path), path.name)).share


def _conditions(uplink: Path) -> dict[str, list[str]]:
    """The overrides of each run of the experiment, by name."""
    experiment = configuration([EXPERIMENT, _trace(uplink)]).experiment()
    return {name: list(words) for name, words in experiment.runs.items()}


def _trace(uplink: Path) -> str:
    return f"pqos.file={uplink.resolve()}"


def measured_drive(path: Path, words: Sequence[str]) -> None:
    """Drive and measure the delivered pictures, unless that has been done."""
    ensure_drive(path, [*words, "log.video=true"])
    if not (path / DOCUMENT).exists():
        run = [sys.executable, "-m", "runner", "quality", str(path)]
        subprocess.run(run, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        shutil.rmtree(path / "video")


def ensure_drive(path: Path, words: Sequence[str]) -> None:
    """Drive, unless the drive exists; one that was cut short, or had other overrides or traces, is repeated."""
    done, driven = path / "done", "\n".join([*words, *map(_digest, words)])
    if done.exists() and done.read_text() == driven:
        return
    shutil.rmtree(path, ignore_errors=True)
    run = [sys.executable, "-m", "runner", "demo", *words, "page.serve=false", f"log={path}"]
    subprocess.run(run, check=True, stdout=subprocess.DEVNULL)
    _check_replay(path)
    done.write_text(driven)


def _digest(word: str) -> str:
    """Of the file that an override names; "" if it names none."""
    file = Path(word.partition("=")[2])
    return hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else ""


def _check_replay(path: Path) -> None:
    """End with a message unless a replay decides exactly what the drive decided, with the link measured again too."""
    driven = _decisions(path)
    for link in ("logged", "again"):
        with tempfile.TemporaryDirectory() as again:
            words = ["replay", f"input={path}", f"link={link}", f"log={again}/drive", f"output={again}/decisions"]
            subprocess.run([sys.executable, "-m", "runner", *words], check=True, stderr=subprocess.DEVNULL)
            if driven != _decisions(Path(again, "drive")):
                raise SystemExit(f"{path}: a replay with link={link} decides otherwise")


def _decisions(path: Path) -> list[str]:
    lines = (path / FILES["vehicle"]).read_text().splitlines()
    return [line for line in lines if json.loads(line).get("log") == "decision"]


def row(*cells: str) -> str:
    """A row of a table in Markdown."""
    return f"| {' | '.join(cells)} |"


def figures(path: Path) -> Figures:
    """What one drive showed."""
    logged = read_drive(path)
    over_time = series(logged, path.name)
    whole = statistics(over_time)
    link_t, link_kbps = _link(logged)
    arrived = [camera.received for camera in over_time.cameras.values() if camera.received]
    times = np.concatenate([received.arrival_t for received in arrived])
    ms = np.concatenate([received.arrival_ms for received in arrived])
    usable = _at(link_t, link_kbps, times) >= USABLE_KBPS
    counts = usable & (times > SETTLED_S) & np.isfinite(ms)
    return {
        "frozen": 100 * whole.frozen,
        "back_s": recovery_s(over_time, link_t, link_kbps),
        "p50_ms": float(np.percentile(ms[counts], 50)),
        "p99_ms": float(np.percentile(ms[counts], 99)),
        "used": 100 * link_use(logged, over_time),
        "damaged": 100 * whole.damaged,
        "lost": float(whole.lost or 0),
        **mssim(path, logged),
        **queue_ms(logged, "queue_"),
        "switches": switches(over_time),
        "dropped": dropped_share(over_time, cameras(logged)),
    }


def mssim(path: Path, drive: Drive) -> Figures:
    """Quality of the delivered pictures: mean of the cameras, and the worst camera."""
    delivered = read_quality(path)
    if missing := cameras(drive).keys() - delivered.keys():
        raise SystemExit(f"{path}: no pictures were delivered of {', '.join(sorted(missing))}")
    means = [_mean(camera, *_link(drive)) for camera in delivered.values()]
    return {"mssim": fmean(means), "worst": min(means)}


def _mean(camera: DeliveredQuality, link_t: Floats, link_kbps: Floats) -> float:
    """Over the time in which the link carries at least USABLE_KBPS."""
    t, scores = np.array(camera.t), np.array(camera.mssim)
    return float(scores[(t > SETTLED_S) & (_at(link_t, link_kbps, t) >= USABLE_KBPS)].mean())


def dropped_share(over_time: Series, mounted: Mapping[str, Camera]) -> float:
    """Frames that the cameras should have sent and did not, %: the machine was too busy.

    Counted while they send: between two samples in which nothing was sent, nobody watched, or sending was off.
    """
    sent = due = 0.0
    for name, camera in over_time.cameras.items():
        assert camera.sent
        frames, seconds = np.diff(camera.sent.frames), np.diff(camera.sent.t)
        if len(frames) < 3:
            continue
        sends = np.convolve(frames == 0, np.ones(3), "same") == 0  # excludes samples in which it starts or stops
        sends &= camera.sent.t[:-1] >= SETTLED_S
        sent, due = sent + float(frames[sends].sum()), due + float(mounted[name].fps) * float(seconds[sends].sum())
    return max(0.0, 100 * (1 - sent / due)) if due else float("nan")


def queue_ms(drive: Drive, name: str = "") -> Figures:
    """Percentiles of the wait in front of the link, by its own log."""
    waits = [sample.queue_ms for sample in drive.sides["link"].of(LinkSample) if sample.t > SETTLED_S]
    return {f"{name}p{share}": float(np.percentile(waits, share)) for share in (50, 95, 99)}


def switches(over_time: Series) -> float:
    """Changes of the size of any picture, in a minute."""
    changes = sum(np.count_nonzero(np.diff(camera.decided.width)) for camera in over_time.cameras.values())
    return float(60 * changes / over_time.end)


def _link(drive: Drive) -> tuple[Floats, Floats]:
    """Rate of the link over time, s since the vehicle's log began and kbit/s."""
    link = drive.sides["link"]
    ahead = link.began.time - drive.sides["vehicle"].began.time
    samples = [(sample.t + ahead, sample.kbps) for sample in link.of(LinkSample)]
    t, kbps = np.array(samples, dtype=float).T
    return t, kbps


def _at(t: Floats, values: Floats, times: Floats) -> Floats:
    """The values in force at some times."""
    held: Floats = values[np.clip(np.searchsorted(t, times, "right") - 1, 0, len(values) - 1)]
    return held


def cameras(drive: Drive) -> Mapping[str, Camera]:
    """The cameras of a drive."""
    config = dict(drive.sides["vehicle"].began.config)
    return configuration([], base=(config, "config"), runnable=False).vehicle().cameras


def totals(drive: Drive) -> list[tuple[float, float]]:
    """The total in force over time with its packet headers: s by the vehicle's log, kbit/s."""
    mounted = cameras(drive)

    def on_wire(line: DecisionMade) -> float:
        on = [mounted[name] for name, own in line.cameras.items() if own.on]
        return float(wire_kbps(on, exact(line.total_kbps)))

    return [(line.t, on_wire(line)) for line in drive.sides["vehicle"].of(DecisionMade)]


def link_use(drive: Drive, over_time: Series) -> float:
    """Bytes that passed over those that could have: at most what the link carried and the cameras may send."""
    most = float(plain(sum(camera.rate_quality.b_full for camera in cameras(drive).values())))
    samples = [sample for sample in drive.sides["link"].of(LinkSample) if sample.t > SETTLED_S]
    could = sum(min(before.kbps, most) * (after.t - before.t) for before, after in pairwise(samples))
    return (samples[-1].bytes - samples[0].bytes) * 8 / 1000 / could


def recovery_s(over_time: Series, t: Floats, kbps: Floats) -> float:
    """Time from the end of an outage until a camera is live again, over all cameras and outages: p95, s.

    A camera is live once an undamaged picture arrives that was captured since. inf: never; nan: there was no outage
    """
    waits = [_wait(camera, end) for end in outages(t, kbps) for camera in over_time.cameras.values()]
    return float(np.percentile(waits, 95, method="higher")) if waits else float("nan")


def _wait(camera: CameraSeries, since: float) -> float:
    """Time until an undamaged picture has arrived that was captured since then, at most, s; inf: never.

    A sample counts damaged pictures: of one more than these, one is undamaged.
    """
    got = camera.received
    if got is None:
        return np.inf
    arrived = got.arrival_t[got.arrival_t - got.arrival_ms / 1000 >= since]
    sample = np.searchsorted(got.t, arrived)  # the one that counts the picture
    for number in np.unique(sample[sample < len(got.t)]):
        damaged = got.damaged[number] - got.damaged[max(number - 1, 0)]
        if (sample == number).sum() > damaged:
            return float(arrived[sample == number][int(damaged)] - since)
    return np.inf


def outages(t: Floats, kbps: Floats) -> Iterator[float]:
    """The end of each outage."""
    began: float | None = None
    for now, rate in zip(t, kbps, strict=True):
        if rate < OUTAGE_KBPS:
            began = now if began is None else began
        elif began is not None and rate >= USABLE_KBPS:
            if now - began >= OUTAGE_S and began > SETTLED_S:
                yield now
            began = None


def table(found: dict[str, dict[str, list[Figures]]], filled: dict[str, float]) -> Iterator[str]:
    """Markdown: a row for each uplink and condition, median and range over its runs.

    filled  % by uplink, see `_bitrate_use`
    """
    yield row("uplink", "prediction", *FIGURES.values())
    yield row(*["---"] * (len(FIGURES) + 2))
    for uplink, conditions in found.items():
        for name, drives in conditions.items():
            void = filled[uplink] < FILLED or max(drive["dropped"] for drive in drives) > DROPPED
            yield row(
                uplink,
                f"{name} (void)" if void else name,
                *(shown(key, [one[key] for one in drives]) for key in FIGURES),
            )


def picture(found: dict[str, dict[str, list[Figures]]]) -> Figure:
    """Each run a dot, by uplink and condition, and a line at the median of the runs."""
    figure = Figure(figsize=(12, 8), layout="constrained")
    names = list(dict.fromkeys(name for conditions in found.values() for name in conditions))
    colours = {name: COLOURS[number % len(COLOURS)] for number, name in enumerate(names)}
    markers = {name: MARKERS[number // len(COLOURS)] for number, name in enumerate(names)}
    for axes, (key, (title, scale)) in zip(figure.subplots(2, 2).flat, PANELS.items(), strict=True):
        for place, conditions in enumerate(found.values()):
            for number, (name, drives) in enumerate(conditions.items()):
                x = place + 0.8 * ((number + 0.5) / len(names) - 0.5)
                values = [drive[key] for drive in drives]
                axes.plot([x] * len(values), values, markers[name], color=colours[name], markersize=4, alpha=0.5)
                axes.plot([x - 0.03, x + 0.03], [median(values)] * 2, color=colours[name], linewidth=3)
        axes.set(title=title, yscale=scale, xticks=range(len(found)), xlim=(-0.5, len(found) - 0.5))
        axes.set_xticklabels([fill(re.sub("[_-]", " ", name), 14) for name in found], fontsize=8)
        if scale == "log":
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter("{x:g}")
        axes.grid(axis="y", alpha=0.3)
    labels = {name: name.replace("_", " ") for name in names}
    handles = [Line2D([], [], color=colours[name], marker=markers[name], label=labels[name]) for name in names]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(8, len(names)), title="prediction, or policy")
    return figure


def shown(key: str, values: Sequence[float]) -> str:
    digits = 3 if key in ("mssim", "worst") else 0 if key in ("p50_ms", "p99_ms", "used", "lost", "switches") else 1
    known = [value for value in values if not np.isnan(value)]  # inf: it never happened
    if not known:
        return "–"
    ends = f" ({min(known):.{digits}f} to {max(known):.{digits}f})" if len(known) > 1 else ""
    return f"{median(known):.{digits}f}{ends}"


if __name__ == "__main__":
    main()
