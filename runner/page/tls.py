"""TLS of the page: the operator's certificate as its files are now."""

from __future__ import annotations

import ssl
from collections.abc import Callable

from runner.errors import RunError, UserError
from runner.security.keyring import Keyring


class PageTls:
    """Settings for the page's connections.

    context    for the server; after `refresh`, new connections use it with the current certificate
    on_report  called with the problem of new files
    raises     RunError if certificate and key do not match, or others may read the key
    """

    def __init__(self, keyring: Keyring, on_report: Callable[[str], None]) -> None:
        self._keyring, self._on_report = keyring, on_report
        self._own = keyring.watched_certificate(on_report)
        self._used = self._own.get()
        self.context = _context(keyring)

    def refresh(self) -> None:
        """Load a new certificate. One without its key, while they are copied one by one, is tried again."""
        if self._used == (own := self._own.get()):
            return
        try:
            _context(self._keyring)  # first: one that does not match would leave the context without a certificate
            self.context.load_cert_chain(self._keyring.certificate, self._keyring.key)
            self._used = own
        except (OSError, RunError, UserError) as error:
            self._on_report(f"page: the previous certificate stays in force: {error}")


def _context(keyring: Keyring) -> ssl.SSLContext:
    """raises RunError"""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    try:
        context.load_cert_chain(keyring.certificate, keyring.key)
    except UserError as error:
        raise RunError(str(error)) from None
    except OSError as error:  # ssl.SSLError among them
        raise RunError(f"{keyring.directory}: {error}") from None
    return context
