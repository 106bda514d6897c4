"""Builds the vehicle's `Sound` from plain data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from runner.configuration.graphs import elements
from runner.core.model import ModelError
from runner.settings import Media, Sound
from runner.sound import SoundPlan, compile_sound
from runner.system.files import file_problem

SoundCheck = Callable[[SoundPlan], Iterable[ModelError]]


def read_sound(data: Mapping[str, Any]) -> Sound:
    """From the section `sound` of a configuration that its schema accepts."""
    parts: dict[str, Any] = {key: elements(data[key]) for key in ("source", "vehicle", "operator")}
    parts |= {f"wire_{side}": elements(its) for side, its in data["wire"].items()}
    return Sound(**{key: value for key, value in data.items() if key not in ("wire", "defaults")} | parts)


def sound_problems(
    sound: Sound, media: Media, check: SoundCheck | None, *, runnable: bool, files: bool
) -> Iterator[ModelError]:
    """What is wrong with it, by key below `sound`.

    check     against a registry of elements; None: it is not checked
    runnable  whether all that a run needs must be given
    files     whether its file must be readable
    """
    try:
        plan = compile_sound(sound, media)
    except ModelError as error:
        yield error
        return
    yield from check(plan) if check else ()
    if not sound.needs_clip:
        return
    if sound.clip is None:
        if runnable:
            yield ModelError("clip", "null", "must be given: the file that is played")
    elif files and (why := file_problem(Path(sound.clip))):
        yield ModelError("clip", repr(sound.clip), why)
