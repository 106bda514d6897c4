"""Models written where they are used: into the kinds of camera of a configuration directory; what that changes."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from runner.configuration.config import configuration
from runner.configuration.files import conf_directories, find_file, options
from runner.core.decision import Decision, Setting
from runner.core.model import Camera
from runner.errors import ArgumentError, UserError, os_errors_as, suggest
from runner.system.files import write_whole
from runner.verbs import Arguments, study_word

if TYPE_CHECKING:
    from runner.drive.read import Drive

TOTALS_KBPS = (1000, 3000, 8000)
MODEL = "rate_quality"
# The key with all that belongs to it: what is indented below it.
BLOCK = re.compile(rf"^{MODEL}:[^\n]*\n(?:[ \t]+\S[^\n]*\n|[ \t]*\n(?=[ \t]+\S))*", re.MULTILINE)
SCHEMA_LINE = re.compile(r"^# yaml-language-server: .*$", re.MULTILINE)
OWN_SCHEMA = "# yaml-language-server: $schema=../.schemas/camera.schema.json"


@dataclass
class Mount:
    """A configuration directory in which cameras get their models.

    directory  that the user named; it need not exist yet
    words      overrides of the command line, which choose the vehicle
    kinds      by camera of the vehicle, its kind
    before     by total in kbit/s, what was decided before
    """

    directory: Path
    words: Sequence[str]
    kinds: Mapping[str, str]
    before: Mapping[int, Decision] = field(default_factory=dict)

    @property
    def conf(self) -> Path | None:
        return self.directory if self.directory.is_dir() else None

    @property
    def models(self) -> Path:
        """Where models are kept unless the user names another directory."""
        return self.directory / "models"

    def pool(self, cameras: Mapping[str, Camera]) -> dict[str, tuple[str, ...]]:
        """By kind, its cameras: they share a file, and so a model.

        cameras  that are measured
        raises   ArgumentError for a camera that the vehicle lacks, or whose size is not that of its kind
        """
        if missing := [name for name in cameras if name not in self.kinds]:
            rule = f"mounts no {', '.join(missing)}; name the vehicle of the drive with vehicle="
            raise ArgumentError("vehicle", None, rule)
        for name, camera in cameras.items():
            self._check_size(name, camera)
        kinds = dict.fromkeys(self.kinds[name] for name in cameras)
        return {kind: tuple(name for name in cameras if self.kinds[name] == kind) for kind in kinds}

    def _check_size(self, name: str, camera: Camera) -> None:
        path = find_file(conf_directories(self.conf), "cameras", self.kinds[name])
        stated = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
        size = (stated.get("width_px", camera.width), stated.get("height_px", camera.height))
        if size != (camera.width, camera.height):
            rule = f"{path} states {size[0]}x{size[1]} px: a model of another size does not belong there"
            raise ArgumentError(f"cameras.{name}", f"{camera.width}x{camera.height} px", rule)

    def put(self, kind: str, models: Path) -> None:
        """Replace the model of a kind by what was measured."""
        from runner.rate_quality.artefact import MARK

        measured = (models / f"{kind}.yaml").read_text(encoding="utf-8")
        path = self.directory / "cameras" / f"{kind}.yaml"
        used = find_file(conf_directories(self.conf), "cameras", kind)
        text = with_model(used.read_text(encoding="utf-8"), measured, str(used))
        with os_errors_as(lambda why: UserError(str(path), "", None, f"cannot be written: {why}")):
            path.parent.mkdir(parents=True, exist_ok=True)
            if used == path and MARK not in used.read_text(encoding="utf-8"):
                kept = _free(path)
                write_whole(kept, used.read_bytes())
                print(f"{kept}: as it was")
            elif used != path:
                text = SCHEMA_LINE.sub(OWN_SCHEMA, text, count=1)
            write_whole(path.with_name(f"{kind}.model.json"), (models / f"{kind}.model.json").read_bytes())
            write_whole(path, text.encode())
        print(f"{path}: {MODEL} of {', '.join(name for name, own in self.kinds.items() if own == kind)}")

    def show(self) -> None:
        """What the new models change in decisions."""
        from rich import box
        from rich.console import Console
        from rich.table import Table

        from runner.verbs.report_table import WIDE

        after = decisions(self.words, self.conf)
        title = "kbit/s and size, before and after"
        table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
        for number, heading in enumerate(("camera", *(f"{total // 1000} Mbit/s" for total in TOTALS_KBPS))):
            table.add_column(heading, justify="right" if number else "left", no_wrap=True)
        for name in self.kinds:
            both = ((self.before[total].settings[name], after[total].settings[name]) for total in TOTALS_KBPS)
            table.add_row(name, *("\n".join(map(_words, each)) for each in both))
        Console(width=None if sys.stdout.isatty() else WIDE).print(table)


def mount_of(arguments: Arguments, drive: Drive | None) -> Mount | None:
    """The directory that mount= names; None: none.

    raises  ArgumentError, ConfigError
    """
    directory = arguments.path("mount")
    if directory is None:
        return None
    if directory.exists() and not directory.is_dir():
        raise ArgumentError("mount", directory, "must be a configuration directory")
    if arguments.conf and arguments.conf.resolve() != directory.resolve():
        raise ArgumentError("mount", directory, f"must be the directory of conf=, {arguments.conf}")
    studied = [word for word in arguments.overrides if study_word(word) != word or word.startswith("study")]
    if any(word.startswith(("pool", "study.pool")) for word in studied):
        raise ArgumentError("pool", None, "must not be given with mount=: cameras of one kind are measured together")
    words = [word for word in arguments.overrides if word not in studied]
    conf = directory if directory.is_dir() else None
    if drive and not any(word.startswith("vehicle=") for word in words):
        words.insert(0, f"vehicle={_vehicle(drive, conf)}")
    choices = configuration(words, conf, runnable=False).choices
    prefix = "cameras@cameras."
    kinds = {key.removeprefix(prefix): kind for key, kind in choices.items() if key.startswith(prefix)}
    mount = Mount(directory, words, dict(reversed(kinds.items())))
    mount.before = decisions(words, conf)
    return mount


def _vehicle(drive: Drive, conf: Path | None) -> str:
    """The file of the vehicle that was driven, by its name."""
    side = drive.sides.get("vehicle") or drive.sides["operator"]
    name, known = str(side.began.config.get("name")), options("vehicle", conf_directories(conf))
    if name not in known:
        raise ArgumentError("vehicle", name, f"no such file in vehicle/: name it{suggest(name, known)}")
    return name


def decisions(words: Sequence[str], conf: Path | None) -> dict[int, Decision]:
    """By total in kbit/s, how the vehicle would send its cameras."""
    from runner.verbs.print import decide

    vehicle = configuration(words, conf, runnable=False).vehicle()
    return {total: decide(vehicle, Fraction(total)) for total in TOTALS_KBPS}


def with_model(text: str, measured: str, name: str) -> str:
    """The file of a kind of camera with the model of another one, everything else as it is.

    measured  file that `model` wrote
    name      of the first, for messages
    raises    UserError if its model cannot be replaced
    """
    comments = [f"  {line}\n" for line in measured.splitlines() if line.startswith("# ") and "$schema" not in line]
    block = measured[measured.index(f"{MODEL}:\n") :].replace(f"{MODEL}:\n", f"{MODEL}:\n{''.join(comments)}", 1)
    text = text if text.endswith("\n") else f"{text}\n"
    found = BLOCK.search(text)
    new = text[: found.start()] + block + text[found.end() :] if found else text + block
    try:
        was, now = yaml.safe_load(text) or {}, yaml.safe_load(new)
        wanted = {**was, MODEL: yaml.safe_load(measured)[MODEL]}
    except (yaml.YAMLError, TypeError):
        was, now, wanted = {}, None, {}
    if now != wanted:
        raise UserError(
            name, MODEL, None, "cannot be replaced where it stands: write it as a block of its own, indented"
        )
    return new


def _free(path: Path) -> Path:
    """A name for what a file contained."""
    names = (path.with_name(f"{path.name}.before{number or ''}") for number in count())
    return next(name for name in names if not name.exists())


def _words(setting: Setting) -> str:
    return f"{setting.kbps} {setting.width}x{setting.height}" if setting.sending else "off"
