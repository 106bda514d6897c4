"""What the broker's log says about clients that it refuses."""

from __future__ import annotations

import pytest

from runner.mqtt.broker import refusal

EXPIRED = "SSL routines::certificate verify failed"


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (f"Client connection from 192.0.2.7 failed: error:0A000086:{EXPIRED}.", ("192.0.2.7", EXPIRED)),
        (f"OpenSSL Error[0]: error:0A000086:{EXPIRED}", (None, EXPIRED)),
        ("Client <unknown> disconnected, not authorised.", (None, "not authorised")),
        ("Client auto-1-2 disconnected, not authorised.", (None, "not authorised")),
        ("OpenSSL Error[0]: error:0A000126:SSL routines::unexpected eof while reading", None),
        (f"OpenSSL Error while trying to get the error[0]: error:0A000086:{EXPIRED}", (None, EXPIRED)),
        ("Client auto-1-2 [192.0.2.7:51798] disconnected: not authorised.", ("192.0.2.7", "not authorised")),
        ("Client auto-1-2 [192.0.2.7:51798] disconnected: connection closed by client.", None),
        ("Client alice disconnected.", None),
    ],
)
def test_a_reason_is_the_same_however_it_is_worded(line: str, expected: tuple[str | None, str] | None) -> None:
    """Otherwise it would be reported twice."""
    assert refusal(line) == expected
