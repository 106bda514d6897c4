"""Builds the operator's `Voice` from plain data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from runner.configuration.graphs import elements
from runner.core.model import ModelError
from runner.settings import Media, Voice
from runner.voice import VoicePlan, compile_voice

VoiceCheck = Callable[[VoicePlan], Iterable[ModelError]]


def read_voice(data: Mapping[str, Any]) -> Voice:
    """From the section `voice` of a configuration that its schema accepts."""
    parts: dict[str, Any] = {key: elements(data[key]) for key in ("operator", "vehicle", "loudspeaker")}
    parts |= {f"wire_{side}": elements(its) for side, its in data["wire"].items()}
    return Voice(**{key: value for key, value in data.items() if key not in ("wire", "defaults")} | parts)


def voice_problems(voice: Voice, media: Media, check: VoiceCheck | None, *, runnable: bool) -> Iterator[ModelError]:
    """What is wrong with it, by key below `voice`; arguments as in `runner.configuration.sound.sound_problems`."""
    try:
        plan = compile_voice(voice, media)
    except ModelError as error:
        yield error
        return
    yield from check(plan) if check else ()
    if runnable and voice.needs_file and voice.file is None:
        yield ModelError("file", "null", "must be given: the file that voice is written to")
