"""Atomic writes, size-limited reads, and a file from another package."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from shutil import rmtree
from typing import TextIO

from runner.errors import ArgumentError, RunError, UserError, os_errors_as, reason
from runner.system.signals import urgent

MAX_LINKS = 40  # as the kernel follows
ABSENT = (errno.ENOENT, errno.ENOTDIR, errno.ELOOP)
MOST_CREDENTIALS = 1000  # bytes of a file with user and password


def flush(path: Path) -> None:
    """Flush a file or a directory to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # some file systems cannot flush directories
            raise
    finally:
        os.close(descriptor)


def put_in_place(part: Path, path: Path) -> None:
    """Name a finished file or directory: even after a power failure, it is complete or still the previous one."""
    flush(part)
    part.replace(path)
    flush(path.parent)


@contextmanager
def unfinished(path: Path) -> Iterator[Path]:
    """A temporary path to write to; the finished file replaces `path`, an unfinished one is removed."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    with urgent(lambda: part.unlink(missing_ok=True)):
        try:
            yield part
            put_in_place(part, path)
        finally:
            part.unlink(missing_ok=True)


@contextmanager
def unfinished_directory(path: Path) -> Iterator[Path]:
    """Like `unfinished`, for a directory, which the caller creates at the path given."""
    above = path.with_name(f".{path.name}.{os.getpid()}")
    with urgent(lambda: rmtree(above, ignore_errors=True)):
        try:
            above.mkdir()
            yield above / path.name
            for each in (above / path.name).rglob("*"):
                flush(each)
            put_in_place(above / path.name, path)
        finally:
            rmtree(above, ignore_errors=True)


@contextmanager
def whole_file(path: Path, argument: str = "output", *, partly: bool = False) -> Iterator[TextIO]:
    """A text file for `argument` of the command line, written atomically.

    An existing path that is not a file, such as /dev/null, is written to directly, and one that names an open file of
    this process, such as /dev/stdout, from that file's position on. An existing file is kept if writing ends early; a
    symbolic link leads to the file that is replaced.

    partly  keep the output written before a UserError, an error in the input
    raises  UserError if it cannot be opened, RunError if it cannot be written
    """
    user_error = None
    try:
        descriptor = _descriptor(path)
        special = descriptor is not None or (path.exists() and not path.is_file())
        with (
            nullcontext(path) if special else unfinished(Path(os.path.realpath(path))) as part,
            _opened(part, path, argument, descriptor) as file,
        ):
            try:
                yield file
            except UserError as error:
                if not partly:
                    raise
                user_error = error
    except BrokenPipeError:
        raise
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {reason(error)}") from None
    if user_error:
        raise user_error


def _descriptor(path: Path) -> int | None:
    """The number of this process's open file that a path names; None: it names none."""
    for _ in range(MAX_LINKS):
        if not path.is_symlink():
            break
        if os.path.realpath(path.parent) == f"/proc/{os.getpid()}/fd":  # also as /dev/fd
            return int(path.name)
        path = path.parent / path.readlink()
    return None


def _opened(part: Path, path: Path, argument: str, descriptor: int | None) -> TextIO:
    with os_errors_as(partial(ArgumentError, argument, path)):
        if descriptor is not None:
            return os.fdopen(os.dup(descriptor), "w", encoding="utf-8")
        return part.open("w", encoding="utf-8")


def file_problem(path: Path) -> str | None:
    """Why a path names no regular file but, for example, nothing, a device or a directory; None if it does."""
    return _problem(path, stat.S_ISREG, "file")


def directory_problem(path: Path) -> str | None:
    """Why a path names no directory; None if it does."""
    return _problem(path, stat.S_ISDIR, "directory")


def _problem(path: Path, fits: Callable[[int], bool], kind: str) -> str | None:
    """Path.is_file and the like say no, from Python 3.14 on, where permission is denied."""
    try:
        return None if fits(path.stat().st_mode) else f"must be a {kind}"
    except OSError as error:
        return f"no such {kind}" if error.errno in ABSENT else reason(error)
    except ValueError:  # a name with a null character
        return f"no such {kind}"


def read_file(path: Path, most_bytes: int) -> bytes:
    """Content of a regular file of limited size.

    raises  ValueError with the rule that it breaks
    """
    with os_errors_as(ValueError):
        if why := file_problem(path):
            raise ValueError(why)
        with path.open("rb") as file:
            content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise ValueError(f"must be at most {most_bytes // 1000} kB long")
    return content


def exposure(path: Path) -> str | None:
    """What is wrong with the mode of a file that only its owner may read; None if nothing is.

    raises  ValueError with the reason why it has no mode, such as: no such file
    """
    with os_errors_as(ValueError):
        mode = path.stat().st_mode
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        return f"others may read it (mode {stat.S_IMODE(mode):o}); chmod 600"
    return None


def read_credentials(path: Path) -> tuple[str, str]:
    """User and password, from a file with one line user:password.

    raises  ValueError with the rule that the file breaks
    """
    lines = read_file(path, MOST_CREDENTIALS).decode(errors="replace").splitlines()
    if exposed := exposure(path):
        raise ValueError(exposed)
    user, _, password = lines[0].partition(":") if len(lines) == 1 else ("", "", "")
    if not user or not password:
        raise ValueError("must contain one line user:password")
    return user, password


def write_whole(path: Path, content: bytes, *, secret: bool = False) -> None:
    """Write a file atomically.

    secret  only its owner may ever read it
    raises  RunError
    """
    with os_errors_as(lambda why: RunError(f"{path}: cannot be written: {why}")):
        path.parent.mkdir(parents=True, exist_ok=True)
        with unfinished(path) as part:
            if secret:
                part.touch(0o600, exist_ok=False)
            part.write_bytes(content)


def plotly_script(extra: str) -> Path:
    """The JavaScript file in plotly's wheel.

    extra   of this package, which installs it
    raises  RunError
    """
    spec = find_spec("plotly")
    if spec is None or spec.origin is None:
        from runner.system.extras import how_to_install

        raise RunError(f"the Python module plotly is not installed: {how_to_install(extra)}")
    return Path(spec.origin).parent / "package_data" / "plotly.min.js"
