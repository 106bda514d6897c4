"""The recordings that `model` measures cameras on: named by the user, played by sources, or left by a drive."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from runner.bag import PICTURES, Bag, is_bag
from runner.core.model import BagTopic, Camera, ModelError, Vehicle
from runner.errors import COMMAND_LINE, ArgumentError, ConfigError, Problem, UserError
from runner.settings import Setup
from runner.verbs import Arguments
from runner.verbs.screen import progress_bar, say

if TYPE_CHECKING:
    from runner.drive.read import Drive
    from runner.graph import Plan
    from runner.rate_quality.sequence import Footage

NO_CLIPS = (".json", ".yaml", ".png", ".pdf")  # suffixes of other files named after a camera


def given(arguments: Arguments, setup: Setup, names: Sequence[str]) -> Mapping[str, Sequence[Footage]]:
    """By camera, its clip, or its topic in a bag, as sequence= names it; without it, what its source plays."""
    return {name: [footage] for name, footage in _given(arguments, setup, names).items()}


def _given(arguments: Arguments, setup: Setup, names: Sequence[str]) -> Mapping[str, Footage]:
    path = arguments.path("sequence")
    if path is None:
        return _clips_of_sources(setup, names)
    if is_bag(path):
        return _topics(path, setup.vehicle, names)
    if "camera" in arguments.values and not path.is_dir():
        return {names[0]: path}
    if not path.is_dir():
        rule = "must be a directory with one clip for each camera, named after it; or name one camera with camera="
        raise ArgumentError("sequence", path, rule)
    found: dict[str, Footage] = {}
    problems = []
    for name in names:
        clips = sorted(clip for clip in path.glob(f"{name}.*") if clip.suffix not in NO_CLIPS)
        if len(clips) == 1:
            found[name] = clips[0]
        else:
            rule = f"{len(clips)} files are named {name}.*, must be exactly one"
            problems.append(Problem(COMMAND_LINE, "sequence", repr(str(path)), rule))
    if problems:
        raise ConfigError(problems)
    return found


def _topics(path: Path, vehicle: Vehicle, names: Sequence[str]) -> Mapping[str, Footage]:
    """By camera, its topic in a bag: that of its mount, or the only one with pictures."""
    found: dict[str, Footage] = {}
    problems = []
    for name in names:
        camera = vehicle.cameras[name]
        named = camera.mount.get("topic", camera.source.settings.get("topic"))
        try:
            with Bag(path) as bag:
                topic = bag.find(PICTURES, None if named is None else str(named), "pictures")
            found[name] = BagTopic(str(path), topic, camera.source.depth_m)
        except ModelError as error:
            at = f"cameras.{name}.topic" if error.key == "topic" else "sequence"
            problems.append(Problem(COMMAND_LINE, at, str(error.found), error.rule))
    if problems:
        raise ConfigError(problems)
    return found


def _clips_of_sources(setup: Setup, names: Sequence[str]) -> Mapping[str, Footage]:
    """By camera, the clip or the bag's pictures that its source plays; missing clips are rendered first."""
    found: dict[str, Footage] = {}
    for plan in _plans(setup, names):
        footage = _played(plan)
        if footage is None:
            rule = f"must be given, since the source of {plan.camera.name} plays no clip"
            raise ArgumentError("sequence", None, rule)
        found[plan.camera.name] = footage
    return found


def _plans(setup: Setup, names: Sequence[str]) -> Sequence[Plan]:
    """The plans of cameras; missing clips are rendered first."""
    from runner.plans import compile_plans, render_missing

    measured = setup.with_cameras({name: setup.vehicle.cameras[name] for name in names})
    with progress_bar() as progress:
        render_missing(measured.vehicle, progress)
    return compile_plans(measured)


def _played(plan: Plan) -> Footage | None:
    """The clip or the bag's pictures that a source plays; None: neither."""
    if plan.bag:
        return plan.bag
    clip = next((e.properties["location"] for e in plan.source if "location" in e.properties), None)
    return Path(str(clip)) if clip is not None and plan.loops else None


# --- of a drive -------------------------------------------------------------------------------------------------------


def of_drive(drive: Drive, setup: Setup, names: Sequence[str]) -> Mapping[str, Sequence[Footage]]:
    """By camera, what a drive has of its whole image; says what that is, and which cameras are left out.

    First what the vehicle has kept without loss, then what `record` has kept in the directory of the drive, then what
    the source played, then the video as sent.

    raises  UserError if no camera can be measured
    """
    kept, recorded = _kept(drive), _recorded(drive.path)
    others = [name for name in names if name not in kept]
    played = {plan.camera.name: _played(plan) for plan in _plans(setup, others) if plan.bag or plan.loops}
    found: dict[str, Sequence[Footage]] = {}
    lacking = []
    for name in names:
        if parts := kept.get(name):
            found[name] = parts
            say(f"{name}: measured on {', '.join(each.name for each in parts)}, kept without loss while driving")
            continue
        footage: Footage | None = recorded.get(name)
        what = f"{recorded[name].name}, recorded without loss" if name in recorded else "what its source played"
        if footage is None:
            footage = _existing(played.get(name))
        if footage is None:
            sent = _sent_whole(drive, setup.vehicle.cameras[name])
            if isinstance(sent, str):
                lacking.append(f"{name}: {sent}")
                continue
            footage, what = sent, f"{sent.name}, as sent: second best, since it is already compressed"
        found[name] = [footage]
        say(f"{name}: measured on {what}")
    if not found:
        how = "keep some with log.lossless or `tod-runner record`"
        rule = f"has no whole pictures of its cameras ({'; '.join(lacking)}): {how}"
        raise UserError(str(drive.path), "", None, rule)
    for line in lacking:
        say(f"{line}: left out")
    return found


def _kept(drive: Drive) -> Mapping[str, list[Path]]:
    """By camera, the files with whole pictures that the vehicle has kept; says which are too short."""
    from runner.clips import cache_directory
    from runner.rate_quality.cache import Cache
    from runner.rate_quality.sequence import ARGUMENT, survey
    from runner.records.lines import LosslessBegan

    cache = Cache(cache_directory() / "points", say)
    found: dict[str, list[Path]] = {}
    for line in drive.sides["vehicle"].of(LosslessBegan) if "vehicle" in drive.sides else ():
        path = drive.path / line.file
        if not path.resolve().is_relative_to(drive.path.resolve()) or not path.exists():
            continue  # a drive may come from anyone, and its user may have removed parts
        try:
            survey(path, cache, say)
        except UserError as error:
            say(f"{str(error).removeprefix(f'{COMMAND_LINE}: {ARGUMENT}: ')}: left out")
            continue
        found.setdefault(line.camera, []).append(path)
    return found


def _existing(footage: Footage | None) -> Footage | None:
    path = Path(footage.path) if isinstance(footage, BagTopic) else footage
    return footage if path is not None and path.exists() else None


def _recorded(directory: Path) -> Mapping[str, Path]:
    """By camera, the file that `record` has kept there."""
    from runner.rate_quality.recordings import INDEX, final

    try:
        names = list(json.loads((directory / INDEX).read_text(encoding="utf-8"))["cameras"])
    except (OSError, ValueError, LookupError, TypeError):
        return {}
    return {name: path for name in names if (path := final(directory, str(name))).is_file()}


def _sent_whole(drive: Drive, camera: Camera) -> Path | str:
    """The longest file of a camera's video as sent in which all pictures show the whole image at its full size.

    returns  why there is none, in words
    """
    from runner.apply import decode_video, discover
    from runner.drive.captures import files
    from runner.errors import RunError

    if "vehicle" not in drive.sides or camera.name not in (kept := files(drive.sides["vehicle"])):
        return "its video was not kept (log.video=true)"
    if _is_cropped(drive, camera):
        return "only parts of its image were sent at times"
    best, most, smallest = None, 0, (camera.width, camera.height)
    for file in kept[camera.name]:
        if file.is_outside:
            continue
        try:
            sizes = [luma.shape[::-1] for _, luma in decode_video(drive.path / file.name, None)]
        except RunError as error:
            return str(error)
        smallest = min([smallest, *((width, height) for width, height in sizes)])
        if len(sizes) > most and set(sizes) == {(camera.width, camera.height)}:
            best, most = drive.path / file.name, len(sizes)
    if best is None:
        return f"was sent at {smallest[0]}x{smallest[1]} px at times, its image has {camera.width}x{camera.height}"
    try:
        discover(best, best.name)
    except ArgumentError:  # some cameras that encode by themselves state no rate
        return f"{best.name} states no frame rate"
    return best


def _is_cropped(drive: Drive, camera: Camera) -> bool:
    """Whether the rules have ever sent a part of the image only."""
    from runner.records.decisions import DecisionMade

    decisions = drive.sides["vehicle"].of(DecisionMade)
    cameras = (line.cameras[camera.name] for line in decisions if camera.name in line.cameras)
    return any(own.sending and own.roi != camera.full_roi for own in cameras)
