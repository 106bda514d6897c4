"""Certificates and revocation lists (RFC 5280), with the package `cryptography`. Times are passed in."""

from __future__ import annotations

import hashlib
import ipaddress
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from datetime import datetime, timedelta
from typing import NamedTuple

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.types import CertificatePublicKeyTypes
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from runner.core.roles import Role
from runner.security.validity import Validity

LABEL = r"[A-Za-z0-9_](?:[A-Za-z0-9_-]*[A-Za-z0-9_])?"
DNS_NAME = re.compile(rf"(?:\*\.)?{LABEL}(?:\.{LABEL})*\.?")
LIST_BEGIN = b"-----BEGIN X509 CRL-----"
BACKDATED = timedelta(hours=1)  # a holder's clock may be behind when it gets its certificate
AUTHORITY_YEARS = 20
YEAR = timedelta(days=365)
# A side is a server for one protocol and a client for another: RTSP, MQTT, HTTPS.
USES = {Role.BROKER: [ExtendedKeyUsageOID.SERVER_AUTH]}
BOTH = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]


class Pair(NamedTuple):
    """A certificate and its private key, PEM."""

    certificate: bytes
    key: bytes


def new_authority(name: str, now: datetime) -> Pair:
    """A self-signed certificate that may only sign certificates of holders."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    builder = (
        _builder(subject, subject, key, x509.random_serial_number(), now, AUTHORITY_YEARS * YEAR)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(key_cert_sign=True, crl_sign=True), critical=True)
    )
    return Pair(_pem(builder.sign(key, hashes.SHA256())), _key_pem(key))


def new_certificate(
    authority: Pair, name: str, role: Role, hosts: Sequence[str], serial: int, now: datetime, valid: timedelta
) -> Pair:
    """A holder's certificate and key: its name as common name, its role as organizational unit.

    hosts  addresses and DNS names at which it is reached as a server
    """
    issuer, signer = _loaded(authority)
    key = ec.generate_private_key(ec.SECP256R1())
    builder = (
        _builder(_subject(name, role), issuer.subject, key, serial, now, valid)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(digital_signature=True), critical=True)
        .add_extension(x509.ExtendedKeyUsage(USES.get(role, BOTH)), critical=False)
        .add_extension(x509.SubjectAlternativeName([_general_name(host) for host in (*hosts, name)]), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()),
            critical=False,
        )
    )
    return Pair(_pem(builder.sign(signer, hashes.SHA256())), _key_pem(key))


def new_request(name: str, role: Role, hosts: Sequence[str]) -> Pair:
    """A request for a holder's certificate (PKCS #10, RFC 2986), for another authority, and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    builder = (
        x509.CertificateSigningRequestBuilder()
        .subject_name(_subject(name, role))
        .add_extension(_usage(digital_signature=True), critical=True)
        .add_extension(x509.ExtendedKeyUsage(USES.get(role, BOTH)), critical=False)
    )
    if hosts:
        builder = builder.add_extension(x509.SubjectAlternativeName(list(map(_general_name, hosts))), critical=False)
    return Pair(builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM), _key_pem(key))


def revocation_list(
    authority: Pair, revoked: Iterable[tuple[int, datetime]], now: datetime, before: bytes | None = None
) -> bytes:
    """A CRL, PEM, of serial numbers and times of revocation. It does not expire before the authority does.

    An expired list would lock everyone out: OpenSSL would refuse every certificate. Servers that read a new list keep
    the old one, and OpenSSL uses the later of the two: the time of the new one, in whole seconds, must be later.

    before  the previous list, PEM; None: there is none
    raises  ValueError if that is not a list
    """
    issuer, signer = _loaded(authority)
    updated = now - BACKDATED
    if before:
        after = x509.load_pem_x509_crl(before).last_update_utc + timedelta(seconds=1)
        updated = max(updated, min(after, now))
    builder = (
        x509.CertificateRevocationListBuilder()
        .issuer_name(issuer.subject)
        .last_update(updated)
        .next_update(now + AUTHORITY_YEARS * YEAR)
    )
    for serial, since in revoked:
        entry = x509.RevokedCertificateBuilder().serial_number(serial).revocation_date(since).build()
        builder = builder.add_revoked_certificate(entry)
    return builder.sign(signer, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


def serial_of(certificate: bytes) -> int:
    """Serial number of a certificate, PEM.

    raises  ValueError
    """
    return x509.load_pem_x509_certificate(certificate).serial_number


def validity_of(certificate: bytes) -> Validity:
    """Of a certificate, PEM.

    raises  ValueError
    """
    loaded = x509.load_pem_x509_certificate(certificate)
    return Validity(loaded.not_valid_before_utc.timestamp(), loaded.not_valid_after_utc.timestamp())


def serials_of(crl: bytes) -> frozenset[int]:
    """Serial numbers in revocation lists, PEM, one after another.

    raises  ValueError
    """
    lists = [LIST_BEGIN + each for each in crl.split(LIST_BEGIN)[1:]] or [crl]
    return frozenset(entry.serial_number for each in lists for entry in x509.load_pem_x509_crl(each))


def fingerprint(key: CertificatePublicKeyTypes) -> str:
    """Of a public key: SHA-256 of its SubjectPublicKeyInfo (RFC 5280), hexadecimal."""
    encoded = key.public_bytes(serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo)
    return hashlib.sha256(encoded).hexdigest()


def fingerprint_of(certificate: bytes) -> str:
    """Of the public key of a certificate, PEM; raises ValueError"""
    return fingerprint(x509.load_pem_x509_certificate(certificate).public_key())


def fingerprint_of_key(key: bytes) -> str:
    """Of the public key that belongs to a private one, PEM; raises ValueError"""
    return fingerprint(signing_key(key).public_key())


def signing_key(key: bytes) -> ec.EllipticCurvePrivateKey:
    """An authority's private key, PEM.

    raises  ValueError
    """
    try:
        loaded = serialization.load_pem_private_key(key, password=None)
    except (TypeError, UnsupportedAlgorithm) as error:  # it has a passphrase
        raise ValueError(str(error)) from None
    if not isinstance(loaded, ec.EllipticCurvePrivateKey):
        raise ValueError("the key does not belong to an elliptic curve")
    return loaded


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    serial: int,
    now: datetime,
    valid: timedelta,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(serial)
        .not_valid_before(now - BACKDATED)
        .not_valid_after(now + valid)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _subject(name: str, role: Role) -> x509.Name:
    return x509.Name(
        [x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, role), x509.NameAttribute(NameOID.COMMON_NAME, name)]
    )


def _usage(*, digital_signature: bool = False, key_cert_sign: bool = False, crl_sign: bool = False) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=digital_signature,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=key_cert_sign,
        crl_sign=crl_sign,
        encipher_only=False,
        decipher_only=False,
    )


def is_host(host: str) -> bool:
    """Whether a certificate can name a host: by an address, or a DNS name in ASCII, without a port."""
    with suppress(ValueError):
        return bool(ipaddress.ip_address(host))
    return bool(DNS_NAME.fullmatch(host))


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _loaded(authority: Pair) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    return x509.load_pem_x509_certificate(authority.certificate), signing_key(authority.key)


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
