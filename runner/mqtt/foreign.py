"""Login at a broker that `tod-runner keys` did not set up, such as a company's."""

from __future__ import annotations

import ssl
from collections.abc import Callable
from contextlib import suppress

from runner.mqtt.login import BrokerLogin, new_context
from runner.mqtt.messages import OPERATOR
from runner.security.foreign import ForeignFiles
from runner.security.keyring import REVOKED, Keyring, Watched, version_of
from runner.settings import ForeignBroker


class ForeignLogin(BrokerLogin):
    """User name, password and certificate for a broker that proves its name by a certificate of its authority.

    keyring    of this side; None: its name is that of the broker's user
    on_report  called with the problem of new files: the previous ones then stay in force; and with certificates that
               expire soon
    raises     UserError if files cannot be used at first
    """

    def __init__(self, foreign: ForeignBroker, keyring: Keyring | None, on_report: Callable[[str], None]) -> None:
        self._files = files = ForeignFiles.of(foreign, keyring)
        self._own = Watched(files.certificate, files.own, on_report) if files.certificate else None
        self._used = b""  # own certificate in use
        self._trusted: tuple[int, int, int] | None = None  # version of the authority's certificates in use
        self._logins = Watched(files.credentials, files.login, on_report) if files.credentials else None
        listed = keyring is not None and files.ca == keyring.authority and (keyring.directory / REVOKED).exists()
        self._revoked = keyring.watched_revoked(on_report) if keyring and listed else None
        super().__init__("", new_context(ssl.TLSVersion.TLSv1_2), on_report)
        self.demands = str(files.ca or "the system's authorities")
        if files.credentials:
            self.source = f" (user and password are those of {files.credentials})"
        self._is_of_keys = keyring is not None and files.certificate == keyring.certificate
        self.refresh()
        self.identity = keyring.holder.name if keyring else self._named()

    def refresh(self) -> str | None:
        files = self._files
        if self._own and self._used != (own := self._own.get()):
            files.present(self.context)
            self._used = own
            self._validity = {"own": files.validity()}
        version = version_of(files.ca) if files.ca else (0, 0, 0)
        if self._trusted != version:
            with suppress(OSError):  # what was loaded before stays in force
                files.trust(self.context)
                self._trusted = version
        if self._logins is None:
            return None
        self.user, password = self._logins.get()
        return password

    def has_changed(self) -> bool:
        is_new = self._own is not None and self._used != self._own.get()
        return is_new or self._refusal() is not None

    def _refusal(self) -> str | None:
        """The handshake has compared the names in the certificate with the host that was connected to."""
        if self._broker and self._revoked and self._broker.serial in self._revoked.get():
            return "the certificate of the broker is revoked"
        return None

    def _renewal(self, line: str) -> str:
        if not line.startswith("own "):
            return "whoever runs the broker renews it"
        return super()._renewal(line) if self._is_of_keys else f"renew {self._files.certificate}"

    def _named(self) -> str:
        """The user, if topics may contain it."""
        return self.user if self.user and OPERATOR.fullmatch(self.user) else ""
