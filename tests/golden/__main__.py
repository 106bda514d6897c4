"""usage: python tests/golden [--update] [SECTION ...]

Compares output that must not change, byte for byte, with copies beside this script; takes at most a minute:

  plans      `print` of every vehicle with every graph and source, as text and as JSON
  events     decisions on 2400 generated events, over every vehicle and five modes files
  links      decisions on 720 generated events on a measured link, with floors, for every vehicle
  drives     replays of three recorded drives
  validate   output of `validate` for a hundred broken files
  keys       keys of events, of lines of drive logs and of messages of the control link
  mutations  file and path of the problems `validate` finds in 200 mutations of packaged files; only if named

With --update the sections are rewritten; run it without --update first to see what changes.
"""

from __future__ import annotations

import contextlib
import difflib
import gc
import io
import json
import lzma
import os
import random
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import broken
import mutations as mutated
import numpy as np

HERE = Path(__file__).resolve().parent
CHECKOUT = HERE.parents[1]
CONF, SCHEMAS = CHECKOUT / "conf", CHECKOUT / "schemas"
EVENTS, SEED = 2400, 20261122
LINK_EVENTS = 720
MODES = ("equal", "fixed", "paper", "safe", "steady")  # a new file must not change the events of these
LINK_MODES = ("open_loop", "safe")
SHOWN = 60  # lines of a difference
Texts = dict[str, str]
Generators = dict[
    str, Callable[[random.Random, str, list[str], float], dict[str, Any]]
]  # of an event's values, by name


def main(words: list[str]) -> int:
    update = "--update" in words
    sections = [word for word in words if word != "--update"] or [name for name in SECTIONS if name != "mutations"]
    if unknown := [word for word in sections if word not in SECTIONS]:
        print(f"unknown section {unknown[0]}; expected one of {', '.join(SECTIONS)}", file=sys.stderr)
        return 2
    began, different = time.monotonic(), 0
    with tempfile.TemporaryDirectory() as empty:
        # Rendered clips of the user's cache would show up in the printed lines.
        os.environ |= {"XDG_CACHE_HOME": empty, "TOD_SITE": ""}
        os.environ.pop("TOD_CONF", None)
        with ProcessPoolExecutor(os.cpu_count(), initializer=_prepare) as pool:
            for section in sections:
                texts = SECTIONS[section](pool)
                different += _write(section, texts) if update else _compare(section, texts)
    print(f"{time.monotonic() - began:.0f} s")
    return 1 if different else 0


def _file(section: str) -> Path:
    return HERE / f"{section}.json.xz"


def _write(section: str, texts: Texts) -> int:
    _file(section).write_bytes(lzma.compress(json.dumps(texts, indent=0).encode(), preset=9))
    print(f"{section}: {len(texts)} written")
    return 0


def _compare(section: str, now: Texts) -> int:
    kept: Texts = json.loads(lzma.decompress(_file(section).read_bytes()))
    names = [name for name in {**kept, **now} if kept.get(name) != now.get(name)]
    print(f"{section}: {len(kept)} compared, {len(names)} differ")
    lines = [line for name in names for line in _difference(name, kept.get(name, ""), now.get(name, ""))]
    print("\n".join(lines[:SHOWN]), end="\n" if lines else "")
    if len(lines) > SHOWN:
        print(f"... {len(lines) - SHOWN} more lines")
    return len(names)


def _difference(name: str, kept: str, now: str) -> Iterator[str]:
    return difflib.unified_diff(kept.splitlines(), now.splitlines(), f"{name}, kept", f"{name}, now", n=0, lineterm="")


# --- sections ---------------------------------------------------------------------------------------------------------


def plans(pool: ProcessPoolExecutor) -> Texts:
    choices = list(product(*map(_files, ("vehicle", "graph", "source")), ("text", "json")))
    with tempfile.TemporaryDirectory() as directory:
        sys.path.insert(0, str(HERE.parent))
        from bags import camera_bag

        bag = camera_bag(Path(directory, "drive"), "mcap", {"/image": [np.zeros((16, 16, 3), np.uint8)]}, 10)
        words = [
            [
                "print",
                f"format={form}",
                f"vehicle={vehicle}",
                f"graph={graph}",
                f"source={source}",
                "total_kbps=3000",
                *_inputs(vehicle, source, bag),
            ]
            for vehicle, graph, source, form in choices
        ]
        return {name.replace(directory, ""): text for name, text in _outputs(pool, words).items()}


def events(pool: ProcessPoolExecutor) -> Texts:
    return _decisions(pool, Story(MODES, EVENTS, (0, 0.1, 0.1, 0.1, 0.5, 1.3, 7), _GENERATED, lambda _: []))


def links(pool: ProcessPoolExecutor) -> Texts:
    return _decisions(pool, Story(LINK_MODES, LINK_EVENTS, (0, 0.04, 0.04, 0.04, 0.1, 0.7), _ON_A_LINK, _floors))


class Story(NamedTuple):
    """Generated events, shared evenly by the vehicles with several cameras and by the modes files.

    steps      s between two events
    overrides  by vehicle
    """

    modes: tuple[str, ...]
    count: int
    steps: tuple[float, ...]
    generated: Generators
    overrides: Callable[[str], list[str]]


def _decisions(pool: ProcessPoolExecutor, story: Story) -> Texts:
    runs = list(product((name for name in _files("vehicle") if len(_cameras(name)) > 1), story.modes))
    chance = random.Random(SEED)
    inputs = {run: _events(chance, run[0], story.count // len(runs), story) for run in runs}
    with tempfile.TemporaryDirectory() as directory:
        words = []
        for vehicle, modes in runs:
            path = Path(directory, f"{vehicle}_{modes}.jsonl")
            path.write_text("\n".join(map(json.dumps, inputs[vehicle, modes])))
            words.append(["replay", f"vehicle={vehicle}", f"modes={modes}", *story.overrides(vehicle), f"input={path}"])
        outputs = _outputs(pool, words)
    return {" ".join(word for word in name.split() if "input=" not in word): text for name, text in outputs.items()}


def drives(pool: ProcessPoolExecutor) -> Texts:
    with tempfile.TemporaryDirectory() as directory:
        words = []
        for kept in sorted((HERE / "drives").glob("*.jsonl.xz")):
            path = Path(directory, kept.name.removesuffix(".xz"))
            path.write_bytes(lzma.decompress(kept.read_bytes()))
            changes = ([], ["modes=steady"], ["link=again"])
            words += [["replay", *change, f"input={path}"] for change in changes]
        found = _outputs(pool, words)
        return {name.replace(directory, ""): text.replace(directory, "") for name, text in found.items()}


def validate(pool: ProcessPoolExecutor) -> Texts:
    with tempfile.TemporaryDirectory() as directory:
        names = []
        for name, texts in broken.directories(CONF):
            names.append(name)
            for path, text in texts.items():
                file = Path(directory, name, path)
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(text)
        words = [["validate", f"conf={name}"] for name in names]
        outputs = [text.replace(directory, "") for text in pool.map(_here, words, [directory] * len(names))]
        return dict(zip(names, outputs, strict=True))


def mutations(pool: ProcessPoolExecutor) -> Texts:
    made = mutated.mutations(CONF)
    return dict(zip([mutation.name for mutation in made], pool.map(_problems, made), strict=True))


def keys(pool: ProcessPoolExecutor) -> Texts:
    return {name: "\n".join(_keys(name)) for name in ("event", "drive", "control")}


SECTIONS: dict[str, Callable[[ProcessPoolExecutor], Texts]] = {
    "plans": plans,
    "events": events,
    "links": links,
    "drives": drives,
    "validate": validate,
    "keys": keys,
    "mutations": mutations,
}


def _files(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def _inputs(vehicle: str, source: str, bag: Path) -> list[str]:
    """Overrides that some sources need before they can be printed."""
    if source == "bag":
        return [f"source.bag={bag}", "source.topic=/image"]
    if source == "file":
        return [f"source.clip={HERE / '__main__.py'}"]
    return ["source.address=rtsp://192.0.2.1/camera"] if source == "rtsp" else []


# --- running it -------------------------------------------------------------------------------------------------------


def _outputs(pool: ProcessPoolExecutor, words: list[list[str]]) -> Texts:
    names = (" ".join(line).replace(f"{CHECKOUT}/", "") for line in words)
    return dict(zip(names, pool.map(_here, words, chunksize=4), strict=True))


def _here(words: list[str], directory: str = ".") -> str:
    """Status and output of a verb in a directory, in this process: starting Python would take longer."""
    from runner.__main__ import main

    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True) for _ in range(2))
    with contextlib.chdir(directory), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(words)
    return _shown(status, *(stream.buffer.getvalue().decode() for stream in (out, err)))  # type: ignore[attr-defined]


def _prepare() -> None:
    """In each process of the pool: composing takes longest, and text and JSON of a plan share one configuration."""
    from runner.configuration import config

    compose = config.configuration
    shared = lru_cache(maxsize=8)(compose)

    def configuration(overrides: Sequence[str] = (), user: Path | None = None, **options: Any) -> config.Configuration:
        given = {key: value for key, value in options.items() if value is not None}
        return compose(overrides, user, **given) if given else shared(tuple(overrides), user)

    config.configuration = configuration
    gc.freeze()


def _problems(mutation: mutated.Mutation) -> str:
    """File and path of each problem that `validate` finds when a user's file shadows the packaged one."""
    from runner.errors import ConfigError
    from runner.verbs import Arguments
    from runner.verbs import validate as verb

    with tempfile.TemporaryDirectory() as directory:
        file = Path(directory, f"{mutation.file}.yaml")
        file.parent.mkdir()
        file.write_text(mutation.text)
        try:
            with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
                verb.run(Arguments.parse("validate", [f"conf={directory}"]))
        except ConfigError as error:
            found = [f"{problem.file}: {problem.path}" for problem in error.problems]
            return "\n".join(sorted(set(found))).replace(directory, "")
        except Exception as error:
            return f"traceback: {type(error).__name__}"
    return "valid"


def _shown(status: int, out: str, err: str) -> str:
    return f"status {status}\n{out}{err}".replace(f"{CHECKOUT}/", "")


# --- generated events -------------------------------------------------------------------------------------------------


def _events(chance: random.Random, vehicle: str, count: int, story: Story) -> list[dict[str, Any]]:
    cameras = _cameras(vehicle)
    t, made = 0.0, []
    for _ in range(count):
        t = round(t + chance.choice(story.steps), 6)
        made.append({"t": t, **_event(chance, chance.choice(cameras), cameras, story.generated)})
    return made


def _cameras(vehicle: str) -> list[str]:
    text = (CONF / f"vehicle/{vehicle}.yaml").read_text()
    return [line.partition("@cameras.")[2].partition(":")[0] for line in text.splitlines() if "/cameras@" in line]


def _floors(vehicle: str) -> list[str]:
    """Floors that together exceed a low total, with an order in which cameras are given up."""
    mounts = {"floor_kbps": lambda _: 150, "shed": lambda number: number}
    cameras = enumerate((name for name in _cameras(vehicle) if name.islower()), 1)  # not NAME, of a comment
    return [f"cameras.{name}.{key}={value(number)}" for number, name in cameras for key, value in mounts.items()]


def _event(chance: random.Random, camera: str, cameras: list[str], generated: Generators) -> dict[str, Any]:
    """One event; some are refused, since the mode is wrong or a value is out of range."""
    kbps = chance.choice((0, 0.5, 1, 99.9, chance.randrange(20_000), round(chance.uniform(0, 8000), 2)))
    name = chance.choice(list(generated))
    values = generated[name](chance, camera, cameras, kbps)
    return {"event": name.rstrip("+"), **values}


_GENERATED: Generators = {
    "mode_selected": lambda chance, *_: {"mode": chance.choice(("single", "automatic", "collective"))},
    "bitrate_predicted": lambda chance, _camera, _cameras, kbps: {
        "kbps": kbps,
        **({"lower_kbps": round(kbps * chance.uniform(0, 1.2), 1)} if chance.random() < 0.5 else {}),
        **({"valid_s": chance.choice((0, 0.4, 3))} if chance.random() < 0.3 else {}),
    },
    "position_reported": lambda chance, *_: {"lat": 52 + chance.uniform(0, 0.01), "lon": 11 + chance.uniform(0, 0.01)},
    "total_set": lambda _chance, _camera, _cameras, kbps: {"kbps": kbps},
    "camera_switched": lambda chance, camera, *_: {"camera": camera, "on": chance.random() < 0.7},
    "roi_set": lambda chance, camera, *_: {
        "camera": camera,
        "x": chance.randrange(0, 900),
        "y": chance.randrange(0, 500),
        "width": chance.choice((15, 16, 320, 321, 640)),
        "height": chance.choice((16, 240, 241, 480)),
    },
    "camera_configured": lambda chance, camera, _cameras, kbps: {
        "camera": camera,
        "kbps": kbps,
        **({"scaling": chance.choice((0.125, 0.25, 0.5, 1.0))} if chance.random() < 0.5 else {}),
    },
    "weights_set": lambda chance, _camera, cameras, _kbps: {
        "weights": {name: chance.choice((0, 0.5, 1, 3)) for name in chance.sample(cameras, 2)}
    },
    "link_measured": lambda _chance, _camera, _cameras, kbps: {
        "kbps": kbps,
        **{"queue_ms": 0, "loss": 0, "rtt_ms": 60, "state": "clear"},
        "evidence": {"kbit": round(0.04 * kbps, 3), "unqueued": 3},
    },
    "operator_connected": lambda *_: {},
    "operator_disconnected": lambda *_: {},
    "clock_advanced": lambda *_: {},
}


def _measured(chance: random.Random, _camera: str, _cameras: list[str], kbps: float) -> dict[str, Any]:
    return {
        "kbps": kbps,
        "queue_ms": chance.choice((0, 12, 70, 400)),
        "loss": chance.choice((0, 0, 0.02, 0.2)),
        "rtt_ms": chance.choice((10, 60, 900)),
        "state": chance.choice(("clear", "clear", "clear", "filling", "filling", "draining", "stalled")),
        "evidence": _evidence(chance, round(0.04 * kbps, 3)),
    }


def _evidence(chance: random.Random, kbit: float) -> dict[str, Any]:
    found = {
        "kbit": kbit,
        "wait_s": chance.choice((0, 0.012, 0.07, 0.4)),
        "growth": chance.choice((-0.2, 0, 0, 0.5)),
        "lost_kbit": chance.choice((0, 0, 0, 20)),
    }
    told = ({"busy_kbit": kbit, "busy_s": 0.04}, {"idle_kbit": kbit, "idle_s": 0.02, "idle": 2}, {"unqueued": 3})
    return found | chance.choice(told) if kbit else {"silent_s": chance.choice((0, 0.2, 1))}


_ON_A_LINK: Generators = {
    **_GENERATED,
    **{f"link_measured{'+' * n}": _measured for n in range(45)},  # three quarters of the events
    "copies_counted": lambda chance, camera, *_: {"copies": {camera: chance.randrange(1, 4)}},
    "control_passed": lambda chance, *_: {"operator": chance.choice(("a", "b", ""))},
    "attention_changed": lambda chance, *_: {"attention": chance.choice(("watching", "hidden", "absent"))},
    "steering_reported": lambda chance, *_: {"rad": round(chance.uniform(-0.5, 0.5), 3)},
}


# --- keys -------------------------------------------------------------------------------------------------------------


def _keys(name: str) -> Iterator[str]:
    """Every property path of a schema, optional ones marked, references between its parts followed."""
    document = json.loads((SCHEMAS / f"{name}.schema.json").read_text())
    yield from sorted(set(_paths(document, document, "", ())))


def _paths(node: Any, document: Any, path: str, seen: tuple[str, ...]) -> Iterator[str]:
    if isinstance(node, list):
        for entry in node:
            yield from _paths(entry, document, path, seen)
    if not isinstance(node, dict):
        return
    if reference := node.get("$ref"):
        target, home = _target(str(reference), document)
        if reference not in seen:
            yield from _paths(target, home, path, (*seen, reference))
    for key, inner in (node.get("properties") or {}).items():
        yield f"{path}.{key}{'' if key in node.get('required', ()) else '?'}"
        yield from _paths(inner, document, f"{path}.{key}", seen)
    for key in ("allOf", "anyOf", "oneOf", "then", "items", "prefixItems", "additionalProperties"):
        yield from _paths(node.get(key), document, f"{path}[]" if "tems" in key else path, seen)
    if not path:
        for key, inner in (node.get("$defs") or {}).items():
            yield from _paths(inner, document, key, seen)


def _target(reference: str, document: Any) -> tuple[Any, Any]:
    """The target of a reference, in the same schema or in another file of the directory."""
    file, _, pointer = reference.partition("#")
    home = json.loads((SCHEMAS / Path(file).name).read_text()) if file else document
    target = home
    for step in filter(None, pointer.split("/")):
        target = target[step]
    return target, home


if __name__ == "__main__":
    sys.path.insert(0, str(CHECKOUT))
    sys.exit(main(sys.argv[1:]))
