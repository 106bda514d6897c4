"""Messages of the control link as they are received: size, form, and that threads may read them at the same time."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from textwrap import dedent
from typing import Any

import pytest

from runner.mqtt.messages import MAX_ID, MAX_REQUEST_BYTES, MqttMessage, is_online, read_message, read_request
from runner.schema import event_problem, message_problem


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


def test_of_other_vehicles_states_only_whether_they_are_online_is_read() -> None:
    """One that is hostile could otherwise occupy every operator of the fleet."""
    hostile = json.dumps({"online": False, **{f"k{n}": n for n in range(100_000)}}).encode()
    began = time.process_time()
    states = (b'{"online": false}', b'{"online": true}', hostile)
    assert list(map(is_online, states)) == [False, True, True]
    assert time.process_time() - began < 0.01
    with pytest.raises(ValueError, match="not JSON"):
        is_online(b"")


HOSTILE_KEYS = {f"key{n}": 0 for n in range(5000)} | {"x" * 10_000: 0, "a\x1b[2Jb": 0}


@pytest.mark.parametrize("problem", [event_problem, lambda document: message_problem("reception", document)])
def test_a_hostile_document_is_explained_quickly_and_briefly(problem: Callable[[Any], str | None]) -> None:
    began = time.process_time()
    text = problem({"event": "operator_connected", "t": 0, **HOSTILE_KEYS})
    assert time.process_time() - began < 0.5  # 20 times what it takes
    assert text
    assert len(text) < 5000


@pytest.mark.parametrize("sender", ["", "anyone else", "x" * 65, "a\n"])
@pytest.mark.parametrize("payload", [b'{"id": "1", "as_of": 0, "event": "operator_connected"}', b"invalid"])
def test_a_request_of_an_invalid_sender_is_dropped(sender: str, payload: bytes) -> None:
    """The vehicle itself is "", whose requests are all answered."""
    with pytest.raises(ValueError, match="topic: an operator's id must be 1 to 64 letters, digits, _ and -"):
        read_request(MqttMessage(f"tod/car/request/{sender}", payload, False))


def test_an_id_that_its_reply_would_repeat_has_a_limited_length() -> None:
    def problem(identity: str) -> str | None:
        payload = json.dumps({"id": identity, "event": "total_set", "kbps": 1, "as_of": 0}).encode()
        return read_request(MqttMessage("tod/car/request/alice", payload, False)).problem

    assert problem("x" * MAX_ID) is None
    assert problem("x" * (MAX_ID + 1)) == problem("") == "id: must be given, as text of 1 to 128 characters"


@pytest.mark.parametrize(
    ("event", "rule"),
    [
        ({"event": "bitrate_predicted", "kbps": 1e305}, "kbps: 1e+305: must be at most 1e+09"),
        ({"event": "bitrate_predicted", "kbps": 1, "lower_kbps": 1e10}, "lower_kbps: 1e+10: must be at most 1e+09"),
        ({"event": "bitrate_predicted", "kbps": 0, "valid_s": 1e300}, "valid_s: 1e+300: must be at most 3600"),
        ({"event": "total_set", "kbps": 10**299}, "kbps: 1e+299: must be at most 1e+09"),
        ({"event": "weights_set", "weights": {"front": 1e305}}, "weights.front: 1e+305: must be at most 1e+06"),
        ({"event": "bitrate_predicted", "kbps": 1e9, "valid_s": 3600}, None),
    ],
)
def test_numbers_that_no_operator_could_read_again_are_refused(event: dict[str, Any], rule: str | None) -> None:
    payload = json.dumps({"id": "1", "as_of": 0, **event}).encode()
    assert read_request(MqttMessage("tod/car/request/alice", payload, False)).problem == rule
    assert event_problem({"t": 0, **event}) is None, "older drives remain readable"


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


@pytest.mark.parametrize(("key", "value"), [("operator", "alice"), ("role", "supervisor"), ("departure", "signed off")])
def test_nobody_says_in_a_request_who_it_is(key: str, value: str) -> None:
    document = {"id": "1", "as_of": 1.0, "event": "control_requested", key: value}
    request = read_request(MqttMessage("tod/car/request/bob", json.dumps(document).encode(), False))
    assert request.problem == f"{key}: must not be given, the vehicle takes it from the topic"
