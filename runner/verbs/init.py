"""usage: tod-runner init DIR [files=all|schemas]
       tod-runner init DIR/NAME cameras=NAME[,NAME...] [source=v4l2]

With cameras=, creates the directory of a vehicle: NAME with these cameras, a kind of camera, a graph, the rules of its
modes, predictions from a map, a rule in Python, checks for GitHub Actions and for pre-commit, and a README that says
what to do with them. source= is v4l2, rtsp, ros, appsrc, synthetic or test.

Without, creates a configuration directory to start from: a vehicle with two cameras, a kind of camera, a modes file,
checks for GitHub Actions and for pre-commit, and in DIR/.schemas the schemas with which your editor completes, explains
and checks keys. Both pass `validate` unchanged. Existing files are never overwritten: if there are any, nothing is
written and each is listed. A new directory appears only when it is complete.

With files=schemas only the schemas are written: for an existing directory, or, after an update, once you have removed
DIR/.schemas.

  tod-runner init courier cameras=front,left,rear source=v4l2
  tod-runner print conf=courier vehicle=courier
  tod-runner init my_vehicles
  tod-runner validate conf=my_vehicles
  tod-runner print conf=my_vehicles vehicle=my_vehicle modes=my_modes
  tod-runner init my_vehicles files=schemas
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path

from runner.configuration.editors import copies
from runner.errors import ArgumentError, ConfigError, Problem, RunError, os_errors_as
from runner.verbs import Arguments
from runner.verbs.new_vehicle import vehicle_files

VEHICLE = "my_vehicle"
TEMPLATES = {  # by path in the directory, the file in static/
    f"vehicle/{VEHICLE}.yaml": "vehicle.yaml",
    "cameras/my_camera.yaml": "camera.yaml",
    "modes/my_modes.yaml": "modes.yaml",
    ".github/workflows/validate.yaml": "workflow.yaml",
    ".pre-commit-config.yaml": "pre-commit.yaml",
}


def run(arguments: Arguments) -> int:
    everything = arguments.choice("files") == "all"
    if len(arguments.words) != 1:
        raise ArgumentError("", " ".join(arguments.words) or None, "must be one directory: init DIR")
    place, cameras = Path(arguments.words[0]), arguments.values.get("cameras")
    if cameras is None and "source" in arguments.values:
        raise ArgumentError("cameras", None, "must be given with source=: cameras=front,left,rear")
    if cameras is not None and not everything:
        raise ArgumentError("files", "schemas", "must not be given with cameras=")
    own = vehicle_files(place.name, cameras.split(","), arguments.values.get("source", "v4l2")) if cameras else None
    texts = {**(own or (_templates() if everything else {})), **copies()}
    if problems := list(dict.fromkeys(_problems(place, texts))):
        raise ConfigError(problems, "nothing was written")
    with os_errors_as(lambda why: RunError(f"{place}: cannot be written: {why}")):
        _write(place, texts)
    print("\n".join(str(place / name) for name in texts))
    if own:
        print(f"next: tod-runner print conf={place} vehicle={place.name}; then read {place / 'README.md'}")
    elif everything:
        print(f"next: tod-runner validate conf={place}; tod-runner print conf={place} vehicle={VEHICLE} modes=my_modes")
    return 0


def _templates() -> dict[str, str]:
    static = Path(__file__).parent / "static"
    return {name: (static / file).read_text(encoding="utf-8") for name, file in TEMPLATES.items()}


def _problems(place: Path, texts: Mapping[str, str]) -> Iterator[Problem]:
    """What already exists where a file or directory must be written."""
    for name in texts:
        path = place / name
        above = [folder for folder in path.parents if os.path.lexists(folder) and not folder.is_dir()]
        if above:
            yield Problem(str(above[0]), "", None, "must be a directory")
        elif os.path.lexists(path):
            yield Problem(str(path), "", None, "already exists; init overwrites nothing")


def _write(place: Path, texts: Mapping[str, str]) -> None:
    """Write all files or none. A new directory is built under a temporary name and then renamed."""
    if place.is_dir():
        _fill(place, texts)
        return
    place = place.resolve()
    place.parent.mkdir(parents=True, exist_ok=True)
    part = place.with_name(f".{place.name}.{os.getpid()}")
    try:
        part.mkdir()
        _fill(part, texts)
        part.rename(place)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise


def _fill(place: Path, texts: Mapping[str, str]) -> None:
    """Write files into a directory; if one cannot be written, remove the others again."""
    with ExitStack() as made:
        for name, text in texts.items():
            path = place / name
            for folder in reversed([above for above in path.parents if not above.exists()]):
                folder.mkdir()
                made.callback(folder.rmdir)
            with path.open("x", encoding="utf-8") as file:
                made.callback(path.unlink)
                file.write(text)
        made.pop_all()
