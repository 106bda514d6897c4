"""TLS of the page: the operator's certificate as its files are now."""

from __future__ import annotations

import ssl
from collections.abc import Callable
from contextlib import suppress

from runner.errors import UserError
from runner.security.keyring import Keyring


class PageTls:
    """Settings for the page's connections.

    context    for the server; after `refresh`, new connections use it with the current certificate
    on_report  called with the problem of new files: the previous ones then stay in force
    raises     UserError if certificate and key do not match, or others may read the key
    """

    def __init__(self, keyring: Keyring, on_report: Callable[[str], None]) -> None:
        self._keyring = keyring
        self._own, self._used = keyring.watched_certificate(on_report), b""
        self.context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self.context.minimum_version = ssl.TLSVersion.TLSv1_3
        self.refresh()

    def refresh(self) -> None:
        """Load a new certificate and its key."""
        if self._used == (own := self._own.get()):
            return
        with suppress(OSError, UserError):  # they are just being replaced once more: the next connection tries again
            self.context.load_cert_chain(self._keyring.certificate, self._keyring.key)
            self._used = own
