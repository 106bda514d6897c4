"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from runner.errors import RunError, UserError


@contextmanager
def whole_file(path: Path, argument: str = "output", *, partly: bool = False) -> Iterator[TextIO]:
    """A text file for `argument` of the command line, written under another name and put in its place at the end.

    What is there and no file, such as /dev/null, is written to as it is. What was there before stays where the writing
    ends early.

    partly  keep what was written before a mistake in the input, a UserError
    raises  UserError where it cannot be opened, RunError where it cannot be written
    """
    try:
        special = path.exists() and not path.is_file()
        unfinished = path if special else path.with_name(f".{path.name}.{os.getpid()}")
        file = unfinished.open("w", encoding="utf-8")
    except OSError as error:
        raise UserError("command line", argument, repr(str(path)), (error.strerror or "").lower()) from None
    keep = False
    try:
        with file:
            try:
                yield file
            except UserError:
                keep = partly
                raise
        keep = True
    except BrokenPipeError:
        raise
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {(error.strerror or str(error)).lower()}") from None
    finally:
        if not special and keep:
            unfinished.replace(path)
        elif not special:
            unfinished.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes) -> None:
    """A file that is there wholly or not at all.

    raises  RunError
    """
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(content)
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise RunError(f"{path}: cannot be written: {(error.strerror or str(error)).lower()}") from None
