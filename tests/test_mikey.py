"""Messages with keys of SRTP, as GStreamer 1.22 and 1.28 write them."""

from __future__ import annotations

import base64

import pytest

from runner.gst.mikey import in_one_piece

pytestmark = pytest.mark.gst  # the package runner.gst loads it

KEY, SALT = bytes(range(16)), bytes(range(16, 30))
# A header with one crypto session, time, random bytes and policy, as both write them.
BEFORE = bytes.fromhex(
    "01000500b492eda701000012345678000000000b00eeb7ac2b5dbc44bf0a106b2e95416c99311ba2deb9254baab08a"
    "010000001500010101011002010103010a0701010801010a0101"
)
ONE_PIECE = BEFORE + bytes.fromhex("000000220020001e") + KEY + SALT + b"\0"
APART = BEFORE + bytes.fromhex("0000002400300010") + KEY + bytes.fromhex("000e") + SALT + b"\0"


def encoded(message):
    return base64.b64encode(message).decode()


@pytest.mark.parametrize("given", [ONE_PIECE, APART])
def test_key_and_salt_are_one_piece(given):
    assert in_one_piece(encoded(given)) == encoded(ONE_PIECE)


def test_incomplete_messages_stay_as_they_are():
    for length in range(len(APART) - 1):
        assert in_one_piece(encoded(APART[:length])) == encoded(APART[:length])


def test_encrypted_keys_stay_as_they_are():
    given = encoded(APART.replace(bytes.fromhex("00000024"), bytes.fromhex("00010024")))
    assert in_one_piece(given) == given


def test_other_payloads_stay_as_they_are():
    given = encoded(APART[:2] + bytes([99]) + APART[3:])
    assert in_one_piece(given) == given
