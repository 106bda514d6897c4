"""Messages of the control link as they are received: size, form, and that threads may read them at the same time."""

from __future__ import annotations

import json
import subprocess
import sys
from textwrap import dedent

import pytest

from runner.mqtt.messages import MAX_REQUEST_BYTES, read_message


def padded(size: int) -> bytes:
    """A request of `size` bytes."""
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


def test_records_can_be_parsed_by_several_threads_at_first_use() -> None:
    """In a process of its own, which would crash."""
    program = dedent(
        """\
        import sys, threading
        from dataclasses import make_dataclass
        from runner.records import from_json
        sys.setswitchinterval(1e-6)
        for number in range(200):
            inner = make_dataclass(f"Inner{number}", [(f"field{i}", float) for i in range(8)])
            outer = make_dataclass(f"Outer{number}", [("inner", inner), ("inners", dict[str, inner])])
            document = {f"field{i}": 1.0 for i in range(8)}
            start = threading.Barrier(4)
            def read(odd):
                start.wait()
                from_json(outer, {"inner": document, "inners": {}}) if odd else from_json(inner, document)
            threads = [threading.Thread(target=read, args=(i % 2,)) for i in range(4)]
            for thread in threads: thread.start()
            for thread in threads: thread.join()
        """
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("text", [b'"\\ud800"', b'"\\uDFFF x"', b'"\\ude00\\ud83d"'])
def test_text_that_is_not_unicode_is_refused(text: bytes) -> None:
    """It cannot be printed: one message would end the operator's side."""
    with pytest.raises(ValueError, match="contains half of a surrogate pair"):
        read_message(b'{"online": [' + text + b"]}")


@pytest.mark.parametrize("payload", [b'{"a": "\xed\xa0\x80"}', '{"a": "\\ud800"}'.encode("utf-16"), b'{"a": "\xff"}'])
def test_only_utf_8_is_json(payload: bytes) -> None:
    with pytest.raises(ValueError, match="not JSON: "):
        read_message(payload)


def test_pairs_are_one_character() -> None:
    assert read_message(b'{"a": "\\ud83d\\ude00 \xf0\x9f\x98\x80"}') == {"a": "\U0001f600 \U0001f600"}
