"""Mutual authentication of one side and the MQTT broker."""

from __future__ import annotations

import ssl
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING

from runner.core.roles import Role
from runner.errors import RunError
from runner.security.keyring import AUTHORITY, CERTIFICATE, SECRET, Keyring, mqtt_password

if TYPE_CHECKING:
    from runner.security.identities import Presented
    from runner.security.validity import Validity

FILES = {"own": CERTIFICATE, "the authority's": AUTHORITY}


class BrokerLogin(ABC):
    """How a side logs in to a broker, and knows it. Each connection uses the files as they are then.

    identity  this side's name in topics; "": it has none
    context   settings of TLS
    demands   what the broker's certificate must be, to say so if it is not: the authority that must have issued it
    source    where user and password come from, to say so if they are refused; "": from the keys, or there are none
    """

    user: str | None = None  # by which the broker knows this side; None: by its certificate, or not at all
    demands, source = "these keys", ""

    def __init__(self, identity: str, context: ssl.SSLContext, on_report: Callable[[str], None]) -> None:
        self.identity, self.context, self._on_report = identity, context, on_report
        self._expiring: set[str] = set()  # what was reported of certificates
        self._validity: dict[str, Validity] = {}
        self._broker: Presented | None = None  # the certificate of the peer; None: not seen yet
        self._broker_ends = 0.0  # when it expires, s since 1970; 0: not seen yet

    @abstractmethod
    def refresh(self) -> str | None:
        """Load the current files; returns the password, None for none.

        raises  OSError, UserError if certificate and key are just being replaced once more
        """

    @abstractmethod
    def has_changed(self) -> bool:
        """Whether to reconnect: the broker's certificate is revoked, or there are new keys."""

    def check(self, connection: ssl.SSLSocket) -> None:
        """Identify the broker, once the handshake has checked its certificate.

        raises  RunError, before the password is sent
        """
        from runner.security.identities import Presented

        self._broker = Presented.of(connection.getpeercert(binary_form=True) or b"")
        if why := self._refusal():
            raise RunError(why)
        ends = (connection.getpeercert() or {})["notAfter"]
        self._broker_ends = float(ssl.cert_time_to_seconds(str(ends)))
        self.report_expiring()

    @abstractmethod
    def _refusal(self) -> str | None:
        """Why the certificate of the peer does not count as the broker's; None if it does, or none was seen yet."""

    def report_expiring(self) -> None:
        """Report, once each, which certificates expire soon."""
        from runner.security.validity import expiring

        for line in expiring(self.ends(), time.time()):
            if line not in self._expiring:
                self._expiring.add(line)
                self._on_report(f"{line}: {self._renewal(line)}")

    def _renewal(self, line: str) -> str:
        """Who or what renews the certificate that a report is about."""
        return "`tod-runner keys output=DIR rotate=NAME` renews it"

    def invalid(self) -> str | None:
        """Why this side's certificates do not count now, by this machine's clock; None if they do."""
        from runner.security.validity import invalid

        now = time.time()
        found = {whose: invalid(validity, now) for whose, validity in self._validity.items()}
        return next((f"{whose} certificate {why}" for whose, why in found.items() if why), None)

    def ends(self) -> Mapping[str, float]:
        """By whose certificate it is, the time until which it is valid, s since 1970."""
        ends = {whose: validity.ends for whose, validity in self._validity.items()}
        return ends | {"the broker's": self._broker_ends} if self._broker_ends else ends


def new_context(oldest: ssl.TLSVersion) -> ssl.SSLContext:
    """Settings of a client, the same for all versions of Python.

    A company's certificates may lack what newer versions demand (VERIFY_X509_STRICT), and need not include its root.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = oldest
    context.verify_flags |= ssl.VerifyFlags.VERIFY_X509_PARTIAL_CHAIN
    return context


class Login(BrokerLogin):
    """User name, password and TLS settings of a holder of keys, for a broker that has keys, too.

    on_report  called with the problem of new files: the previous ones then stay in force; and with certificates that
               expire soon
    raises     UserError if files cannot be used at first
    """

    def __init__(self, keyring: Keyring, on_report: Callable[[str], None]) -> None:
        from runner.security.identities import Identities

        self._keyring = keyring
        self._identities = Identities(keyring, on_report)
        self._own, self._secret = keyring.watched_certificate(on_report), keyring.watched(SECRET, on_report)
        self._used = b""  # own certificate in use
        context = new_context(ssl.TLSVersion.TLSv1_3)
        context.check_hostname = False  # see `_refusal`
        context.load_verify_locations(keyring.authority)
        self._is_listed = not keyring.holder.company  # a company's list expires; `_identities` reads it
        if self._is_listed:
            context.verify_flags |= ssl.VerifyFlags.VERIFY_CRL_CHECK_LEAF
        super().__init__(keyring.holder.name, context, on_report)
        self.user = self.identity
        self._validity = {whose: keyring.validity(name) for whose, name in FILES.items()}
        self.refresh()

    def refresh(self) -> str:
        if self._used != (own := self._own.get()):
            self.context.load_cert_chain(self._keyring.certificate, self._keyring.key)
            self._used = own
            self._validity |= {"own": self._keyring.validity()}
        if self._is_listed:
            with suppress(OSError):  # `_identities` reports it; the list that was loaded before stays in force
                self.context.load_verify_locations(self._keyring.revocation_list)
        return mqtt_password(self._secret.get())

    def has_changed(self) -> bool:
        return self._refusal() is not None or self._used != self._own.get()

    def _refusal(self) -> str | None:
        """By the role of the certificate's holder, whatever its address."""
        holder = self._identities.holder(self._broker) if self._broker else None
        if isinstance(holder, str):
            return f"the peer is not accepted as the broker: {holder}"
        is_other = holder is not None and holder.role is not Role.BROKER
        return "the peer is not the broker: its certificate has a different role" if is_other else None
