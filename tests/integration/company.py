"""What a company already has: a certificate authority with an intermediate, and a mosquitto of its own."""

from __future__ import annotations

import ipaddress
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from rig import answers, until
from runner.mqtt.broker import find_mosquitto
from runner.settings import Endpoint

PEM = serialization.Encoding.PEM
USES = [ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]
LONG = timedelta(days=300)


class Signer(NamedTuple):
    """An authority's certificate and key."""

    certificate: x509.Certificate
    key: rsa.RSAPrivateKey


class Company:
    """Its root, and the intermediate authority that signs everything; `root.pem` and `issuing.pem` in its directory."""

    def __init__(self, directory: Path) -> None:
        directory.mkdir(parents=True)
        self.directory = directory
        self.root = _authority("Acme Root", None)
        self.issuing = _authority("Acme Issuing", self.root)
        self.ca = self._write("root.pem", _pem(self.root.certificate))
        self._write("issuing.pem", _pem(self.issuing.certificate))
        self._write("issuing.key", _key_pem(self.issuing.key))

    def signed(
        self, key: ec.EllipticCurvePublicKey, names: Sequence[str], *, ends: timedelta = LONG, common: str = "x"
    ) -> bytes:
        """A certificate and the intermediate. names: of hosts; common: its common name, in a unit called vehicle"""
        subject = [(NameOID.ORGANIZATIONAL_UNIT_NAME, "vehicle"), (NameOID.COMMON_NAME, common)]
        name = x509.Name([x509.NameAttribute(*each) for each in subject])
        leaf = _certificate(name, key, self.issuing, ends).add_extension(x509.ExtendedKeyUsage(USES), critical=False)
        if names:
            leaf = leaf.add_extension(x509.SubjectAlternativeName([_name(each) for each in names]), critical=False)
        return _pem(leaf.sign(self.issuing.key, hashes.SHA256())) + _pem(self.issuing.certificate)

    def sign(self, request: Path, *, ends: timedelta = LONG) -> bytes:
        """What its authority makes of a request: hosts and key of it, nothing else."""
        asked = x509.load_pem_x509_csr(request.read_bytes())
        assert asked.is_signature_valid
        key, names = asked.public_key(), list[str]()
        assert isinstance(key, ec.EllipticCurvePublicKey)
        with suppress(x509.ExtensionNotFound):
            hosts = asked.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
            names = [str(each.value) for each in hosts]
        return self.signed(key, names, ends=ends)

    def issue(self, name: str, *names: str, ends: timedelta = LONG) -> tuple[Path, Path]:
        """Files with a new certificate and its key."""
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = self.signed(key.public_key(), names or [name], ends=ends, common=name)
        return self._write(f"{name}.crt", certificate), self._write(f"{name}.key", _key_pem(key))

    def revocations(self, *serials: int) -> Path:
        """A list of the intermediate's."""
        now = datetime.now(UTC)
        builder = x509.CertificateRevocationListBuilder().issuer_name(self.issuing.certificate.subject)
        builder = builder.last_update(now - timedelta(hours=1)).next_update(now + timedelta(days=7))
        for serial in serials:
            entry = x509.RevokedCertificateBuilder().serial_number(serial).revocation_date(now).build()
            builder = builder.add_revoked_certificate(entry)
        return self._write("list.pem", builder.sign(self.issuing.key, hashes.SHA256()).public_bytes(PEM))

    def credentials(self, user: str, password: str) -> Path:
        """A file as `control.credentials` names it."""
        return self._write(f"{user}.login", f"{user}:{password}\n".encode())

    @contextmanager
    def broker(
        self, endpoint: Endpoint, users: Sequence[str], rules: str, *names: str, more: str = ""
    ) -> Iterator[None]:
        """Its mosquitto, whose users have their name, reversed, as password.

        rules  content of its access list
        names  in its certificate; none: the endpoint's host
        """
        certificate, key = self.issue("mqtt", *(names or (endpoint.host,)))
        passwords = self._write("passwords", "".join(f"{user}:{user[::-1]}\n" for user in users).encode())
        subprocess.run(["mosquitto_passwd", "-U", passwords], check=True)
        settings = self._write(
            "mosquitto.conf",
            f"listener {endpoint.port} {endpoint.host}\nuser root\nallow_anonymous false\npersistence false\n"
            f"password_file {passwords}\nacl_file {self._write('acl', rules.encode())}\n"
            f"cafile {self.ca}\ncertfile {certificate}\nkeyfile {key}\n{more}".encode(),
        )
        with subprocess.Popen([find_mosquitto(), "-c", settings], stderr=subprocess.DEVNULL) as process:
            try:
                until(lambda: answers(endpoint.port, endpoint.host), 20)
                yield
            finally:
                process.terminate()

    def _write(self, name: str, content: bytes) -> Path:
        path = self.directory / name
        path.write_bytes(content)
        path.chmod(0o600)
        return path


def _authority(name: str, above: Signer | None) -> Signer:
    key = rsa.generate_private_key(65537, 2048)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    builder = _certificate(subject, key.public_key(), above, 10 * LONG, own=key)
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
    return Signer(builder.sign(above.key if above else key, hashes.SHA256()), key)


def _certificate(
    subject: x509.Name,
    key: rsa.RSAPublicKey | ec.EllipticCurvePublicKey,
    issuer: Signer | None,
    ends: timedelta,
    own: rsa.RSAPrivateKey | None = None,
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    signer = issuer.key if issuer else own
    assert signer
    identifier = x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key())
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer.certificate.subject if issuer else subject)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=400))
        .not_valid_after(now + ends)
        .add_extension(identifier, critical=False)
    )


def _name(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        return x509.DNSName(text)


def _key_pem(key: rsa.RSAPrivateKey | ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(PEM)
