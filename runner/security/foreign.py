"""The files with which a side connects to a broker that `tod-runner keys` did not set up."""

from __future__ import annotations

import ssl
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from runner.errors import ConfigError, Problem, UserError
from runner.security.certificates import validity_of
from runner.security.keyring import MOST_BYTES, Keyring
from runner.security.validity import Validity, invalid
from runner.settings import ForeignBroker
from runner.system.files import exposure, read_credentials, read_file


@dataclass(frozen=True, slots=True)
class ForeignFiles:
    """As in `runner.settings.ForeignBroker`, with what the keys have in place of what is not given."""

    ca: Path | None
    credentials: Path | None
    certificate: Path | None
    key: Path | None

    @staticmethod
    def of(foreign: ForeignBroker, keyring: Keyring | None) -> ForeignFiles:
        ca, credentials, certificate, key = (
            Path(given) if given else None
            for given in (foreign.ca, foreign.credentials, foreign.certificate, foreign.key)
        )
        if keyring:
            ca = ca or keyring.authority
            if not credentials and not certificate:
                certificate, key = keyring.certificate, keyring.key
        return ForeignFiles(ca, credentials, certificate, key or certificate)

    def check(self) -> None:
        """raises ConfigError with the problems of all files"""
        if problems := list(self._problems()):
            raise ConfigError(problems)

    def login(self) -> tuple[str, str]:
        """User and password; raises UserError"""
        assert self.credentials
        try:
            return read_credentials(self.credentials)
        except ValueError as error:
            raise _FileError("credentials", self.credentials, error) from None

    def own(self) -> bytes:
        """The certificate that this side presents; raises UserError if it and its key cannot be used."""
        assert self.certificate
        assert self.key
        content = _read("certificate", self.certificate)
        _read("key", self.key)
        try:
            exposed = exposure(self.key)
            self.present(ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT))
        except ValueError as error:
            raise _FileError("key", self.key, error) from None
        except OSError as error:  # ssl.SSLError among them
            rule = f"must be a certificate (PEM) with the key of {self.key}, which has no passphrase: {error}"
            raise _FileError("certificate", self.certificate, rule) from None
        if exposed:
            raise _FileError("key", self.key, exposed)
        return content

    def present(self, context: ssl.SSLContext) -> None:
        """raises OSError"""
        assert self.certificate
        context.load_cert_chain(self.certificate, self.key, password="")  # without, OpenSSL asks at the terminal

    def trust(self, context: ssl.SSLContext) -> None:
        """Load the certificates that the broker's must be issued by; a revocation list among them then counts.

        raises  OSError
        """
        if self.ca is None:
            context.load_default_certs()
            return
        context.load_verify_locations(self.ca)
        if context.cert_store_stats()["crl"]:
            context.verify_flags |= ssl.VerifyFlags.VERIFY_CRL_CHECK_LEAF

    def validity(self) -> Validity:
        """Of the certificate that this side presents."""
        assert self.certificate
        try:
            return validity_of(_read("certificate", self.certificate))
        except ValueError:
            raise _FileError("certificate", self.certificate, "must contain a certificate (PEM)") from None

    def _problems(self) -> Iterator[Problem]:
        for check in (self._check_authority, self._check_login, self._check_own, self._check_term):
            try:
                check()
            except _FileError as error:
                yield error.problem

    def _check_authority(self) -> None:
        if self.ca is None:
            return
        _read("ca", self.ca)
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        with suppress(OSError):
            self.trust(context)
        if not context.cert_store_stats()["x509"]:
            raise _FileError("ca", self.ca, "must contain certificates of the broker's authority (PEM)")

    def _check_login(self) -> None:
        if self.credentials:
            self.login()

    def _check_own(self) -> None:
        if self.certificate:
            self.own()

    def _check_term(self) -> None:
        if self.certificate and (why := invalid(self.validity(), time.time())):
            raise _FileError("certificate", self.certificate, why)


class _FileError(UserError):
    def __init__(self, name: str, path: Path, rule: object) -> None:
        self.problem = Problem("", f"control.{name}", str(path), str(rule))
        super().__init__("", f"control.{name}", str(path), str(rule))


def _read(name: str, path: Path) -> bytes:
    try:
        return read_file(path, MOST_BYTES)
    except ValueError as error:
        raise _FileError(name, path, error) from None
