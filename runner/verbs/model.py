"""usage: tod-runner model [OVERRIDE ...] camera=NAME sequence=CLIP output=DIR
       tod-runner model [OVERRIDE ...] vehicle=NAME sequence=DIR output=DIR
       tod-runner model compare A.model.json B.model.json

Measures rate-quality models: each recorded sequence is scaled, encoded by the live graph's own encoder at constant
bitrates, decoded, scaled up again and compared with the original. Writes for each camera DIR/CAMERA.yaml, ready for
conf/cameras/, DIR/CAMERA.model.json with every point, and the curves as .png and .pdf.

camera= is a camera of the vehicle, or a kind in conf/cameras/; without it all cameras of the vehicle are measured,
and sequence= is a directory with one clip for each, named after it. sequence= may also be a ROS bag: each camera is
measured on its topic. Without sequence= the source's own clips are used.
The method is defined in conf/study/paper.yaml; its keys may be given without study.: metric= plan= scalings=
bitrates_kbps= b_full_quality= cpu_cores= pool= masks= metric_every= workers= and others.

Measurements are cached by content in the user's cache directory: an interrupted run resumes where it stopped.

  tod-runner model camera=front_center sequence=drive.mp4 output=models
  tod-runner model camera=front_center sequence=drive.mp4 output=models 'metric=[mssim,psnr]' plan=full
  tod-runner model vehicle=tum_q7 sequence=recording/ output=models 'pool={front_side:[front_left,front_right]}'
  tod-runner model vehicle=tum_q7 source=synthetic output=models graph=openh264_rtsp
  tod-runner model camera=front_left sequence=drive.mcap cameras.front_left.topic=/left/image_raw output=models
  tod-runner model camera=top_left sequence=top.mkv output=models masks.top_left=mask.png cpu_cores=0.3
  tod-runner model compare models/front_center.model.json models_new/front_center.model.json
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from runner.bag import PICTURES, Bag, is_bag
from runner.configuration.config import configuration
from runner.configuration.files import conf_directories, options
from runner.core.model import BagTopic, ModelError, Vehicle
from runner.errors import COMMAND_LINE, ArgumentError, ConfigError, Problem, suggest
from runner.settings import Setup
from runner.system import signals
from runner.system.extras import require
from runner.verbs import Arguments, study_word
from runner.verbs.screen import progress_bar, say, streaming

if TYPE_CHECKING:
    from runner.rate_quality.sequence import Footage
    from runner.rate_quality.study import Study

NO_CLIPS = (".json", ".yaml", ".png", ".pdf")  # suffixes of other files named after a camera


def run(arguments: Arguments) -> int:
    streaming()
    require("model")
    output = arguments.given_path("output", "the directory to write models to")
    setup, study, names = _targets(arguments)
    paths = _sequences(arguments, setup, names)
    from runner.rate_quality.measure import measure

    with progress_bar() as progress, signals.interruptible():
        for written in measure(setup, study, {name: paths[name] for name in names}, output, progress, say):
            print(written)
    return 0


def compare(words: Sequence[str]) -> int:
    """The verb's second form: how two model files differ."""
    from runner.rate_quality.artefact import read_model
    from runner.rate_quality.compare import compare as differences

    if len(words) != 2:
        raise ArgumentError("model compare", f"{len(words)} files", "must be two: A.model.json B.model.json")
    before, after = (read_model(Path(word)) for word in words)
    print("\n".join(differences(before, after)))
    return 0


def _targets(arguments: Arguments) -> tuple[Setup, Study, list[str]]:
    """The vehicle, the study, and the cameras to measure; a kind of camera that the vehicle lacks is mounted."""
    from runner.apply import check_plan
    from runner.rate_quality.study import check_cameras

    words = [study_word(word) for word in arguments.overrides]
    requested = arguments.values.get("camera")
    config = configuration(words, arguments.conf, runnable=False, check=check_plan)
    study, setup = config.study(), config.setup()
    if requested and requested not in setup.vehicle.cameras:
        kinds = options("cameras", conf_directories(arguments.conf))
        if requested not in kinds:
            hint = suggest(requested, [*setup.vehicle.cameras, *kinds])
            raise ArgumentError("camera", repr(requested), f"is neither mounted nor a kind of camera{hint}")
        words.append(f"+cameras@cameras.{requested}={requested}")
        config = configuration(words, arguments.conf, runnable=False, check=check_plan)
        study, setup = config.study(), config.setup()
    names = [requested] if requested else list(setup.vehicle.cameras)
    for name in names:
        own, used = config.document["cameras"][name]["fps"], setup.vehicle.cameras[name].fps
        if float(used) < own - 1e-6:  # not 30000/1001, which is written as 29.97...
            say(f"{name}: fps_max limits its {own:g} Hz to {float(used):g}, which its file will state")
    try:
        check_cameras(study, names)
    except ModelError as error:
        raise ArgumentError(error.key, str(error.found), error.rule) from None
    return setup, study, names


def _sequences(arguments: Arguments, setup: Setup, names: Sequence[str]) -> Mapping[str, Footage]:
    """By camera, its clip, or its topic in a bag."""
    given = arguments.path("sequence")
    if given is None:
        return _clips_of_sources(setup, names)
    if is_bag(given):
        return _topics(given, setup.vehicle, names)
    if "camera" in arguments.values and not given.is_dir():
        return {names[0]: given}
    if not given.is_dir():
        rule = "must be a directory with one clip for each camera, named after it; or name one camera with camera="
        raise ArgumentError("sequence", given, rule)
    found: dict[str, Footage] = {}
    problems = []
    for name in names:
        clips = sorted(path for path in given.glob(f"{name}.*") if path.suffix not in NO_CLIPS)
        if len(clips) == 1:
            found[name] = clips[0]
        else:
            rule = f"{len(clips)} files are named {name}.*, must be exactly one"
            problems.append(Problem(COMMAND_LINE, "sequence", repr(str(given)), rule))
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
    from runner.plans import compile_plans, render_missing

    measured = setup.with_cameras({name: setup.vehicle.cameras[name] for name in names})
    with progress_bar() as progress:
        render_missing(measured.vehicle, progress)
    found: dict[str, Footage] = {}
    for plan in compile_plans(measured):
        if plan.bag:
            found[plan.camera.name] = plan.bag
            continue
        clip = next((e.properties["location"] for e in plan.source if "location" in e.properties), None)
        if clip is None or not plan.loops:
            rule = f"must be given, since the source of {plan.camera.name} plays no clip"
            raise ArgumentError("sequence", None, rule)
        found[plan.camera.name] = Path(str(clip))
    return found
