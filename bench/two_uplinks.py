"""A vehicle with two uplinks: what the operator sees when one is cut, what both carry, and what redundancy costs.

  python bench/two_uplinks.py cuts OUT A.csv B.csv             30 cuts of uplink A in one drive, more than 15 minutes
  python bench/two_uplinks.py cuts OUT A.csv B.csv --quick     one cut of each length
  python bench/two_uplinks.py cuts OUT A.csv B.csv --keys --how down
  python bench/two_uplinks.py clear OUT [A.csv B.csv]          both uplinks clear, beside one of the same kind
  python bench/two_uplinks.py price OUT                        bits and processor time by number of redundant cameras

Needs root, as `link=netns` does. Cuts begin at random moments at which uplink B alone carries at least BETTER times the
bitrate of the redundant camera. A picture counts when it leaves the jitter buffer; what uplink B alone would have shown
is taken from the reception reports, which are made by uplink. Existing drives are measured again, not repeated.
"""

from __future__ import annotations

import argparse
import json
import random
import resource
import shutil
import subprocess
import sys
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
from msgspec import UNSET
from uplinks import Floats, row

from runner.core.roles import Role
from runner.drive.read import Drive, read_drive
from runner.drive.series import Series, series
from runner.records.decisions import DecisionMade
from runner.records.lines import LinkSample, Note
from runner.records.reception import ReceptionReported
from runner.security.authority import Authority

LENGTHS = (0.2, 2.0, 20.0)  # of cuts, s
PAUSE_S = 12.0  # from the end of a cut to the next one
SETTLED_S = 10.0  # a drive counts from here on
BETTER = 1.5
REDUNDANT, REDUNDANT_KBPS = "front", 800  # the camera, and the most that it gets
SAME_S = 0.02  # two capture times of one picture
LATE_MS = 300  # as the page marks them
AFTER_S = 2.0  # after a cut, in which cameras move
LOST = ("the control link is lost", "the vehicle is offline", "the vehicle has been silent")  # how notes begin
CONTROL = "c"  # lane of everything but the cameras
COMMON = ("modes=safe", "mode=automatic", "source=test", "link=netns", "page.serve=false", "fps_max=10")
REDUNDANT_OF = {"delivery_robot": REDUNDANT, "tum_q7": "front_center"}
LIMITED = (
    f"cameras.{REDUNDANT}.rate_quality={{scaling: [0.25, 0.5], b_min_kbps: [0, 250], b_full_kbps: {REDUNDANT_KBPS}}}"
)
UPLINKS = "uplinks={a: {interface: a}, b: {interface: b}}"


class Planned(NamedTuple):
    """A cut of uplink A, s since the start of the drive."""

    at_s: float
    for_s: float


class Picture(NamedTuple):
    """When a picture was captured and when it arrived, s by the drive."""

    captured: float
    arrived: float

    @property
    def late(self) -> bool:
        return 1000 * (self.arrived - self.captured) > LATE_MS


class Measured(NamedTuple):
    """What one cut did.

    better     what B carried over what the redundant camera had just before
    due        pictures of the redundant camera that were captured from the cut on until PAUSE_S / 2 after its end
    missing    that are not among these although they were sent: one that a busy machine has left out loses no packet
    damaged    of these, those that show a loss
    after_b    how much later than by B alone each arrived, ms
    latency    of the redundant camera in the AFTER_S after the cut began, ms
    waits      of each camera that A alone carried: from the cut to its first picture that is undamaged, not late, and
               captured since, s
    late       pictures of all cameras that came more than LATE_MS after their capture, or after newer ones
    """

    better: float
    due: int
    missing: int
    damaged: int
    after_b: list[float]
    latency: list[float]
    waits: list[float]
    late: int


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = parser.add_subparsers(required=True)
    for name, work in (("cuts", cuts), ("clear", clear), ("price", price)):
        kind = kinds.add_parser(name)
        kind.set_defaults(work=work)
        kind.add_argument("output", type=Path)
        kind.add_argument("traces", type=Path, nargs="*")
        kind.add_argument("--set", nargs="*", default=[], help="further overrides")
        kind.add_argument("--seed", type=int, default=1)
        kind.add_argument("--moments", type=int, default=10, help="cuts of each length")
        kind.add_argument("--lengths", type=float, nargs="+", default=LENGTHS, help="of cuts, s")
        kind.add_argument("--how", default="silence", help="as in link.cuts")
        kind.add_argument("--quick", action="store_true", help="one cut of each length")
        kind.add_argument("--keys", action="store_true")
        kind.add_argument("--control", action="store_true", help="let the control link use the uplinks, too")
        kind.add_argument("--vehicle", choices=REDUNDANT_OF, default="delivery_robot" if name == "cuts" else "tum_q7")
        kind.add_argument("--seconds", type=int, default=60, help="of a drive without cuts")
    options = parser.parse_args()
    options.work(options)


def lanes(*kbps: str, control: bool = False) -> str:
    """The override with the lanes of uplinks A and B, and one for everything else, which leaves by the first."""
    first = "" if control else f"{CONTROL}: {{kbps: 50000}}, "
    each = (f"{name}: {{{rate}, delay_ms: {ms}}}" for name, rate, ms in zip("ab", kbps, (20, 35), strict=False))
    return f"link.lanes={{{first}{', '.join(each)}}}"


def drive(path: Path, words: Sequence[str]) -> float:
    """Drive unless the drive exists; returns the processor time of both sides, s."""
    done = path / "done"
    if not (done.exists() and json.loads(done.read_text())["words"] == list(words)):
        shutil.rmtree(path, ignore_errors=True)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        run = [sys.executable, "-m", "runner", "demo", *words, f"log={path}"]
        subprocess.run(run, check=True, stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        done.write_text(json.dumps({"words": list(words), "cpu_s": spent}))
    return float(json.loads(done.read_text())["cpu_s"])


# --- cuts -------------------------------------------------------------------------------------------------------------


def cuts(options: argparse.Namespace) -> None:
    """Cut uplink A, and print what that did, by length of the cut."""
    a, b = (rates(path) for path in options.traces)
    planned = plan(a, b, options.lengths, 1 if options.quick else options.moments, random.Random(options.seed))
    path = options.output / f"cuts-{options.how}{'-keys' if options.keys else ''}"
    words = [*_words(options), LIMITED, f"duration_s={planned[-1].at_s + planned[-1].for_s + PAUSE_S:g}"]
    of_lane = (f"{{lane: a, at_s: {cut.at_s}, for_s: {cut.for_s}, how: {options.how}}}" for cut in planned)
    words.append(f"link.cuts=[{', '.join(of_lane)}]")
    words.append(lanes(*(f"file: {trace.resolve()}" for trace in options.traces), control=options.control))
    drive(path, [*words, *options.set])
    logged = read_drive(path)
    over_time = series(logged)
    found = [(cut, measured(logged, over_time, cut)) for cut in planned]
    for cut, one in found:
        print(f"{cut.at_s:7.1f} s, {cut.for_s:4g} s:", _line(one), flush=True)
    print(row("cut", "cuts", "due", "missing", "damaged", "after B alone, ms", "latency, ms", "others live, s", "late"))
    print(row(*["---"] * 9))
    for length in options.lengths:
        print(_summary(f"{length:g} s", [one for cut, one in found if cut.for_s == length and one.better >= BETTER]))
    print(_summary("other moments", [one for _, one in found if one.better < BETTER]))
    until = planned[-1].at_s + planned[-1].for_s + PAUSE_S / 2  # then the drive ends
    notes = logged.sides["operator"].of(Note)
    lost = [line.text for line in notes if line.text.startswith(LOST) and line.t < until]
    rebuilt = {name: int(each.received.rebuilt[-1]) for name, each in over_time.cameras.items() if each.received}
    print(f"control: {lost or 'never lost'}; rebuilt: {rebuilt}")


def _words(options: argparse.Namespace) -> list[str]:
    redundant = REDUNDANT_OF[options.vehicle]
    words = [*COMMON, UPLINKS, f"vehicle={options.vehicle}", f"cameras.{redundant}.redundant=true"]
    if not options.keys:
        return words
    directory = (options.output / "keys").resolve()
    if not directory.exists():
        authority = Authority(directory)
        with authority.opened():
            authority.issue("broker", Role.BROKER, ["localhost"])
            authority.issue(options.vehicle, Role.VEHICLE, [])
            authority.issue("alice", Role.CONTROLLER, [])
    return [*words, f"keys={directory}"]


def rates(path: Path) -> list[float]:
    """kbit/s in each second."""
    lines = path.read_text().splitlines()
    column = lines[0].split(",").index("uplink_kbps")
    return [float(line.split(",")[column]) for line in lines[1:]]


def plan(
    a: Sequence[float], b: Sequence[float], lengths: Sequence[float], moments: int, chance: random.Random
) -> list[Planned]:
    """Cuts of each length in random order, at least PAUSE_S apart.

    Each begins where A carries something, and where B carries enough until AFTER_S after its end.
    """
    wanted = [length for length in lengths for _ in range(moments)]
    chance.shuffle(wanted)
    planned, t = [], SETTLED_S
    for length in wanted:
        t += chance.uniform(0, 5)
        while not (_least(a, t - 1, t) > 1000 and _least(b, t - 1, t + length + AFTER_S) > BETTER * REDUNDANT_KBPS):
            t += 1
        planned.append(Planned(round(t, 2), length))
        t += length + PAUSE_S
    return planned


def _least(kbps: Sequence[float], since: float, until: float) -> float:
    return min(kbps[second % len(kbps)] for second in range(int(since), int(until) + 1))


def measured(logged: Drive, over_time: Series, cut: Planned) -> Measured:
    began, until = cut.at_s, cut.at_s + cut.for_s + PAUSE_S / 2
    received = over_time.cameras[REDUNDANT].received
    assert received
    shown = pictures(over_time, REDUNDANT)
    due = [picture for picture in shown if began <= picture.captured < until]
    interval = 1 / over_time.cameras[REDUNDANT].fps
    gaps = [later.captured - earlier.captured for earlier, later in pairwise(sorted(due))]
    alone = by_uplink(logged, "b").get(REDUNDANT, [])
    at = [captured for captured, _ in alone]
    after_b = []
    for picture in due:
        place = bisect_left(at, picture.captured - SAME_S)
        if place < len(at) and at[place] < picture.captured + SAME_S:
            after_b.append(1000 * (picture.arrived - alone[place].arrived))
    return Measured(
        _held(over_time, "b", began) / max(1.0, _decided(over_time, REDUNDANT, began)),
        len(due),
        sum(round(gap / interval) - 1 for gap in gaps) if _risen(received.t, received.lost, began, until) else 0,
        _risen(received.t, received.damaged, began, until),
        after_b,
        [1000 * (each.arrived - each.captured) for each in due if each.captured < began + AFTER_S],
        [_live_again(over_time, name, began) for name in carried_by_a(logged, began)],
        sum(_late(pictures(over_time, name), began, until) for name in over_time.cameras),
    )


def pictures(over_time: Series, camera: str) -> list[Picture]:
    """In order of arrival."""
    got = over_time.cameras[camera].received
    assert got
    return [Picture(float(t - ms / 1000), float(t)) for t, ms in zip(got.arrival_t, got.arrival_ms, strict=True)]


def _late(shown: Sequence[Picture], began: float, until: float) -> int:
    newest, late = -np.inf, 0
    for picture in shown:
        if began <= picture.arrived < until:
            late += picture.late or picture.captured < newest
        newest = max(newest, picture.captured)
    return late


def by_uplink(logged: Drive, uplink: str) -> dict[str, list[Picture]]:
    """By camera, the pictures that an uplink alone has delivered whole, in order of capture; s by the drive."""
    side = logged.sides["vehicle"]
    reports = [line.report for line in side.of(ReceptionReported) if line.in_control]
    clock = median(report.sent - report.at for report in reports if report.sent is not UNSET)  # 1970 from monotonic
    found: dict[str, list[Picture]] = {}
    for report in reports:
        if report.uplink != uplink or report.offset_s is UNSET:
            continue
        for unit in report.units:
            arrived = report.at - unit.ago_s + clock - side.began_s
            captured = report.at - unit.ago_s - unit.delay_s - report.offset_s - side.began_s
            if unit.whole:
                found.setdefault(unit.camera, []).append(Picture(captured, arrived))
    return {camera: sorted(each) for camera, each in found.items()}


def carried_by_a(logged: Drive, t: float) -> list[str]:
    """Cameras that uplink A alone carries at a time."""
    uplinks: dict[str, list[str]] = {}
    for line in logged.sides["vehicle"].of(DecisionMade):
        if line.t < t:
            uplinks |= {each.camera: each.value for each in line.commands if each.knob == "uplinks"}
    return [camera for camera, names in uplinks.items() if list(names) == ["a"]]


def _live_again(over_time: Series, camera: str, began: float) -> float:
    """Time until its first picture that is undamaged, not late, and captured since, s; inf: never.

    A sample counts damaged pictures: those are its first ones.
    """
    got = over_time.cameras[camera].received
    assert got
    shown = pictures(over_time, camera)
    sample = np.searchsorted(got.t, [picture.arrived for picture in shown])
    for place, picture in enumerate(shown):
        number = sample[place]
        if picture.captured < began or number in (0, len(got.t)) or picture.late:
            continue
        damaged = got.damaged[number] - got.damaged[number - 1]
        if (sample[:place] == number).sum() >= damaged:
            return picture.arrived - began
    return float("inf")


def _risen(t: Floats, counter: Floats, since: float, until: float) -> int:
    first, last = np.searchsorted(t, (since, until))
    return int(counter[min(last, len(t) - 1)] - counter[first])


def _held(over_time: Series, lane: str, t: float) -> float:
    link = over_time.links[lane]
    return float(link.kbps[max(0, np.searchsorted(link.t, t, "right") - 1)])


def _decided(over_time: Series, camera: str, t: float) -> float:
    decided = over_time.cameras[camera].decided
    return float(decided.kbps[max(0, np.searchsorted(decided.t, t) - 1)])


def _line(one: Measured) -> str:
    return (
        f"B {one.better:.1f} x, {one.due} due, {one.missing} missing, {one.damaged} damaged, "
        f"after B {_percentiles(one.after_b)} ms, latency {_percentiles(one.latency)} ms, "
        f"others live after {', '.join(f'{wait:.2f}' for wait in one.waits) or '-'} s, {one.late} late"
    )


def _summary(name: str, found: Sequence[Measured]) -> str:
    after_b, latency, waits = ([value for one in found for value in one[column]] for column in (4, 5, 6))
    counts = [str(sum(one[column] for one in found)) for column in (1, 2, 3)]
    late = str(sum(one.late for one in found))
    spans = (_percentiles(after_b), _percentiles(latency), _percentiles(waits, 2))
    return row(name, str(len(found)), *counts, *spans, late)


def _percentiles(values: Sequence[float], digits: int = 0) -> str:
    """p50 / p95 / most."""
    if not values:
        return "-"
    return " / ".join(f"{np.percentile(values, share, method='higher'):.{digits}f}" for share in (50, 95, 100))


# --- both clear -------------------------------------------------------------------------------------------------------


def clear(options: argparse.Namespace) -> None:
    """Print what both uplinks carry of what they could, and their queues, beside one uplink like either."""
    traced = [f"file: {trace.resolve()}" for trace in options.traces]
    pairs = {"4000/4000": ["kbps: 4000"] * 2, "3000/6000": ["kbps: 3000", "kbps: 6000"]} | (
        {"traces": traced} if traced else {}
    )
    print(row("uplinks", "used, %", "queue, p95 ms: a", "b", "one alone, used, %: a", "b", "queue, p95 ms: a", "b"))
    print(row(*["---"] * 8))
    common = [*_words(options), f"duration_s={options.seconds}", *options.set]
    for name, rates in pairs.items():
        path = options.output / f"clear-{name.replace('/', '-')}"
        drive(path, [*common, lanes(*rates)])
        both = read_drive(path)
        alone = []
        for number, rate in enumerate(rates):
            alone_path = path.with_name(f"{path.name}-{'ab'[number]}")
            single = f"link.lanes={{a: {{{rate}, delay_ms: {(20, 35)[number]}}}}}"
            drive(alone_path, [*(word for word in common if word != UPLINKS), single])
            alone.append(read_drive(alone_path))
        used = [_used(one, "a") for one in alone]
        queues = [*(_queue_ms(both, lane) for lane in "ab"), *(_queue_ms(one, "a") for one in alone)]
        print(row(name, f"{_used(both, *'ab'):.0f}", *map("{:.0f}".format, (*queues[:2], *used, *queues[2:]))))


def _samples(logged: Drive, lane: str) -> list[LinkSample]:
    return [each for each in logged.sides["link"].of(LinkSample) if each.lane == lane and each.t > SETTLED_S]


def _used(logged: Drive, *names: str) -> float:
    """What these lanes carried of what they could have, %."""
    could = carried = 0.0
    for samples in (_samples(logged, name) for name in names):
        could += sum(before.kbps * (after.t - before.t) for before, after in pairwise(samples))
        carried += (samples[-1].bytes - samples[0].bytes) * 8 / 1000
    return 100 * carried / could


def _queue_ms(logged: Drive, lane: str) -> float:
    return float(np.percentile([each.queue_ms for each in _samples(logged, lane)], 95))


# --- price ------------------------------------------------------------------------------------------------------------


def price(options: argparse.Namespace) -> None:
    """Print bits and processor time with no, one, three and all cameras redundant, as ratios to none."""
    words = [*COMMON, UPLINKS, f"vehicle={options.vehicle}", f"duration_s={options.seconds}", *options.set]
    words.append(lanes("kbps: 20000", "kbps: 20000"))
    first = options.output / "price-0"
    spent = drive(first, words)
    cameras = sorted(series(read_drive(first)).cameras)
    found = {0: (_bytes(read_drive(first)), spent)}
    for number in sorted({1, 3, len(cameras)}):
        path = options.output / f"price-{number}"
        spent = drive(path, [*words, *(f"cameras.{name}.redundant=true" for name in cameras[:number])])
        found[number] = _bytes(read_drive(path)), spent
    print(*_prices(found), sep="\n")


def _bytes(logged: Drive) -> int:
    return sum(_samples(logged, lane)[-1].bytes for lane in "ab")


def _prices(found: Mapping[int, tuple[int, float]]) -> Iterator[str]:
    yield row("redundant cameras", "bits", "processor time", "ratios to none")
    yield row(*["---"] * 4)
    (size, spent), *_ = found.values()
    for number, (own, own_s) in found.items():
        mbit = own * 8 / 1e6
        yield row(str(number), f"{mbit:.0f} Mbit", f"{own_s:.1f} s", f"{own / size:.2f}, {own_s / spent:.2f}")


if __name__ == "__main__":
    main()
