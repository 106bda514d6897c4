"""Measured points on disk, and what becomes of files that cannot be used."""

from __future__ import annotations

import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from runner.rate_quality.cache import Cache


@contextmanager
def no_more_files() -> Iterator[None]:
    """No file can be opened meanwhile."""
    free = os.open(os.devnull, os.O_RDONLY)
    os.close(free)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (free, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_file_that_cannot_be_read_for_a_moment_is_kept(tmp_path: Path) -> None:
    warnings: list[str] = []
    cache = Cache(tmp_path, warnings.append)
    cache.store("key", {"kbps": 1})
    with no_more_files():
        assert cache.load("key") is None
    assert warnings == [f"{tmp_path / 'key.json'}: cannot be read (too many open files), measured again"]
    assert cache.load("key") == {"kbps": 1}


@pytest.mark.parametrize(
    "content, expected",
    [
        (b"{", "cannot be read ("),
        (b"\xff", "cannot be read ("),
        (b"[" * 100_000, "cannot be read ("),
        (b'{"digest": "0", "document": {}}', "is damaged, "),
    ],
)
def test_a_file_without_use_is_reported_once(tmp_path: Path, content: bytes, expected: str) -> None:
    warnings: list[str] = []
    cache = Cache(tmp_path, warnings.append)
    (tmp_path / "key.json").write_bytes(content)
    assert (cache.load("key"), cache.load("key")) == (None, None)
    (warning,) = warnings
    assert warning.startswith(f"{tmp_path / 'key.json'}: {expected}")
