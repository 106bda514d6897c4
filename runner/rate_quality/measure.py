"""Measure the rate-quality models of some cameras, one after the other, and write them to files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING

from runner.clips import cache_directory
from runner.core.model import Camera, ModelError, Progress, Vehicle
from runner.errors import ArgumentError, RunError, os_errors_as
from runner.graph import compile_graph
from runner.lanes import Lane, cut, fragment
from runner.rate_quality import plans
from runner.rate_quality.artefact import MARK, Measured, dumps, to_json, to_yaml
from runner.rate_quality.cache import Cache, file_digest
from runner.rate_quality.choice import WHOLE, Choice, ChoiceCriteria, choose, choose_shown, pooled
from runner.rate_quality.curves import Point, mean_score
from runner.rate_quality.metrics import Metric, find_metric
from runner.rate_quality.metrics.reduced import fits, name_at, reduced
from runner.rate_quality.rates import (
    RatePoint,
    Rates,
    compared,
    every_nth,
    rate_lanes,
    rate_points,
    rate_stride,
    rate_table,
)
from runner.rate_quality.sequence import Footage, as_recorded, survey
from runner.rate_quality.sequence import Sequence as Clip
from runner.rate_quality.study import Study, check_size, stride
from runner.rate_quality.sweep import Sweep
from runner.rate_quality.workers import open_executor, parallel_tasks
from runner.settings import Setup
from runner.system.files import file_problem, write_whole

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from runner.rate_quality.metrics import Mask

FILES = (".yaml", ".model.json", ".png", ".pdf")  # of a model, by the ends of their names
LATER_ROUNDS = 0.3  # work that the adaptive plan is expected to add, as a share of the first round's


def measure(
    setup: Setup,
    study: Study,
    sequences: Mapping[str, Sequence[Footage]],
    output: Path,
    progress: Progress,
    on_note: Callable[[str], None],
) -> Iterator[str]:
    """Measure and write models; yields a line for each.

    sequences  by camera, its clips, or pictures of a bag
    raises     UserError for input that cannot be measured, RunError if a run fails; finished models stay
    """
    metrics = tuple(_metric(study, name) for name in study.metrics)
    cache = Cache(cache_directory() / "points", on_note)
    alone = {name: (name,) for name in sequences if not any(name in members for members in study.pool.values())}
    models = {**alone, **study.pool}
    footage = [clip for own in sequences.values() for clip in own]
    inputs = [*study.masks.values(), *(clip for clip in footage if isinstance(clip, Path))]
    _check_output(output, models, inputs)
    clips = {name: [survey(clip, cache, on_note) for clip in own] for name, own in sequences.items()}
    parallel = parallel_tasks(study.parallel)
    with open_executor(study.workers, study.scheduler, parallel) as executor:
        for model, members in models.items():
            screens = _screens(study, [setup.vehicle.cameras[name] for name in members], metrics[0])
            every = (*metrics, *(reduced(metrics[0], factor) for factor in screens))
            sweeps = [
                _sweep(setup, study, name, clip, every, cache, executor, parallel)
                for name in members
                for clip in clips[name]
            ]
            measured = _measure(model, setup.vehicle, study, sweeps, metrics, screens, progress)
            yield _write(measured, output, sweeps)


def _screens(study: Study, cameras: Sequence[Camera], deciding: Metric) -> tuple[Fraction, ...]:
    """Factors of the image's size at which the deciding metric also scores what a screen shows."""
    if deciding.every_frame or not deciding.higher_is_better:
        return ()
    sizes = [(camera.width, camera.height) for camera in cameras]
    return tuple(each for each in study.screens if all(fits(size, each, deciding) for size in sizes))


def _check_output(output: Path, models: Iterable[str], inputs: Iterable[Path]) -> None:
    """Check before hours of work that models can be written there and would overwrite only models.

    raises  UserError
    """
    wrong = partial(ArgumentError, "output", output)
    with os_errors_as(lambda why: wrong(f"cannot be written to: {why}")):
        output.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=output).close()
    read = {path.resolve() for path in inputs}
    for model in models:
        paths = [output / f"{model}{end}" for end in FILES]
        replaceable = paths[0].is_file() and MARK in paths[0].read_text(encoding="utf-8", errors="replace")
        for path in filter(Path.exists, paths):
            if path.resolve() in read:
                raise ArgumentError("output", path, "is an input; choose another directory")
            if not replaceable:
                rule = "exists and was not written by tod-runner model; choose another directory"
                raise ArgumentError("output", path, rule)


def _metric(study: Study, name: str) -> Metric:
    return find_metric(
        name,
        brisque_model=study.brisque_model,
        brisque_range=study.brisque_range,
        vmaf_model=study.vmaf_model,
    )


def _sweep(
    setup: Setup,
    study: Study,
    name: str,
    clip: Clip,
    metrics: tuple[Metric, ...],
    cache: Cache,
    executor: Executor,
    parallel: int,
) -> Sweep:
    from runner.apply import versions

    camera, _ = as_recorded(setup.vehicle.cameras[name], clip)
    try:
        check_size(study, camera)
    except ModelError as error:
        raise ArgumentError(error.key, str(error.found), error.rule) from None
    plan = compile_graph(camera, setup.media)
    roi = camera.in_source
    before, after = cut(plan)
    mask = study.masks.get(name)
    key_interval = round((camera.graph.settings.key_interval_s or 0) * float(camera.fps))
    return Sweep(
        name=name,
        clip=clip,
        plan=plan,
        roi=roi,
        metrics=metrics,
        stride=stride(study, clip.frames, key_interval),
        mask=_read_mask(mask, name, camera) if mask else None,
        mask_digest=file_digest(mask) if mask else "",
        encoder=versions((*before, *after)),
        cache=cache,
        executor=executor,
        parallel=parallel,
    )


def _read_mask(path: Path, name: str, camera: Camera) -> Mask:
    """A picture of the camera's size whose black pixels do not count.

    raises  UserError
    """
    import cv2

    where = f"masks.{name}"
    why = file_problem(path)
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if why is None else None
    if picture is None:
        raise ArgumentError(where, path, why or "cannot be read as a picture")
    if picture.shape != (camera.height, camera.width):
        found = f"{picture.shape[1]}x{picture.shape[0]}"
        raise ArgumentError(where, found, f"must be {camera.width}x{camera.height}, as the full image is")
    mask: Mask = picture > 127
    if not mask.any():
        raise ArgumentError(where, path, "is all black: no pixel would count")
    return mask


def _measure(
    name: str,
    vehicle: Vehicle,
    study: Study,
    sweeps: Sequence[Sweep],
    metrics: tuple[Metric, ...],
    screens: tuple[Fraction, ...],
    progress: Progress,
) -> Measured:
    deciding = metrics[0]
    sign = 1 if deciding.higher_is_better else -1
    criteria = ChoiceCriteria(
        metric=deciding.name,
        sign=sign,
        tolerance=deciding.tolerance if study.tolerance is None else study.tolerance,
        narrowest=study.narrowest,
        good=deciding.good if study.b_full_quality is None else study.b_full_quality,
        cores=study.cpu_cores,
        fps=sweeps[0].plan.camera.fps,
    )
    try:
        shown = {factor: replace(criteria, metric=name_at(deciding.name, factor)) for factor in screens}
        points = _points(study, [criteria, *shown.values()], sweeps, lambda share: progress(name, share))
        choice = choose(points, criteria)
        choice = replace(choice, shown={at: choose_shown(points, its, choice.b_full) for at, its in shown.items()})
    except ValueError as error:
        raise RunError(f"{name}: {error}") from None
    first = sweeps[0]
    rates = _rates(study, vehicle, choice, sweeps, deciding, lambda share: progress(f"{name}, rates", share))
    lane = Lane(study.scalings[0], study.rates[0])
    text = fragment(first.plan, first.plan.camera.full_roi, lane)
    return Measured(
        name=name,
        camera=vehicle.cameras[first.name],
        clips=dict(_named(sweeps)),
        masks={sweep.name: sweep.mask_digest for sweep in sweeps if sweep.mask_digest},
        encoder={"graph": text, "versions": first.encoder},
        metrics={metric.name: metric.identity for metric in metrics},
        labels={metric.name: metric.label for metric in metrics},
        metric=deciding.name,
        sign=sign,
        good=criteria.good,
        plan=study.plan,
        stride=first.stride,
        points=points,
        choice=choice,
        rates=rates,
        notes=list(dict.fromkeys(n for sweep in sweeps for n in _notes(vehicle.cameras[sweep.name], sweep.clip))),
    )


def _named(sweeps: Sequence[Sweep]) -> Iterator[tuple[str, Clip]]:
    """Clips by camera; the second and further ones of a camera are numbered."""
    for camera, own in groupby(sweeps, lambda sweep: sweep.name):
        for number, sweep in enumerate(own, 1):
            yield camera if number == 1 else f"{camera} {number}", sweep.clip


def _rates(
    study: Study,
    vehicle: Vehicle,
    choice: Choice,
    sweeps: Sequence[Sweep],
    metric: Metric,
    on_progress: Callable[[float], None],
) -> Rates:
    """Quality with fewer pictures a second, at the rates of the study, otherwise at those in the camera's file."""
    camera = sweeps[0].plan.camera
    every = every_nth(camera, study.fps or tuple(vehicle.cameras[sweeps[0].name].rate_quality.rates))
    if not every:
        return {}
    if metric.every_frame or metric.name not in WHOLE:
        raise ArgumentError("fps", metric.name, "needs metric=mssim: rates are compared by a quality of 0 to 1")
    step = rate_stride(sweeps[0].stride, every)
    own = [replace(sweep, stride=step, metrics=(metric,), _keys={}) for sweep in sweeps]
    found: dict[Fraction, dict[int, RatePoint]] = {}
    part = 1 / len(every) / len(own)
    for number, nth in enumerate(every):
        lanes = rate_lanes(choice, study.rates, nth)
        begun = number * len(own)
        groups = [sweep.measure(lanes, _rising(on_progress, (begun + at) * part, part)) for at, sweep in enumerate(own)]
        found[camera.fps / nth] = rate_points(metric.name, groups, nth, step)
    on_progress(1.0)
    return compared(found)


def _points(
    study: Study, criteria: Sequence[ChoiceCriteria], sweeps: Sequence[Sweep], on_progress: Callable[[float], None]
) -> list[Point]:
    """Points of one model, round by round, until its plan requests no more."""
    groups: list[list[Point]] = [[] for _ in sweeps]
    done = expected = 0.0
    while lanes := _next(study, criteria, pooled(groups)):
        cost = float(sum(lane.scaling**2 for lane in lanes)) * len(sweeps)
        later = LATER_ROUNDS * cost if study.plan == "adaptive" and not done else 0.0
        expected = max(expected, done + cost + later)
        for index, sweep in enumerate(sweeps):
            part = cost / len(sweeps)
            groups[index] += sweep.measure(lanes, _rising(on_progress, done / expected, part / expected))
            done += part
    on_progress(1.0)
    return pooled(groups)


def _rising(on_progress: Callable[[float], None], begun: float, part: float) -> Callable[[float], None]:
    """A callback that converts progress of a part to progress of the whole; the caller reports the end."""
    return lambda share: on_progress(min(0.99, begun + part * share))


def _next(study: Study, criteria: Sequence[ChoiceCriteria], points: Sequence[Point]) -> list[Lane]:
    if study.plan == "full":
        return plans.full(study.scalings, study.rates, points)
    scores = [mean_score(each.metric, each.sign) for each in criteria]
    every = (criteria[0].tolerance, criteria[0].narrowest)
    return plans.adaptive(study.scalings, study.rates, points, scores, *every)


def _notes(camera: Camera, clip: Clip) -> Iterator[str]:
    if not clip.lossless:
        yield f"{Path(clip.path).name} is already compressed with loss ({clip.codec}): high scores are overestimated"
    _, form = as_recorded(camera, clip)
    if form:
        yield form


def _write(measured: Measured, output: Path, sweeps: Sequence[Sweep]) -> str:
    """Write all files of a model; returns the line that reports them."""
    from runner.rate_quality.plots import plot

    # The YAML first: its mark lets the next run replace the others, see `_check_output`.
    write_whole(output / f"{measured.name}.yaml", to_yaml(measured).encode())
    write_whole(output / f"{measured.name}.model.json", dumps(to_json(measured)))
    plot(measured, output / measured.name)
    choice = measured.choice
    pairs = zip(choice.scaling, choice.b_min, strict=True)
    ladder = ", ".join(f"{float(factor):g} from {bound}" for factor, bound in pairs)
    encoded, found = (sum(getattr(sweep, key) for sweep in sweeps) for key in ("encoded", "found"))
    head = f"{output / measured.name}.yaml: {ladder}, b_full {choice.b_full} kbit/s"
    lines = [*measured.warnings, *rate_table(measured.rates)]
    return "\n".join([f"{head} ({encoded} encoded, {found} known)", *(f"  {line}" for line in lines)])
