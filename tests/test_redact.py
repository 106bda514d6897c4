"""What is printed shows no password, and obeys nobody who sent it."""

from __future__ import annotations

import pytest

from runner.errors import Problem, RunError
from runner.redact import printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("rtsp://user:secret@camera/1", "rtsp://camera/1"),
        ("rtsp://user:se#cret@camera/1#top", "rtsp://camera/1#top"),
        ("rtsp://user:se@cr@et@camera", "rtsp://camera"),
        ("RTSP://us er:se cret@camera/1", "RTSP://camera/1"),
        ("rtsp://camera/1 of me@example.org", "rtsp://camera/1 of me@example.org"),
        ("rtsp://camera/a@b?c=d@e", "rtsp://camera/a@b?c=d@e"),
        ("rtsp://camera\nof me@example.org", "rtsp://camera\nof me@example.org"),
        ("a\x1b[2Jb\x07\r\x9b", "a\\x1b[2Jb\\x07\\r\\x9b"),
        ("left \u202eright", "left \\u202eright"),
        ("two\nlines\tand ü, 日本, 🚗", "two\nlines\tand ü, 日本, 🚗"),
    ],
)
def test_a_message_may_be_printed(text: str, shown: str) -> None:
    assert printable(text) == shown
    assert str(RunError(text)) == shown
    assert str(Problem("file.yaml", "a", text, "must be text")) == f"file.yaml: a: {shown}: must be text"
