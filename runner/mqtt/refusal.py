"""Why a broker's address gave no control link, in words. Pure."""

from __future__ import annotations

import ssl

from runner.schema import shortened
from runner.security.exposure import is_loopback
from runner.settings import Endpoint

SILENT = "accepts connections but does not answer"
NO_TLS = "does not speak TLS: a broker without keys, or another program"
NEEDS_TLS = "expects TLS: give keys=DIR, made by `tod-runner keys`"
CONNACK = b"\x20\x02"  # MQTT 3.1.1, section 3.2: how a broker's first packet begins
TLS_RECORDS = (b"\x15\x03", b"\x16\x03")  # RFC 8446, section 5.1: an alert, a handshake
PROGRAMS = {b"HTTP/": "an HTTP server", b"SSH-": "an SSH server", b"RTSP/": "an RTSP server"}
# X509_V_ERR_... of OpenSSL, about the broker's certificate.
CERTIFICATE = {
    7: "the broker's certificate is of another authority than {demands}",  # of the same name
    9: "the broker's certificate is not valid yet, by this machine's clock",
    10: "the broker's certificate has expired, by this machine's clock",
    11: "the revocation list is not valid yet, by this machine's clock",
    12: "the revocation list has expired, by this machine's clock",
    18: "the broker's certificate is of another authority than {demands}",
    19: "the broker's certificate is of another authority than {demands}",
    20: "the broker's certificate is of another authority than {demands}",
    3: "no revocation list of the authority that issued the broker's certificate is in {demands}",
    23: "the broker's certificate is revoked",
    62: "control.host is not in the broker's certificate, which must name it",
    64: "control.host is not in the broker's certificate, which must name it",
}
# Alerts (RFC 8446, section 6.2) by which a broker refuses this side, as in the names of OpenSSL's errors.
ALERTS = {
    "CERTIFICATE_EXPIRED": "the broker refuses this side's certificate as expired, by the broker's clock",
    "CERTIFICATE_REVOKED": "the broker refuses this side's certificate as revoked",
    "UNKNOWN_CA": "the broker's keys are of another authority than this side's certificate",
    "BAD_CERTIFICATE": "the broker refuses this side's certificate",
    "CERTIFICATE_REQUIRED": "the broker demands a certificate",
}


def of_failure(error: BaseException | None, demands: str | None) -> str:
    """Why no connection came about, up to and with the TLS handshake.

    demands  the authority that must have issued the broker's certificate; None: this side does not speak TLS
    """
    if isinstance(error, ssl.SSLCertVerificationError):
        other = f"the broker's certificate is refused: {error.verify_message}"
        return CERTIFICATE.get(error.verify_code, other).replace("{demands}", str(demands))
    if isinstance(error, TimeoutError) and "handshake" in str(error):
        return SILENT
    if isinstance(error, ssl.SSLError):
        return _of_alert(error) or NO_TLS
    return NO_TLS if demands and isinstance(error, ConnectionResetError) else str(_text(error)).lower()


def of_end(heard: bytes, error: OSError | None, silent: bool, tls: bool) -> str:
    """Why a connection ended before this side could listen.

    heard   what arrived first
    error   of the socket; None: the peer closed the connection, or was silent
    silent  whether this side gave up waiting
    tls     whether this side spoke TLS
    """
    if heard.startswith(CONNACK):
        return "the broker ended the connection when this side subscribed"
    if not tls and heard.startswith(TLS_RECORDS):
        return NEEDS_TLS
    if heard:
        words = (who for begin, who in PROGRAMS.items() if heard.startswith(begin))
        return f"{next(words, f'another program, which says {shortened(repr(heard))},')} answers there, not a broker"
    if isinstance(error, ssl.SSLError) and (alert := _of_alert(error)):
        return alert
    if silent:
        return SILENT
    hint = "the broker refuses this side's keys" if tls else "no MQTT broker, or one that expects TLS and keys"
    return f"the connection was closed without an answer: {hint}"


def remedy(error: BaseException | None, broker: Endpoint) -> str:
    """What to do about it, in parentheses; "" if the reason says it."""
    if not isinstance(error, ConnectionRefusedError):
        return ""
    if is_loopback(broker.host):
        return f" (start one on this machine: mosquitto -p {broker.port})"
    return " (does one run there, reachable from other machines? See docs/deployment.md)"


def _of_alert(error: ssl.SSLError) -> str | None:
    """What the broker refuses; None: it sent no alert."""
    reason = error.reason or ""
    if "_ALERT_" not in reason:
        return None
    alert = reason.rpartition("_ALERT_")[2]
    return ALERTS.get(alert, f"the broker refuses the TLS connection: {alert.replace('_', ' ').lower()}")


def _text(error: BaseException | None) -> object:
    return getattr(error, "strerror", None) or error
