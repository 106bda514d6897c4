"""The verbs of the command line, one module each, imported on demand."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from runner.configuration.files import GROUPS, SITE_VARIABLE, site_file
from runner.errors import COMMAND_LINE, ArgumentError, UserError, suggest
from runner.schema import schema_document

DRIVE = "DRIVE"  # stands for the directory of a drive in the usage


class Verb(NamedTuple):
    """A verb: a short description, its module, its arguments.

    takes     meaning of its positional arguments, of which there may be any number; "": none are accepted
    sweeps    whether -m is accepted
    composes  whether it reads a configuration, and therefore takes overrides
    choices   by argument, its possible values; the first is the default
    sited     whether it is about this machine, and therefore reads its site file
    """

    summary: str
    module: str
    arguments: tuple[str, ...]
    takes: str = ""
    sweeps: bool = False
    composes: bool = True
    choices: Mapping[str, tuple[str, ...]] = {}
    sited: bool = False


NO_YES = ("false", "true")
CONVERSION = ("output", "vehicle", "bag", "width_px", "height_px", "fps", "overwrite")
SIMULATED = (
    *("links", "predictions", "seeds", "windows", "duration_s", "since_s", "workers", "output", "figure"),
    *("control", "encoder_error", "late_ms", "report_jitter_ms", "report_loss", "bursts", "slot_ms", "credit_ms"),
    *("peak", "grant_ms"),
)
OF_SIMULATED = {"bursts": ("true", "false"), "control": ("true", "false")}
HOLDERS = ("vehicle", "controller", "supervisor", "watcher", "predictor", "positioner", "broker")
KEYS = ("output", "people", *HOLDERS, "host", "rotate", "revoke", "ca", "signed", "crl", "rules", "prefix")
VERBS = {
    "print": Verb(
        "print pipelines and decisions without starting them",
        "runner.verbs.print",
        ("total_kbps", "format"),
        sweeps=True,
        choices={"format": ("text", "json", "yaml")},
        sited=True,
    ),
    "init": Verb(
        "create a vehicle, or a configuration directory, of your own",
        "runner.verbs.init",
        ("files", "cameras", "source"),
        "DIR",
        composes=False,
        choices={"files": ("all", "schemas")},
    ),
    "validate": Verb(
        "check configuration files and their combinations",
        "runner.verbs.validate",
        ("all", "target"),
        "FILE",
        choices={"all": NO_YES},
    ),
    "replay": Verb(
        "turn events into decisions, without video",
        "runner.verbs.replay",
        ("input", "output", "log", "link", "positions", "topic"),
        sweeps=True,
        choices={"link": ("logged", "again")},
    ),
    "simulate": Verb(
        "drives over simulated links: a table for each prediction",
        "runner.verbs.simulate",
        (*SIMULATED, "log"),
        choices=OF_SIMULATED,
    ),
    "tune": Verb(
        "other numbers of the rules, compared by simulation",
        "runner.verbs.tune",
        ("vary", "left_out", *SIMULATED),
        choices=OF_SIMULATED,
    ),
    "vehicle": Verb(
        "the vehicle's side: cameras, RTSP server, rules",
        "runner.verbs.vehicle",
        ("log", "drives", "duration_s"),
        sited=True,
    ),
    "operator": Verb(
        "the operator's side: video, page, table",
        "runner.verbs.operator",
        ("vehicles", "log", "drives", "duration_s", "socket"),
        sited=True,
    ),
    "latency": Verb(
        "measure glass-to-glass latency",
        "runner.verbs.latency",
        ("camera", "duration_s", "loop"),
        choices={"loop": NO_YES},
        sited=True,
    ),
    "ros": Verb("the control link as ROS topics", "runner.verbs.ros", ("duration_s",), sited=True),
    "demo": Verb(
        "both sides on this machine",
        "runner.verbs.demo",
        ("camera", "log", "output", "models", "duration_s"),
        sweeps=True,
    ),
    "record": Verb("record each camera losslessly", "runner.verbs.record", ("output", "duration_s"), sited=True),
    "model": Verb(
        "rate-quality models from recordings",
        "runner.verbs.model",
        ("camera", "sequence", "output", "mount"),
        "[DRIVE]",
    ),
    "report": Verb(
        "the paper's figures from real drives",
        "runner.verbs.report",
        ("output", "models", "positions", "topic"),
        DRIVE,
        composes=False,
    ),
    "quality": Verb(
        "measure the quality of what the operator saw",
        "runner.verbs.quality",
        ("view", "kernel"),
        DRIVE,
        composes=False,
        choices={"kernel": ("linear", "cubic")},
    ),
    "map": Verb(
        "a bandwidth map from drives",
        "runner.verbs.map",
        ("output", "uplink", "percentile", "cell_m", "positions", "topic"),
        DRIVE,
        composes=False,
    ),
    "export": Verb(
        "a drive as MCAP or ROS 2 bag",
        "runner.verbs.export",
        ("output", "format", "key_interval_s"),
        DRIVE,
        composes=False,
        choices={"format": ("mcap", "rosbag2")},
    ),
    "convert": Verb(
        "a vehicle from the paper's own camera list",
        "runner.verbs.convert",
        CONVERSION,
        "FILE",
        composes=False,
        choices={"overwrite": NO_YES},
    ),
    "keys": Verb(
        "keys and passwords for vehicles and operators",
        "runner.verbs.keys",
        KEYS,
        composes=False,
        choices={"rules": NO_YES},
    ),
    "doctor": Verb(
        "what this machine lacks, and its cameras", "runner.verbs.doctor", ("registry",), "VERB or cameras", sited=True
    ),
    "completion": Verb("the completion script for bash or zsh", "runner.verbs.completion", (), "SHELL", composes=False),
}

FIRST_DAY = ("demo", "print", "init", "validate", "vehicle", "operator")  # what --help shows first

SWEPT = ("total_kbps",)  # arguments that -m sweeps like overrides; others may be paths that contain a comma
# Flags of a Hydra application, and what replaces them here.
HYDRA_FLAGS = {
    ("--multirun",): "write -m",
    ("--cfg", "-c"): "print format=yaml shows the composed configuration, and where each value comes from",
    ("--resolve",): "print format=yaml resolves interpolations",
    ("--package", "-p"): "print format=yaml shows the whole configuration",
    ("--info", "-i"): "print format=yaml shows which files were composed; validate all=true checks all of them",
    ("--config-dir", "-cd", "--config-path", "-cp"): "conf=DIR names a directory of your own",
    ("--config-name", "-cn"): "conf=DIR may contain a config.yaml of your own",
    ("--run", "-r"): "a verb runs without a flag",
    ("--shell-completion", "-sc"): "tod-runner completion bash or zsh prints the script",
    ("--hydra-help",): "docs/configuration.md describes groups, overrides and defaults lists",
    ("--experimental-rerun",): "replay input=DRIVE repeats a drive with its own configuration",
}


def import_problem(error: ImportError) -> str | None:
    """What to tell the user about a library that cannot be imported; None for a mistake in this package."""
    from runner.system.extras import EXTRAS, how_to_install

    module = (error.name or "").partition(".")[0]
    extra = next((extra for extra, modules in EXTRAS.items() if module in modules), None)
    if isinstance(error, ModuleNotFoundError):
        missing = f"the Python module {error.name} is not installed"
        return f"{missing}: {how_to_install(extra)}" if extra else None
    if module == "runner":
        return None
    remedy = f"; re{how_to_install(extra)}" if extra else ""
    return f"{f'the Python module {module}' if module else 'a Python module'} does not load: {error}{remedy}"


@dataclass(frozen=True, slots=True)
class Arguments:
    """The command line: a verb's own arguments, taken literally, and the overrides, which are left to Hydra.

    words   positional arguments, if the verb takes any
    sweeps  whether -m was given
    site    the site file, if there is one and the verb reads it
    """

    verb: str
    overrides: list[str]
    conf: Path | None = None
    values: dict[str, str] = field(default_factory=dict)
    words: tuple[str, ...] = ()
    sweeps: bool = False
    site: Path | None = None

    @staticmethod
    def parse(verb: str, words: Sequence[str]) -> Arguments:
        """Parse the words. A path given to an argument may contain any character, since Hydra never sees it.

        raises  UserError for a flag other than -m, for a name that only another verb takes or that is misspelt, for an
                override of a verb that reads no configuration, for an argument without a value, for a missing drive,
                and for a word that is not UTF-8
        """
        for word in words:
            _check_utf8(COMMAND_LINE, "", word)
        own = (*VERBS[verb].arguments, "conf")
        sweeps = VERBS[verb].sweeps and "-m" in words
        words = [word for word in words if not (sweeps and word == "-m")]
        values: dict[str, str] = {}
        overrides, plain = [], []
        for word in words:
            key, equals, value = word.partition("=")
            if equals and key in own:
                if not value:  # from an unset variable of the shell
                    raise ArgumentError(key, "''", "must not be empty")
                values[key] = value
            elif word.startswith("-"):
                raise unknown_flag(word)
            elif VERBS[verb].takes == DRIVE and (not equals or "/" in key):  # a path may contain a =
                plain.append(word)
            elif not equals and not word.startswith("~"):
                if not VERBS[verb].takes:
                    raise ArgumentError("", word, "must be NAME=VALUE")
                plain.append(word)
            elif not VERBS[verb].composes:
                raise ArgumentError("", word, f"unknown argument; expected one of {', '.join(own)}")
            else:
                _check_name(verb, key)
                overrides.append(word)
        if VERBS[verb].takes == DRIVE and not plain:
            raise ArgumentError(DRIVE, None, "must be given: a directory that log= wrote")
        conf = values.pop("conf", None) or os.environ.get("TOD_CONF")
        for name in ("TOD_CONF", SITE_VARIABLE):
            _check_utf8("environment", name, os.environ.get(name, ""))
        site = site_file(os.environ) if VERBS[verb].sited else None
        return Arguments(verb, overrides, Path(conf) if conf else None, values, tuple(plain), sweeps, site)

    def runs(self) -> list[tuple[tuple[str, ...], Arguments]]:
        """Overrides and arguments of each run that -m expands to.

        raises  ConfigError
        """
        from runner.configuration.overrides import sweep

        count = len(self.overrides)
        swept = [key for key in SWEPT if key in self.values]
        made = []
        for words in sweep([*self.overrides, *(f"{key}={self.values[key]}" for key in swept)]):
            values = {key: word.partition("=")[2] for key, word in zip(swept, words[count:], strict=True)}
            own = replace(self, overrides=list(words[:count]), values=self.values | values, sweeps=False)
            made.append((words, own))
        return made

    def in_directory(self, name: str, keys: Sequence[str]) -> Arguments:
        """A copy in which each given directory is replaced by a subdirectory of it."""
        inner = {key: str(path / name) for key in keys if (path := self.path(key))}
        return replace(self, values=self.values | inner)

    def choice(self, key: str, among: Sequence[str] = ()) -> str:
        """One of the argument's choices, or of some of them; the first if not given."""
        options = among or VERBS[self.verb].choices[key]
        value = self.values.get(key, options[0])
        if value not in options:
            raise ArgumentError(key, repr(value), f"must be one of {', '.join(options)}")
        return value

    def number(self, key: str) -> float | None:
        """A number from 0; None if not given."""
        text = self.values.get(key)
        if text is None:
            return None
        try:
            number = float(text)
        except ValueError:
            number = -1.0
        if not 0 <= number < float("inf"):
            raise ArgumentError(key, repr(text), "must be a number of 0 or more")
        return number

    def path(self, key: str) -> Path | None:
        """A file or directory; None if not given."""
        return Path(self.values[key]) if key in self.values else None

    def given_path(self, key: str, meaning: str) -> Path:
        """A file or directory that must be given."""
        if key not in self.values:
            raise ArgumentError(key, None, f"must be given: {meaning}")
        return Path(self.values[key])

    def drive(self) -> Path | None:
        """Where to log a drive: the directory of log=, or a new one below that of drives=; None: nowhere."""
        from runner.drive.log import new_drive

        parent, log = self.path("drives"), self.path("log")
        if parent and log:
            raise ArgumentError("drives", parent, "names a directory for each drive, so log= must not be given")
        return new_drive(parent) if parent else log


def unknown_flag(word: str) -> UserError:
    """The error for a flag; for one of Hydra's it names the replacement."""
    name = word.partition("=")[0]
    if name == "-m":
        sweeping = ", ".join(verb for verb, spec in VERBS.items() if spec.sweeps)
        return ArgumentError("", word, f"must follow one of {sweeping}")
    rule = next((instead for names, instead in HYDRA_FLAGS.items() if name in names), "write NAME=VALUE, or --help")
    return ArgumentError("", word, f"flags are not supported; {rule}")


def _check_utf8(where: str, key: str, text: str) -> None:
    """raises UserError for text with undecodable bytes: YAML, JSON and the log could not hold it"""
    try:
        text.encode()
    except UnicodeEncodeError:
        found = text.encode("utf-8", "backslashreplace").decode()
        raise UserError(where, key, found, "must be UTF-8") from None


def _check_name(verb: str, key: str) -> None:
    """Refuse words that cannot be overrides: an argument of another verb, or a misspelt name.

    raises  UserError; names that resemble no known one are left to the schema of the configuration
    """
    name = key.lstrip("+~/").partition("@")[0].partition(".")[0]
    own = (*VERBS[verb].arguments, "conf")
    configured = [*GROUPS, *schema_document("composed")["properties"]]
    if verb in ("model", "doctor"):
        configured += schema_document("study")["properties"]  # these verbs take keys of the study without `study.`
    if name in configured:
        return
    takers = [other for other, spec in VERBS.items() if name in spec.arguments]
    if takers:
        raise ArgumentError(name, None, f"is an argument of {', '.join(takers)}; {verb} has {', '.join(own)}")
    hint = suggest(name, (*own, *configured))
    if "did you mean" in hint:
        raise ArgumentError(name, None, f"unknown name{hint}")


def study_word(word: str) -> str:
    """An override of `model`, where keys of conf/study/ need no section: metric=psnr is study.metric=psnr."""
    key = word.replace(".", "=").partition("=")[0]
    return f"study.{word}" if key in schema_document("study")["properties"] else word
