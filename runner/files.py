"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TextIO

from runner.errors import RunError, UserError


@contextmanager
def unfinished(path: Path) -> Iterator[Path]:
    """Another name to write a file under; what is there at the end takes its place, what ends early is removed."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def whole_file(path: Path, argument: str = "output", *, partly: bool = False) -> Iterator[TextIO]:
    """A text file for `argument` of the command line, there when it is whole.

    What is there and no file, such as /dev/null, is written to as it is. What was there before stays where the writing
    ends early.

    partly  keep what was written before a mistake in the input, a UserError
    raises  UserError where it cannot be opened, RunError where it cannot be written
    """
    mistake = None
    try:
        special = path.exists() and not path.is_file()
        with nullcontext(path) if special else unfinished(path) as part, _opened(part, path, argument) as file:
            try:
                yield file
            except UserError as error:
                if not partly:
                    raise
                mistake = error
    except BrokenPipeError:
        raise
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {(error.strerror or str(error)).lower()}") from None
    if mistake:
        raise mistake


def _opened(part: Path, path: Path, argument: str) -> TextIO:
    try:
        return part.open("w", encoding="utf-8")
    except OSError as error:
        raise UserError("command line", argument, repr(str(path)), (error.strerror or "").lower()) from None


def why_no_file(path: Path) -> str:
    """The rule that a path breaks which names no file; /dev/zero and directories are there and none."""
    return "must be a file" if path.exists() else "no such file"


def write_whole(path: Path, content: bytes) -> None:
    """A file that is there wholly or not at all.

    raises  RunError
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with unfinished(path) as part:
            part.write_bytes(content)
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {(error.strerror or str(error)).lower()}") from None
