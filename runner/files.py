"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from runner.errors import RunError, UserError


@contextmanager
def whole_file(path: Path, argument: str = "output", *, also_after_errors: bool = False) -> Iterator[TextIO]:
    """A text file for `argument` of the command line, written under another name and put in its place at the end.

    What is there and no file, such as /dev/null, is written to as it is. After an error what was there before stays,
    unless what was written so far is wanted all the same.

    raises  UserError where it cannot be written
    """
    special = path.exists() and not path.is_file()
    unfinished = path if special else path.with_name(f".{path.name}.{os.getpid()}")
    try:
        file = unfinished.open("w", encoding="utf-8")
    except OSError as error:
        raise UserError("command line", argument, repr(str(path)), (error.strerror or "").lower()) from None
    done = False
    try:
        with file:
            yield file
        done = True
    finally:
        if not special and (done or also_after_errors):
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
