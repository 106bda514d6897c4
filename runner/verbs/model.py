"""usage: tod-runner model [OVERRIDE ...] camera=NAME sequence=CLIP output=DIR
       tod-runner model [OVERRIDE ...] vehicle=NAME sequence=DIR output=DIR
       tod-runner model [OVERRIDE ...] vehicle=NAME sequence=DIR mount=CONF
       tod-runner model DRIVE [OVERRIDE ...] output=DIR
       tod-runner model compare A.model.json B.model.json

Measures rate-quality models: each recorded sequence is scaled, encoded by the live graph's own encoder at constant
bitrates, decoded, scaled up again and compared with the original. Writes for each camera DIR/CAMERA.yaml, ready for
conf/cameras/, DIR/CAMERA.model.json with every point, and the curves as .png and .pdf.

camera= is a camera of the vehicle, or a kind in conf/cameras/; without it all cameras of the vehicle are measured,
and sequence= is a directory with one clip for each, named after it. sequence= may also be a ROS bag: each camera is
measured on its topic. Without sequence= the source's own clips are used.
The method is defined in conf/study/paper.yaml; its keys may be given without study.: metric= plan= scalings=
bitrates_kbps= b_full_quality= cpu_cores= pool= masks= metric_every= workers= and others.

DRIVE is a directory that log= wrote: its cameras are measured, in its configuration, on what it has of their whole
images: what the vehicle has kept without loss (log.lossless), what `record` has kept in it, the clips that its sources
played, or, as second best, the video as sent, if that was whole and of full size (log.video=true). Pictures that were
cropped to what the driver saw are refused.

fps= adds rates of fewer pictures, Hz: at the same bitrates, the quality of each delivered picture, and of what a screen
holds until the next one.

mount= is a configuration directory of your own: cameras of one kind are measured together, and rate_quality of that
kind is replaced in CONF/cameras/KIND.yaml, so that conf=CONF vehicle=NAME drives with it; a file of your own is kept as
KIND.yaml.before. Shows what this changes in decisions at 1, 3 and 8 Mbit/s. The models are in output=, else in
CONF/models.

Measurements are cached by content in the user's cache directory: an interrupted run resumes where it stopped.

  tod-runner model camera=front_center sequence=drive.mp4 output=models
  tod-runner model camera=front_center sequence=drive.mp4 output=models 'metric=[mssim,psnr]' plan=full
  tod-runner model vehicle=tum_q7 sequence=recording/ output=models 'pool={front_side:[front_left,front_right]}'
  tod-runner model vehicle=tum_q7 source=synthetic output=models graph=openh264_rtsp
  tod-runner model vehicle=tum_q7 source=synthetic mount=my_vehicles
  tod-runner model drives/monday mount=my_vehicles
  tod-runner model camera=front_center sequence=drive.mp4 output=models 'fps=[12.5,5]'
  tod-runner model camera=front_left sequence=drive.mcap cameras.front_left.topic=/left/image_raw output=models
  tod-runner model camera=top_left sequence=top.mkv output=models masks.top_left=mask.png cpu_cores=0.3
  tod-runner model compare models/front_center.model.json models_new/front_center.model.json
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from runner.configuration.config import Base, configuration
from runner.configuration.files import conf_directories, options
from runner.core.model import ModelError
from runner.errors import ArgumentError, suggest
from runner.settings import Setup
from runner.system import signals
from runner.system.extras import require
from runner.verbs import Arguments, study_word
from runner.verbs.model_footage import given, of_drive
from runner.verbs.model_mount import Mount, mount_of
from runner.verbs.screen import progress_bar, say, streaming

if TYPE_CHECKING:
    from runner.drive.read import Drive
    from runner.rate_quality.study import Study


def run(arguments: Arguments) -> int:
    streaming()
    require("model")
    drive = _drive(arguments)
    mount = mount_of(arguments, drive)
    output = arguments.path("output") or (mount.models if mount else None)
    if output is None:
        output = arguments.given_path("output", "the directory to write models to")
    setup, study, names = _targets(arguments, drive, mount)
    paths = of_drive(drive, setup, names) if drive else given(arguments, setup, names)
    if mount:
        study = replace(study, pool=mount.pool({name: setup.vehicle.cameras[name] for name in paths}))
    from runner.rate_quality.measure import measure

    with progress_bar() as progress, signals.interruptible():
        measured = measure(setup, study, paths, output, progress, say)
        for number, written in enumerate(measured):
            print(written)
            if mount:
                mount.put(list(study.pool)[number], output)
    if mount:
        mount.show()
    return 0


def _drive(arguments: Arguments) -> Drive | None:
    """The drive whose cameras are measured; None: none is given."""
    if not arguments.words:
        return None
    if len(arguments.words) > 1:
        raise ArgumentError("DRIVE", " ".join(arguments.words), "must be one directory that log= wrote")
    if "sequence" in arguments.values:
        raise ArgumentError("sequence", arguments.values["sequence"], "must not be given with a drive")
    from runner.drive.read import read_drive

    drive = read_drive(Path(arguments.words[0]))
    for warning in drive.warnings:
        say(warning)
    return drive


def compare(words: Sequence[str]) -> int:
    """The verb's second form: how two model files differ."""
    from runner.rate_quality.artefact import read_model
    from runner.rate_quality.compare import compare as differences

    if len(words) != 2:
        raise ArgumentError("model compare", f"{len(words)} files", "must be two: A.model.json B.model.json")
    before, after = (read_model(Path(word)) for word in words)
    print("\n".join(differences(before, after)))
    return 0


def _targets(arguments: Arguments, drive: Drive | None, mount: Mount | None) -> tuple[Setup, Study, list[str]]:
    """The vehicle, the study, and the cameras to measure; a kind of camera that the vehicle lacks is mounted."""
    from runner.apply import check_plan
    from runner.rate_quality.study import check_cameras

    words, conf = [study_word(word) for word in arguments.overrides], mount.conf if mount else arguments.conf
    base = _base(drive) if drive else None
    if drive:  # vehicle= names the files of the vehicle that was driven
        words = [word for word in words if not word.startswith("vehicle=")]
    requested = arguments.values.get("camera")
    config = configuration(words, conf, base=base, runnable=False, check=check_plan)
    study, setup = config.study(), config.setup()
    if requested and requested not in setup.vehicle.cameras:
        kinds = [] if drive or mount else options("cameras", conf_directories(conf))
        if requested not in kinds:
            hint = suggest(requested, [*setup.vehicle.cameras, *kinds])
            raise ArgumentError("camera", repr(requested), f"is neither mounted nor a kind of camera{hint}")
        words.append(f"+cameras@cameras.{requested}={requested}")
        config = configuration(words, conf, runnable=False, check=check_plan)
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


def _base(drive: Drive) -> Base:
    """The configuration that was driven."""
    side = drive.sides.get("vehicle") or drive.sides["operator"]
    return dict(side.began.config), f"{drive.path}: config"
