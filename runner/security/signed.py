"""Certificates that another authority has signed, checked before they are taken in. Times are passed in."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from datetime import datetime

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.x509.oid import ExtendedKeyUsageOID

from runner.security.certificates import BOTH, USES
from runner.security.keyring import Holder
from runner.security.validity import Validity, invalid

MOST_ISSUERS = 10
PURPOSES = {ExtendedKeyUsageOID.SERVER_AUTH: "serverAuth", ExtendedKeyUsageOID.CLIENT_AUTH: "clientAuth"}


class Bundle:
    """The certificates of an authority: its root, which is trusted, and those between it and the holders.

    content  PEM
    raises   ValueError unless it holds exactly one root
    """

    def __init__(self, content: bytes) -> None:
        certificates = x509.load_pem_x509_certificates(content)
        roots = [each for each in certificates if each.issuer == each.subject]
        if len(roots) != 1:
            raise ValueError(f"must contain the authority's root, one self-signed certificate, not {len(roots)}")
        self._root = roots[0]
        self._between = [each for each in certificates if each is not self._root]

    @property
    def root(self) -> bytes:
        """PEM."""
        return _pem(self._root)

    def chain(self, leaf: x509.Certificate, others: Sequence[x509.Certificate]) -> bytes:
        """A holder's certificate and those between it and the root, PEM.

        others  further certificates, in any order
        raises  ValueError if they do not lead to the root
        """
        chain, known = [leaf], [*others, *self._between]
        while not _is_issued_by(chain[-1], self._root):
            issuer = next((each for each in known if _is_issued_by(chain[-1], each)), None)
            if issuer is None or len(chain) > MOST_ISSUERS:
                missing = chain[-1].issuer.rfc4514_string()
                raise ValueError(f"the certificate of {missing!r}, which issued it, is missing: append it to this file")
            chain.append(issuer)
        return b"".join(map(_pem, chain))

    def check_list(self, content: bytes, chains: Iterable[bytes]) -> None:
        """Check the revocation list of this authority or of one below it, PEM.

        chains  of holders, PEM, with certificates of authorities below it
        raises  ValueError
        """
        signed = x509.load_pem_x509_crl(content)
        known = [self._root, *self._between, *(c for each in chains for c in x509.load_pem_x509_certificates(each))]
        keys = (each.public_key() for each in known if each.subject == signed.issuer)
        if not any(signed.is_signature_valid(key) for key in keys):  # type: ignore[arg-type]
            raise ValueError(f"is not signed by the authority, but by {signed.issuer.rfc4514_string()!r}")


def problems(leaf: x509.Certificate, holder: Holder, now: datetime) -> Iterator[str]:
    """Why a certificate will not do for a holder whose key it has."""
    term = Validity(leaf.not_valid_before_utc.timestamp(), leaf.not_valid_after_utc.timestamp())
    if why := invalid(term, now.timestamp()):
        yield why
    needed = USES.get(holder.role, BOTH)
    with suppress(x509.ExtensionNotFound):
        uses = leaf.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        if lacking := [PURPOSES[each] for each in needed if each not in uses]:
            yield f"lacks the purpose {' and '.join(lacking)} (extended key usage)"
    if lacking := sorted(set(map(_normal, holder.hosts)) - _hosts(leaf)):
        yield f"lacks {', '.join(lacking)} (subject alternative name)"


def _hosts(leaf: x509.Certificate) -> set[str]:
    try:
        names = leaf.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return set()
    addresses = map(str, names.get_values_for_type(x509.IPAddress))
    return {*map(_normal, names.get_values_for_type(x509.DNSName)), *addresses}


def _normal(host: str) -> str:
    try:
        return str(ipaddress.ip_address(host))
    except ValueError:
        return host.lower()


def _is_issued_by(certificate: x509.Certificate, issuer: x509.Certificate) -> bool:
    with suppress(ValueError, TypeError, InvalidSignature):
        certificate.verify_directly_issued_by(issuer)
        return True
    return False


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)
