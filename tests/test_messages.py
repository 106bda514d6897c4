"""Messages of the control link as they are received: size, form."""

from __future__ import annotations

import json

import pytest

from runner.mqtt.messages import MAX_REQUEST_BYTES, read_message


def padded(size: int) -> bytes:
    """A request of that many bytes."""
    bare = json.dumps({"id": "1", "event": ""}).encode()
    return bare.replace(b'""', b'"' + b"x" * (size - len(bare)) + b'"')


def test_a_request_has_a_limited_size() -> None:
    assert read_message(padded(MAX_REQUEST_BYTES))["id"] == "1"
    with pytest.raises(ValueError, match=r"^65537 bytes: must be at most 65536$"):
        read_message(padded(MAX_REQUEST_BYTES + 1))


@pytest.mark.parametrize(
    ("payload", "problem"), [(b"{", "not JSON: "), (b"[1]", "must be a mapping with id and event"), (b"", "not JSON: ")]
)
def test_an_invalid_message_is_refused(payload: bytes, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        read_message(payload)
