"""The verbs of the command line, one module each, imported only when asked for."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from runner.errors import UserError


class Verb(NamedTuple):
    """A verb: what it does in a few words, where it lives, which arguments it takes.

    takes  what words without = are, which come in any number; "": there are none
    """

    summary: str
    module: str
    arguments: tuple[str, ...]
    takes: str = ""


VERBS = {
    "print": Verb("what would run, and why; starts nothing", "runner.verbs.print", ("total_kbps", "format")),
    "validate": Verb("check every file and every combination", "runner.verbs.validate", ()),
    "replay": Verb("events in, decisions out, no video", "runner.verbs.replay", ("input", "output", "log")),
    "vehicle": Verb("the vehicle's side: cameras, RTSP server, rules", "runner.verbs.vehicle", ("log", "duration_s")),
    "operator": Verb("the operator's side: video, page, table", "runner.verbs.operator", ("log", "duration_s")),
    "demo": Verb("both sides on this machine", "runner.verbs.demo", ("log", "output", "models", "duration_s")),
    "record": Verb("each camera without loss into a file", "runner.verbs.record", ("output", "duration_s")),
    "model": Verb("rate-quality models from recordings", "runner.verbs.model", ("camera", "sequence", "output")),
    "report": Verb("the paper's figures from real drives", "runner.verbs.report", ("output", "models"), "DRIVE"),
    "map": Verb("a bandwidth map from drives", "runner.verbs.map", ("output", "percentile", "cell_m"), "DRIVE"),
    "export": Verb("a drive as MCAP, for Foxglove", "runner.verbs.export", ("output",), "DRIVE"),
    "doctor": Verb("what is missing on this machine", "runner.verbs.doctor", ()),
}


# By Python module, the extra of this package that brings it.
EXTRAS = {
    "paho": "live",
    "rich": "live",
    "aiohttp": "page",
    "plotly": "page",
    "numba": "synthetic",
    "cv2": "model",
    "scipy": "model",
    "matplotlib": "model",
    "imageio_ffmpeg": "vmaf",
    "distributed": "cluster",
    "foxglove": "mcap",
}


@dataclass(frozen=True, slots=True)
class Arguments:
    """Words of the command line: a verb's own arguments, taken as literal text, and the overrides left for Hydra.

    words  those without =, where the verb takes any
    """

    verb: str
    overrides: list[str]
    conf: Path | None = None
    values: dict[str, str] = field(default_factory=dict)
    words: tuple[str, ...] = ()

    @staticmethod
    def parse(verb: str, words: Sequence[str]) -> Arguments:
        """Split the words. A path given to an argument may hold any character, since Hydra never sees it.

        raises  UserError for a flag, which no verb has
        """
        own = (*VERBS[verb].arguments, "conf")
        values: dict[str, str] = {}
        overrides, plain = [], []
        for word in words:
            key, equals, value = word.partition("=")
            if equals and key in own:
                values[key] = value
            elif word.startswith("-"):
                raise UserError("command line", "", word, "there are no flags; write NAME=VALUE, or --help")
            elif VERBS[verb].takes and (not equals or "/" in key):  # a path may hold a = of its own
                plain.append(word)
            elif not equals and not word.startswith("~"):
                raise UserError("command line", "", word, "must be NAME=VALUE")
            else:
                overrides.append(word)
        conf = values.pop("conf", None) or os.environ.get("TOD_CONF")
        return Arguments(verb, overrides, Path(conf) if conf else None, values, tuple(plain))

    def choice(self, key: str, options: Sequence[str]) -> str:
        """One of some words; the first where it is not given."""
        value = self.values.get(key, options[0])
        if value not in options:
            raise UserError("command line", key, repr(value), f"must be one of {', '.join(options)}")
        return value

    def number(self, key: str) -> float | None:
        """A number from 0; None where it is not given."""
        text = self.values.get(key)
        if text is None:
            return None
        try:
            number = float(text)
        except ValueError:
            number = -1.0
        if not 0 <= number < float("inf"):
            raise UserError("command line", key, repr(text), "must be a number from 0")
        return number

    def path(self, key: str) -> Path | None:
        return Path(self.values[key]) if key in self.values else None
