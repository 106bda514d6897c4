"""Mutual authentication of one side and the MQTT broker."""

from __future__ import annotations

import ssl
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from runner.core.roles import Role
from runner.errors import RunError
from runner.security.keyring import AUTHORITY, CERTIFICATE, SECRET, Keyring, mqtt_password

FILES = {"own": CERTIFICATE, "the authority's": AUTHORITY}


class Login:
    """User name, password and TLS settings of a holder of keys. Each connection uses the files as they are then.

    on_report  called with the problem of new files: the previous ones then stay in force; and with certificates that
               expire soon
    raises     UserError if files cannot be used at first
    """

    def __init__(self, keyring: Keyring, on_report: Callable[[str], None]) -> None:
        self._keyring, self._on_report = keyring, on_report
        self._expiring: set[str] = set()  # what was reported of certificates
        self._revoked = keyring.watched_revoked(on_report)
        self._own, self._secret = keyring.watched_certificate(on_report), keyring.watched(SECRET, on_report)
        self._broker, self._used = 0, b""  # in use: serial number of the broker's certificate, own certificate
        self._validity = {whose: keyring.validity(name) for whose, name in FILES.items()}
        self._broker_ends: float | None = None  # s since 1970; None: its certificate was not seen yet
        self.user = keyring.holder.name
        self.context = ssl.create_default_context(cafile=keyring.authority)
        self.context.check_hostname = False  # see `check`
        self.context.minimum_version = ssl.TLSVersion.TLSv1_3
        self.context.verify_flags |= ssl.VerifyFlags.VERIFY_CRL_CHECK_LEAF
        self.refresh()

    def refresh(self) -> str:
        """Load the current certificate, key and revocation list; returns the password.

        raises  OSError, UserError if certificate and key are just being replaced once more
        """
        if self._used != (own := self._own.get()):
            self.context.load_cert_chain(self._keyring.certificate, self._keyring.key)
            self._used = own
            self._validity |= {"own": self._keyring.validity()}
        with suppress(OSError):  # `_revoked` reports it; the list that was loaded before stays in force
            self.context.load_verify_locations(self._keyring.revocation_list)
        return mqtt_password(self._secret.get())

    def check(self, connection: ssl.SSLSocket) -> None:
        """Identify the broker by the role in its certificate, whatever its address.

        raises  RunError, before the password is sent
        """
        certificate: dict[str, Any] = dict(connection.getpeercert() or {})
        subject = dict(pair for entry in certificate.get("subject", ()) for pair in entry)
        if subject.get("organizationalUnitName") != Role.BROKER:
            raise RunError("the peer is not the broker: its certificate has a different role")
        self._broker = int(certificate["serialNumber"], 16)
        self._broker_ends = ssl.cert_time_to_seconds(certificate["notAfter"])
        if self._broker in self._revoked.get():
            raise RunError("the certificate of the broker is revoked")
        self.report_expiring()

    def report_expiring(self) -> None:
        """Report, once each, which certificates expire soon."""
        from runner.security.validity import expiring

        for line in expiring(self.ends(), time.time()):
            if line not in self._expiring:
                self._expiring.add(line)
                self._on_report(f"{line}: `tod-runner keys output=DIR rotate=NAME` renews it")

    def has_changed(self) -> bool:
        """Whether to reconnect: the broker's certificate is revoked, or there are new keys."""
        return self._broker in self._revoked.get() or self._used != self._own.get()

    def invalid(self) -> str | None:
        """Why this side's certificates do not count now, by this machine's clock; None if they do."""
        from runner.security.validity import invalid

        now = time.time()
        found = {whose: invalid(validity, now) for whose, validity in self._validity.items()}
        return next((f"{whose} certificate {why}" for whose, why in found.items() if why), None)

    def ends(self) -> Mapping[str, float]:
        """By whose certificate it is, the time until which it is valid, s since 1970."""
        ends = {whose: validity.ends for whose, validity in self._validity.items()}
        return ends if self._broker_ends is None else ends | {"the broker's": self._broker_ends}
