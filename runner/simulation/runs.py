"""Many simulated drives, each described in words that reach a worker process."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from runner.configuration.config import Configuration, configuration
from runner.configuration.files import conf_directories
from runner.configuration.rule_lists import rule_of
from runner.core.model import Kbps, Mode, ModelError
from runner.errors import ArgumentError, suggest
from runner.link.limit import Limit, OneWay
from runner.link.losses import LossModel
from runner.link.policer import Policer
from runner.pqos import Predictions
from runner.pqos.settings import find_file, find_path
from runner.simulation.drive import Conditions, Drive, Recorder, Simulation
from runner.simulation.families import FAMILIES, LEFT_OUT, generate, is_family
from runner.simulation.figures import SETTLED_S, Figures, figures
from runner.simulation.predictions import KINDS, prediction
from runner.simulation.queues import KBIT, OPPORTUNITY_BYTES, CreditQueue, OpportunityQueue, Queue, RateQueue
from runner.simulation.steps import Steps
from runner.simulation.way import Link

CONFIGURED = "configured"  # the link, or the predictions, of the configuration
OPPORTUNITIES = {".up", ".down", ".pps"}  # names of files with opportunities to send
BESIDE = "+"  # between links of several uplinks
SEEDS = 1_000_000  # between those of generated links of several uplinks
DURATION_S = 60.0
MARGIN_S = 5.0  # of a link behind the end of a drive: predictions look ahead
# Without link=, of links by name: as wide as their name or file says, and 30 ms of round trip.
UNNAMED_LINK = (
    *("link=netns", "link.share=1", "link.queue_ms=300", "link.delay_ms=15"),
    "link.reverse={kbps: 100000, queue_ms: 300, delay_ms: 15}",
)
Limits = Mapping[str, Limit]  # by uplink; "": there is one, without a name
LEAST_KBPS = 500.0  # windows of a trace in which the link carries less on average are left out


class Scheduler(NamedTuple):
    """See `runner.simulation.queues.CreditQueue`."""

    peak: float
    credit_ms: float
    grant_ms: float


@dataclass(frozen=True)
class Common:
    """What all drives of a command have in common.

    overrides, conf  of the configuration
    duration_s       of each drive; None: as its experiment says, or DURATION_S
    slot_ms, bursts  see `runner.simulation.queues.RateQueue`
    scheduler        in place of that; None: none
    since_s          from when on a drive counts
    """

    overrides: tuple[str, ...]
    conf: Path | None
    duration_s: float | None = None
    conditions: Conditions = field(default_factory=Conditions)
    slot_ms: float = 0.0
    bursts: bool = True
    scheduler: Scheduler | None = None
    since_s: float = SETTLED_S


class Job(NamedTuple):
    """One drive.

    link        a family, a file, the directory of a drive, or CONFIGURED
    begin_s     of the link's window
    prediction  one of KINDS, or CONFIGURED
    run, words  name of the experiment's run, and the overrides that it adds
    """

    link: str
    begin_s: float
    prediction: str
    seed: int
    duration_s: float = DURATION_S
    run: str = ""
    words: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Of its directory among others."""
        return f"{self.link_name}-{self.begin_s:g}-{self.prediction}-{self.seed}"

    @property
    def link_name(self) -> str:
        return self.run or "+".join(part if is_family(part) else Path(part).stem for part in self.parts)

    @property
    def parts(self) -> list[str]:
        """The links of several uplinks, in order; the last is that of all others, too."""
        return self.link.split(BESIDE)


class Result(NamedTuple):
    """A job's figures; took_s: processor time; drive: what happened, where it was asked for; uplinks: their number."""

    job: Job
    figures: Figures
    took_s: float
    drive: Drive | None
    uplinks: int = 1

    def to_json(self) -> dict[str, Any]:
        return {**self.job._asdict(), "took_s": round(self.took_s, 3), **self.figures}


def jobs(
    common: Common, links: Sequence[str], predictions: Sequence[str], seeds: Sequence[int], windows: int
) -> list[Job]:
    """All combinations.

    windows  of each file, at most; links that are generated have one
    raises   ArgumentError, ConfigError
    """
    for kind in predictions:
        if kind not in (*KINDS, CONFIGURED):
            raise ArgumentError("predictions", repr(kind), f"unknown{suggest(kind, (*KINDS, CONFIGURED))}")
    found = []
    for link in links:
        for each in _of_link(common, link, windows):
            found += [each._replace(prediction=kind, seed=seed) for kind in predictions for seed in seeds]
    return found


def _of_link(common: Common, link: str, windows: int) -> list[Job]:
    """Drives over one link: windows of a file, or runs of an experiment."""
    job = Job(link, 0.0, "", 0, DURATION_S if common.duration_s is None else common.duration_s)
    if link == CONFIGURED:
        runs = _composed(common, job)[0].experiment().runs or {"": ()}
        return [_timed(common, job._replace(run=name, words=words)) for name, words in runs.items()]
    if is_family(job.parts[0]):
        return [job]
    return [job._replace(begin_s=begin) for begin in _windows(common, job, windows)]


def _timed(common: Common, job: Job) -> Job:
    """A run of an experiment, with its own duration."""
    config = _composed(common, job)[0]
    timed = common.duration_s is None and "experiment" in config.document
    return job._replace(duration_s=config.experiment().duration_s) if timed else job


def _windows(common: Common, job: Job, most: int) -> list[float]:
    """Where windows of a file begin, evenly taken from those in which the link carries something."""
    rates, length = _file(job.parts[0], common.conf)[0], job.duration_s
    begins = [begin * length for begin in range(int((rates.times[-1] + 1) / length))] or [0.0]
    usable = [begin for begin in begins if rates.mean(begin, begin + length) >= LEAST_KBPS]
    return [usable[i * len(usable) // most] for i in range(most)] if len(usable) > most else usable or begins[:1]


@lru_cache(maxsize=16)
def _file(name: str, conf: Path | None) -> tuple[Steps, tuple[float, ...]]:
    """The rates of a file or a drive, as long as it lasts, and its opportunities to send, s, if it has such.

    raises  UserError
    """
    named, bases = {"file": name}, [*conf_directories(conf), Path.cwd()]
    try:
        if find_path(named, "file", bases).is_dir():
            return _driven(find_path(named, "file", bases)), ()
        path = find_file(named, "file", bases)
        if path.suffix in OPPORTUNITIES:
            return _opportunities(path)
        from runner.pqos.table import RATE, TIME, read_table

        times, rates = read_table(path, (TIME, RATE)).T.tolist()
    except ModelError as error:
        hint = f"; or a family: {', '.join((*FAMILIES, *LEFT_OUT))}" if "no such" in error.rule else ""
        raise ArgumentError("links", error.found or name, error.rule + hint) from None
    return _from_zero(times, rates), ()


def _driven(directory: Path) -> Steps:
    """The rates of the limited link of a drive."""
    from runner.drive.read import read_link

    samples = read_link(directory)
    return _from_zero([sample.t for sample in samples], [sample.kbps for sample in samples])


def _from_zero(times: Sequence[float], rates: Sequence[float]) -> Steps:
    return Steps([t - times[0] for t in times], rates)


def _opportunities(path: Path) -> tuple[Steps, tuple[float, ...]]:
    """A recording of mahimahi: in each line the ms of an opportunity to send 1500 bytes. The rate is that of a second.

    raises  ModelError
    """
    lines = path.read_text(encoding="utf-8", errors="replace").split()
    wrong = next((number for number, line in enumerate(lines, 1) if not line.isdecimal()), None)
    if wrong or not lines:
        found = f"{path}:{wrong}: {lines[wrong - 1]}" if wrong else str(path)
        raise ModelError("file", found, "must have a time in whole ms in each line, rising")
    times = tuple(sorted(int(line) / 1000 for line in lines))
    counts = [0] * (int(times[-1]) + 1)
    for t in times:
        counts[int(t)] += 1
    return Steps(range(len(counts)), [count * OPPORTUNITY_BYTES * KBIT for count in counts]), times


def _composed(common: Common, job: Job) -> tuple[Configuration, Limits]:
    """The configuration of a job, and its links by uplink; rates of links are those of CONFIGURED only, or a lane's."""
    return _compose((*_link_words(common), *common.overrides, *job.words), common.conf, job.link == CONFIGURED)


@lru_cache(maxsize=64)
def _compose(words: tuple[str, ...], conf: Path | None, configured: bool) -> tuple[Configuration, Limits]:
    from runner.configuration.experiment import lane_of

    config = configuration(words, conf, runnable=False)
    link = config.link(None if configured else lambda _: Kbps(0), simulated=True)
    if link is None:
        raise ArgumentError("link", "null", "must not be null: it describes the link that is simulated")
    uplinks = config.document["uplinks"]
    if link.lanes and not uplinks:
        rule = "must be null without uplinks: nothing would use but the first lane"
        raise ArgumentError("link.lanes", ", ".join(link.lanes), rule)
    lanes = {name: lane_of(config.document, name) for name in uplinks}
    return config, {name: link.lanes[lane] if lane else link.limit for name, lane in lanes.items()} or {"": link.limit}


def _link_words(common: Common) -> tuple[str, ...]:
    return () if any(word.startswith(("link=", "+link=", "experiment=")) for word in common.overrides) else UNNAMED_LINK


def check(common: Common, wanted: Iterable[Job]) -> None:
    """raises ConfigError, ArgumentError if a configuration is wrong"""
    for job in wanted:
        config, _ = _composed(common, job)
        if job.prediction == CONFIGURED:
            config.pqos()
        config.experiment()


def rules_in_force(common: Common, wanted: Iterable[Job]) -> tuple[Mapping[str, Any], list[Mode]]:
    """The modes file of the first drive, and the modes that drives are in: as configured, and as an experiment selects.

    raises  ArgumentError if runs of an experiment have other rules, not only other numbers
    """
    configs = [_composed(common, job)[0] for job in wanted]
    files = [config.document["modes"] for config in configs]
    names = [{mode: [(n, rule_of(n, entry)) for n, entry in file[mode].items()] for mode in Mode} for file in files]
    if any(rules != names[0] for rules in names):
        raise ArgumentError("experiment", None, "its runs follow different rules; name the rules and the links instead")
    requests = [request.event for config in configs for request in config.experiment().requests]
    selected = {config.document["mode"] for config in configs}
    selected |= {event["mode"] for event in requests if event["event"] == "mode_selected"}
    return files[0], [mode for mode in Mode if mode in selected]


def run_job(common: Common, job: Job, keep: bool = False, log: tuple[Path, float] | None = None) -> Result:
    """Simulate one drive.

    keep  return what happened, too
    log   directory in which it is logged, and when it began, s since 1970
    """
    config, limits = _composed(common, job)
    began = time.process_time()
    capacities = {n: _capacity(common, job, n, number) for number, n in enumerate(limits)}
    if job.prediction == CONFIGURED:
        seen, _ = config.pqos()
    else:
        each = capacities.items()
        seen = Predictions({n: prediction(job.prediction, own, job.duration_s, job.seed) for n, own in each})
    requests, setup = config.experiment().requests, config.setup()
    ways = {n: _link(common, job, number, limits[n], capacities[n]) for number, n in enumerate(limits)}
    with _recorder(common, job, log) as recorder:
        drive = Simulation(setup, ways, seen, job.duration_s, common.conditions, job.seed, recorder, requests).run()
    return Result(job, figures(drive, common.since_s), time.process_time() - began, drive if keep else None, len(ways))


@contextmanager
def _recorder(common: Common, job: Job, log: tuple[Path, float] | None) -> Iterator[Recorder]:
    """Writes the drive, which exists only when it is complete."""
    if log is None:
        yield Recorder()
        return
    from runner.simulation.log import DriveFiles

    config, _ = _composed(common, job)
    note = f"simulated: link {job.link} from {job.begin_s:g} s, prediction {job.prediction}, seed {job.seed}"
    files = DriveFiles(log[0], config.vehicle(), config.document, log[1], note)
    try:
        yield files
    except BaseException:
        files.discard()
        raise
    files.close()


def _capacity(common: Common, job: Job, uplink: str, number: int) -> Steps:
    """Of the link of an uplink, the first of which has number 0."""
    duration_s, (config, limits) = job.duration_s + MARGIN_S, _composed(common, job)
    if job.link == CONFIGURED or _has_own_rate(config.document, uplink):
        return Steps.of(limits[uplink].kbps_at, duration_s)
    link = _part(job, number)
    rates = (
        generate(link, job.seed + SEEDS * number, duration_s)
        if is_family(link)
        else _file(link, common.conf)[0].moved(job.begin_s)
    )
    share = _lane(config.document, uplink).get("share", config.document["link"]["share"])
    return Steps(rates.times, [float(share) * rate for rate in rates.values])


def _part(job: Job, number: int) -> str:
    return job.parts[min(number, len(job.parts) - 1)]


def _has_own_rate(document: Mapping[str, Any], uplink: str) -> bool:
    """Whether the lane of an uplink states a rate."""
    lane = _lane(document, uplink)
    return bool(lane.get("file") or lane.get("kbps"))


def _lane(document: Mapping[str, Any], uplink: str) -> Mapping[str, Any]:
    """What the lane of an uplink states; nothing if it has none."""
    from runner.configuration.experiment import lane_of

    lane = lane_of(document, uplink) if uplink else None
    own: Mapping[str, Any] = document["link"]["lanes"][lane] if lane else {}
    return own


def _link(common: Common, job: Job, number: int, limit: Limit, capacity: Steps) -> Link:
    """The link that the configuration describes, with this capacity; number: of its uplink."""
    back, seed = limit.reverse, job.seed + SEEDS * number
    return Link(
        capacity,
        _queue(common, job, number, limit, capacity),
        one_way_s=limit.delay_ms / 1000,
        back_s=back.delay_ms / 1000 if back else 0.0,
        delay_at=_in_seconds(limit),
        back_at=_in_seconds(back) if back else None,
        losses=LossModel(limit.loss, limit.burst, seed) if limit.loss else None,
        back=RateQueue(Steps.of(back.kbps_at, job.duration_s), back.queue_ms) if back else None,
        back_losses=LossModel(back.loss, back.burst, seed) if back and back.loss else None,
        tcp=limit.tcp,
        cuts=[cut for cut in limit.cuts if cut.how != "address"],
    )


def _queue(common: Common, job: Job, number: int, limit: Limit, capacity: Steps) -> Queue:
    policer = Policer(*limit.policer) if limit.policer else None
    link = _part(job, number)
    times = () if link == CONFIGURED or is_family(link) else _file(link, common.conf)[1]
    if times:
        end = job.begin_s + job.duration_s + MARGIN_S
        within = [t - job.begin_s for t in times if job.begin_s <= t < end]
        return OpportunityQueue(within, limit.queue_ms, policer)
    slot_s = common.slot_ms / 1000
    if common.scheduler:
        peak, credit_ms, grant_ms = common.scheduler
        return CreditQueue(
            capacity,
            limit.queue_ms,
            peak=peak,
            credit_s=credit_ms / 1000,
            grant_s=grant_ms / 1000,
            slot_s=slot_s,
            policer=policer,
        )
    return RateQueue(capacity, limit.queue_ms, bursts=common.bursts, slot_s=slot_s, policer=policer)


def _in_seconds(way: OneWay) -> Callable[[float], float] | None:
    delay_at = way.delay_at
    return (lambda t: delay_at(t) / 1000) if delay_at else None
