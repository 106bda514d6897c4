"""Who a certificate stands for, once its signature and its dates have been checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from cryptography import x509
from cryptography.x509.oid import NameOID

from runner.core.roles import Role
from runner.security.certificates import fingerprint
from runner.security.keyring import Holder, Keyring, Watched


class Presented(NamedTuple):
    """A certificate that a peer has presented.

    key    fingerprint of its public key
    names  common names and organizational units in its subject
    """

    serial: int
    key: str
    names: tuple[tuple[str, ...], tuple[str, ...]]

    @staticmethod
    def of(certificate: bytes) -> Presented:
        """The certificate is DER."""
        read = x509.load_der_x509_certificate(certificate)
        common, unit = (
            tuple(str(each.value) for each in read.subject.get_attributes_for_oid(oid))
            for oid in (NameOID.COMMON_NAME, NameOID.ORGANIZATIONAL_UNIT_NAME)
        )
        return Presented(read.serial_number, fingerprint(read.public_key()), (common, unit))


class Identities:
    """Knows the holders of certificates, and which of these are revoked. May be used from any thread.

    The authority of `tod-runner keys` states name and role in the subject. A company's signs certificates of others,
    too, and may change a subject: there, only the public keys count that `tod-runner keys` has made.

    on_report  called with the problem of a new file
    """

    def __init__(self, keyring: Keyring, on_report: Callable[[str], None]) -> None:
        self._revoked = keyring.watched_revoked(on_report)
        self._by_key: Watched[Mapping[str, Holder]] | None = None
        if keyring.holder.company:
            self._by_key = keyring.watched_holders(on_report)

    def holder(self, presented: Presented) -> Holder | str:
        """The holder of a certificate, or why it is not accepted."""
        if presented.serial in self._revoked.get():
            return "its certificate is revoked"
        found = self._by_key.get().get(presented.key) if self._by_key else _stated(presented)
        return found or "its certificate is of nobody whom these keys know"


def _stated(presented: Presented) -> Holder | None:
    names, units = presented.names
    if len(names) != 1 or len(units) != 1 or units[0] not in list(Role):
        return None
    return Holder(names[0], Role(units[0]))
