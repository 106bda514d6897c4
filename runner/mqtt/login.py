"""How one side proves to the broker who it is, and how it knows the broker."""

from __future__ import annotations

import ssl
from typing import Any

from runner.core.roles import Role
from runner.errors import RunError
from runner.security.keyring import Keyring, mqtt_password


class Login:
    """User name, password and TLS settings of a holder of keys. The files are read again for each connection."""

    def __init__(self, keyring: Keyring) -> None:
        self._keyring = keyring
        self.user = keyring.holder.name
        self.context = ssl.create_default_context(cafile=keyring.authority)
        self.context.check_hostname = False  # see `check`
        self.context.minimum_version = ssl.TLSVersion.TLSv1_3
        self.context.verify_flags |= ssl.VerifyFlags.VERIFY_CRL_CHECK_LEAF
        self.refresh()

    def refresh(self) -> str:
        """Load certificate, key and revocation list as they are now; returns the password.

        raises  OSError, ssl.SSLError, UserError for files that cannot be used
        """
        self.context.load_cert_chain(self._keyring.certificate, self._keyring.key)
        self.context.load_verify_locations(self._keyring.revocation_list)
        return mqtt_password(self._keyring.secret)

    def check(self, connection: ssl.SSLSocket) -> None:
        """The broker is known by its role in a certificate of the authority, whatever address it is reached at.

        raises  RunError, before the password is sent
        """
        certificate: dict[str, Any] = dict(connection.getpeercert() or {})
        subject = dict(pair for entry in certificate.get("subject", ()) for pair in entry)
        if subject.get("organizationalUnitName") != Role.BROKER:
            raise RunError("what answers there is not the broker: its certificate is of another role")
