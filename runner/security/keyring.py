"""The files in the directory of one key holder, read when a side starts and again when a file changes.

ca.crt          certificate of the authority
own.crt         the holder's certificate: name, role, hosts
own.key         its private key
own.json        its name and role
own.secret      from which its passwords are derived, see `derived`
crl.pem         revoked certificates; if another authority signs them, it may be missing
holders.json    only if another authority signs certificates: by public key, its holder
people.json     vehicle only: by name, role and RTSP password of those who may reach it
srt.passphrase  vehicle only
media.secret    controllers and watchers only: from which the SRT passphrase of each vehicle is derived
page.token      controllers and watchers only: for browsers on other machines
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import re
import ssl
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

import msgspec

from runner.core.roles import Role
from runner.errors import UserError
from runner.system.files import exposure, read_file

if TYPE_CHECKING:
    from runner.security.validity import Validity

AUTHORITY, CERTIFICATE, KEY, SECRET, HOLDER = "ca.crt", "own.crt", "own.key", "own.secret", "own.json"
REVOKED, PEOPLE, HOLDERS = "crl.pem", "people.json", "holders.json"
PASSPHRASE, MEDIA_SECRET, TOKEN = "srt.passphrase", "media.secret", "page.token"
PUBLIC = (AUTHORITY, CERTIFICATE, HOLDER, REVOKED, HOLDERS)  # others may read these
NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")  # of a holder: as in MQTT topics, and at most a certificate's common name
MOST_BYTES = 1_000_000  # of a file
CHECK_S = 1.0  # between two checks of a file for changes

T = TypeVar("T")


class Person(msgspec.Struct, frozen=True):
    """Someone who may reach a vehicle.

    rtsp  password for the vehicle's RTSP server, where the user is the person's name; "" for a role without video
    """

    role: Role
    rtsp: str = ""


class Holder(msgspec.Struct, frozen=True):
    """The owner of keys.

    hosts    addresses and DNS names at which the holder is reached
    company  whether another authority than that of `tod-runner keys` signs certificates
    """

    name: str
    role: Role
    hosts: tuple[str, ...] = ()
    company: bool = False


def derived(secret: bytes, purpose: str) -> str:
    """A password derived from a secret, which it does not reveal (HMAC-SHA256, RFC 2104); 43 characters."""
    digest = hmac.new(secret, purpose.encode(), hashlib.sha256).digest()
    return base64.urlsafe_b64encode(digest).rstrip(b"=").decode()


def rtsp_password(secret: bytes, vehicle: str) -> str:
    """Password of one operator for one vehicle, of no use with another vehicle."""
    return derived(secret, f"rtsp {vehicle}")


def mqtt_password(secret: bytes) -> str:
    return derived(secret, "mqtt")


def srt_passphrase(media_secret: bytes, vehicle: str) -> str:
    return derived(media_secret, f"srt {vehicle}")


class Watched(Generic[T]):
    """A value read from a file, and again when the file has changed. May be used from any thread.

    A file that cannot be used leaves the last value in force, and is reported once; it is read again until it can be
    used: a change of its owner leaves no trace in `version_of`.

    read       reads the value; may raise UserError
    on_report  called with what is wrong with a new file
    raises     UserError if it cannot be read at first
    """

    def __init__(self, path: Path, read: Callable[[], T], on_report: Callable[[str], None]) -> None:
        self._path, self._read, self._on_report = path, read, on_report
        self._lock = threading.Lock()
        self._version, self._checked = version_of(self._path), time.monotonic()
        self._problem = ""  # of the file as it is now, as reported
        self._value = read()

    def get(self) -> T:
        with self._lock:
            now = time.monotonic()
            if now - self._checked > CHECK_S:
                self._checked = now
                self._reload()
            return self._value

    def _reload(self) -> None:
        version = version_of(self._path)
        if version == self._version:
            return
        try:
            self._value = self._read()
            self._version, self._problem = version, ""
        except UserError as error:
            if str(error) != self._problem:
                self._problem = str(error)
                self._on_report(f"{error}; the previous content stays in force")


def version_of(path: Path) -> tuple[int, int, int] | None:
    """Differs once a file has been written or replaced; None: it is missing."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_ino, found.st_size


@dataclass(frozen=True, slots=True)
class Keyring:
    """A holder's directory of keys, complete and readable by its owner only.

    raises  UserError, from `of`, that names every problem
    """

    directory: Path

    @staticmethod
    def of(directory: Path, *needed: str) -> Keyring:
        """Check that all files are in place.

        needed  names of files in addition to those that every holder has
        raises  UserError
        """
        ring = Keyring(directory)
        names = (AUTHORITY, CERTIFICATE, KEY, SECRET, HOLDER, HOLDERS if ring._is_of_company() else REVOKED, *needed)
        problems = [f"{name}: {problem}" for name in names if (problem := ring._problem(name))]
        if problems:
            rule = "must be a directory that `tod-runner keys` made, copied as it is"
            raise UserError("keys", "", str(directory), f"{rule}: {'; '.join(problems)}")
        return ring

    @property
    def authority(self) -> Path:
        return self.directory / AUTHORITY

    @property
    def certificate(self) -> Path:
        return self.directory / CERTIFICATE

    @property
    def key(self) -> Path:
        """raises UserError if others may read the file"""
        self.read(KEY)
        return self.directory / KEY

    @property
    def revocation_list(self) -> Path:
        return self.directory / REVOKED

    @property
    def holder(self) -> Holder:
        return self._decoded(HOLDER, Holder)

    def _is_of_company(self) -> bool:
        try:
            return self.holder.company
        except UserError:  # is reported as a problem of that file
            return False

    @property
    def secret(self) -> bytes:
        return self.read(SECRET)

    def watched(self, name: str, on_report: Callable[[str], None]) -> Watched[bytes]:
        """The content of a file."""
        return Watched(self.directory / name, lambda: self.read(name), on_report)

    def watched_passphrase(self, on_report: Callable[[str], None]) -> Watched[str]:
        """The passphrase that encrypts this vehicle's SRT streams."""
        return Watched(self.directory / PASSPHRASE, self._passphrase, on_report)

    def _passphrase(self) -> str:
        try:
            return self.read(PASSPHRASE).decode()
        except UnicodeDecodeError as error:
            raise self._error(PASSPHRASE, error) from None

    def read(self, name: str) -> bytes:
        """Content of a file, without a trailing newline that an editor may have added.

        raises  UserError, also for a secret that others may read
        """
        path = self.directory / name
        try:
            content = read_file(path, MOST_BYTES).strip()
            exposed = None if name in PUBLIC else exposure(path)
        except ValueError as error:
            raise UserError("keys", name, str(self.directory), str(error)) from None
        if exposed:
            raise UserError("keys", name, str(self.directory), exposed)
        if not content:  # for example while it is being copied; anybody could compute what is derived from it
            raise UserError("keys", name, str(self.directory), "is empty")
        return content

    def revoked(self) -> frozenset[int]:
        """Serial numbers of revoked certificates."""
        from runner.security.certificates import serials_of

        if self.holder.company and not self.revocation_list.exists():
            return frozenset()
        try:
            return serials_of(self.read(REVOKED))
        except ValueError as error:
            raise self._error(REVOKED, error) from None

    def validity(self, name: str = CERTIFICATE) -> Validity:
        """Of a certificate in a file: the holder's, or the authority's."""
        from runner.security.certificates import validity_of

        try:
            return validity_of(self.read(name))
        except ValueError as error:
            raise self._error(name, error) from None

    def people(self) -> Mapping[str, Person]:
        """Who may reach this vehicle, by name."""
        return self._decoded(PEOPLE, dict[str, Person])

    def watched_people(self, on_report: Callable[[str], None]) -> Watched[Mapping[str, Person]]:
        return Watched(self.directory / PEOPLE, self.people, on_report)

    def watched_holders(self, on_report: Callable[[str], None]) -> Watched[Mapping[str, Holder]]:
        """By fingerprint of the public key, see `Presented`."""
        return Watched(self.directory / HOLDERS, lambda: self._decoded(HOLDERS, dict[str, Holder]), on_report)

    def watched_holder(self, on_report: Callable[[str], None]) -> Watched[Holder]:
        return Watched(self.directory / HOLDER, lambda: self.holder, on_report)

    def watched_certificate(self, on_report: Callable[[str], None]) -> Watched[bytes]:
        """The certificate. A new one counts once its key is there, too: files are copied one by one."""
        return Watched(self.certificate, self._usable_certificate, on_report)

    def _usable_certificate(self) -> bytes:
        """raises UserError if certificate and key do not match, or others may read the key"""
        certificate = self.read(CERTIFICATE)
        try:
            ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(self.certificate, self.key)
        except OSError as error:  # ssl.SSLError among them
            rule = f"must be a certificate that matches {KEY}: {error}"
            raise UserError("keys", CERTIFICATE, str(self.directory), rule) from None
        return certificate

    def watched_revoked(self, on_report: Callable[[str], None]) -> Watched[frozenset[int]]:
        return Watched(self.revocation_list, self.revoked, on_report)

    def _decoded(self, name: str, kind: type[T]) -> T:
        try:
            return msgspec.json.decode(self.read(name), type=kind)
        except msgspec.MsgspecError as error:
            raise self._error(name, error) from None

    def _error(self, name: str, error: Exception) -> UserError:
        return UserError("keys", name, str(self.directory), f"not as `tod-runner keys` writes it: {error}")

    def _problem(self, name: str) -> str | None:
        path = self.directory / name
        try:
            exposed = exposure(path)
        except ValueError as error:
            return str(error)
        return None if name in PUBLIC else exposed
