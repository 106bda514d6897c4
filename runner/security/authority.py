"""The directory of a small certificate authority: one directory for each key holder, to be copied to its machine.

    authority/   the authority's certificate and key, and the list of issued certificates; never copied
    requests/    what another authority is to sign, if there is one (`runner.security.company`)
    broker/      for mosquitto
    NAME/        for one vehicle, operator, predictor or positioner

A change for one holder is written to the directories of all others that need to know it.
"""

from __future__ import annotations

import base64
import fcntl
import hashlib
import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import msgspec

from runner.core.roles import VIEWERS, Role
from runner.errors import ArgumentError, RunError, reason
from runner.security import keyring
from runner.security.broker_files import ACCESS, PASSWORDS, access_list, broker_settings
from runner.security.certificates import (
    Pair,
    is_host,
    new_authority,
    new_certificate,
    revocation_list,
    serial_of,
    signing_key,
)
from runner.system.files import read_file, unfinished

RESERVED = ("authority", "broker", "requests")
ISSUED, AUTHORITY_KEY, LOCK = "issued.json", "authority.key", ".lock"
BROKER_SETTINGS = "mosquitto.conf"
VALID = timedelta(days=365)
ROUNDS = 101  # of PBKDF2; the passwords have 256 random bits


class Issued(msgspec.Struct, frozen=True):
    """A certificate that was issued; the newest one of a name is the one in use.

    serial   hexadecimal
    hosts    addresses and DNS names at which the holder is reached
    until    when it expires
    revoked  since when it is no longer accepted; None: it is accepted
    """

    name: str
    role: Role
    serial: str
    hosts: tuple[str, ...]
    until: datetime
    revoked: datetime | None = None


class Wanted(NamedTuple):
    """Keys to be issued: as in `Issued`."""

    name: str
    role: Role
    hosts: tuple[str, ...] = ()

    def check(self) -> None:
        """raises UserError for a name or a host that no keys can have"""
        if not keyring.NAME.fullmatch(self.name) or (self.name in RESERVED) is not (self.role is Role.BROKER):
            rule = f"must be 1 to 64 letters, digits, _ and -, and none of {', '.join(RESERVED)}"
            raise ArgumentError(self.role, repr(self.name), rule)
        if not all(map(is_host, self.hosts)):
            rule = "must be addresses or names without a port, in ASCII: an international one begins with xn--"
            argument = "broker" if self.role is Role.BROKER else "host"
            raise ArgumentError(argument, ", ".join(self.hosts), rule)


@dataclass(frozen=True, slots=True)
class Authority:
    """An authority's directory. Only one process at a time changes it, see `opened`.

    installed  directory of the broker's files on the broker's machine
    """

    directory: Path
    now: Callable[[], datetime] = lambda: datetime.now(UTC)
    installed: str = "/etc/mosquitto/tod"

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Create the authority unless it exists, and keep other processes out.

        raises  UserError if the directory contains something else, RunError if another process uses it
        """
        own = self._own
        if not own.exists() and self.directory.is_dir() and any(self.directory.iterdir()):
            rule = "must be a directory of `tod-runner keys`, or a new one: it contains other files"
            raise ArgumentError("output", str(self.directory), rule)
        with _os_errors_reported():
            own.mkdir(parents=True, exist_ok=True)
            self.directory.chmod(0o700)
            with (own / LOCK).open("w") as lock:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise RunError(f"{self.directory}: another process is changing these keys") from None
                if not (own / ISSUED).exists():
                    self._create()
                yield

    def holders(self) -> list[Issued]:
        """The newest certificate of each name, in order of first issue."""
        return list({issued.name: issued for issued in self._issued()}.values())

    def check(self, wanted: Sequence[Wanted], *known: tuple[str, str | None]) -> None:
        """Check a whole request before anything of it is done.

        known   by argument, a name that must have keys, or be among those wanted
        raises  UserError for a name that is taken by another role, or unknown
        """
        roles = self._roles()
        for name, role, _ in wanted:
            if roles.setdefault(name, role) is not role:
                raise ArgumentError(role, repr(name), f"is taken: {name} is a {roles[name]}")
        for argument, each in known:
            if each and each not in {name for name, _, _ in wanted}:
                self._known(each, argument, revoked=argument == "revoke")

    def issue(self, name: str, role: Role, hosts: Sequence[str]) -> bool:
        """Create a holder's directory; returns False if it already has one with the same role and hosts.

        raises  UserError for a name that is taken by another role or invalid
        """
        wanted = Wanted(name, role, tuple(hosts))
        wanted.check()
        self.check([wanted])
        present = next((issued for issued in self.holders() if issued.name == name), None)
        if present and self._in_use(present) and (not hosts or set(hosts) == set(present.hosts)):
            return False
        self._renew(name, role, wanted.hosts or (present.hosts if present else ()))
        return True

    def rotate(self, name: str) -> None:
        """Replace a holder's keys and passwords; its previous ones are no longer accepted.

        raises  UserError for an unknown name
        """
        known = self._known(name, "rotate")
        self._renew(known.name, known.role, known.hosts)

    def revoke(self, name: str) -> None:
        """Revoke a holder's keys, and remove its directory. Repeating it completes a revocation that was interrupted.

        raises  UserError for an unknown name
        """
        if not any(issued.name == name and issued.revoked for issued in self.holders()):
            self._renew_media_secret(self._known(name, "revoke").role)
            self._write_issued(self._revoked(name))
        self._distribute()
        _remove(self.directory / name)

    # --- files --------------------------------------------------------------------------------------------------------

    @property
    def _own(self) -> Path:
        return self.directory / "authority"

    @property
    def _pair(self) -> Pair:
        certificate, key = self._own / keyring.AUTHORITY, self._own / AUTHORITY_KEY
        pair = Pair(read(certificate), read(key))
        with damage_reported(certificate):
            serial_of(pair.certificate)
        with damage_reported(key):
            signing_key(pair.key)
        return pair

    def _create(self) -> None:
        pair = new_authority("tod-runner authority", self.now())
        write(self._own / keyring.AUTHORITY, pair.certificate)
        write(self._own / AUTHORITY_KEY, pair.key)
        self._complete()

    def _complete(self) -> None:
        write(self._own / keyring.MEDIA_SECRET, _secret())
        self._write_issued([])  # last: marks the authority as complete

    def _roles(self) -> dict[str, Role]:
        """By name, of everybody who was ever named."""
        return {issued.name: issued.role for issued in self.holders()}

    def _issued(self) -> list[Issued]:
        path = self._own / ISSUED
        with damage_reported(path):
            return msgspec.json.decode(read(path), type=list[Issued])

    def _write_issued(self, issued: list[Issued]) -> None:
        write(self._own / ISSUED, msgspec.json.format(msgspec.json.encode(issued)))

    def _known(self, name: str, argument: str, revoked: bool = False) -> Issued:
        """The certificate in use of a name; raises UserError for an unknown one.

        revoked  whether a revoked one will do
        """
        active = {issued.name: issued for issued in self.holders() if revoked or not issued.revoked}
        if name not in active:
            raise ArgumentError(argument, repr(name), f"must be one of {', '.join(active) or '(none yet)'}")
        return active[name]

    def _revoked(self, name: str) -> list[Issued]:
        """All issued certificates, with those of a name marked as revoked."""
        return [
            msgspec.structs.replace(issued, revoked=self.now())
            if issued.name == name and not issued.revoked
            else issued
            for issued in self._issued()
        ]

    def _in_use(self, issued: Issued) -> bool:
        """Whether a holder has this certificate: a killed run may not have written it."""
        certificate = self.directory / issued.name / keyring.CERTIFICATE
        if issued.revoked or not certificate.exists():
            return False
        with damage_reported(certificate, f"rotate={issued.name} renews it"):
            return serial_of(read(certificate)) == int(issued.serial, 16)

    def _renew(self, name: str, role: Role, hosts: tuple[str, ...]) -> None:
        # Listed before anybody has it: a serial number unknown to the authority could never be revoked.
        serial, until = secrets.randbits(159) | 1, self.now() + VALID
        pair = new_certificate(self._pair, name, role, hosts, serial, self.now(), VALID)
        self._install(Issued(name, role, f"{serial:x}", hosts, until), pair)

    def _install(self, issued: Issued, pair: Pair, company: bool = False) -> None:
        """Make the directory of a holder with a new certificate and key. company: as in `keyring.Holder`"""
        name, role = issued.name, issued.role
        if any(known.name == name for known in self.holders()):
            self._renew_media_secret(role)
        self._write_issued([*self._revoked(name), issued])
        files = {
            keyring.AUTHORITY: read(self._own / keyring.AUTHORITY),
            keyring.CERTIFICATE: pair.certificate,
            keyring.KEY: pair.key,
            keyring.SECRET: _secret(),
            keyring.HOLDER: msgspec.json.encode(keyring.Holder(name, role, issued.hosts, company)),
            **({keyring.TOKEN: _secret()} if role in VIEWERS else {}),
        }
        self._replace(name, files)
        self._distribute()

    def _renew_media_secret(self, role: Role) -> None:
        """Withdraw what the keys of a role reveal about SRT streams: SRT has no certificates that could be revoked."""
        if role is Role.VEHICLE or role in VIEWERS:
            write(self._own / keyring.MEDIA_SECRET, _secret())

    def _replace(self, name: str, files: Mapping[str, bytes]) -> None:
        """Replace a holder's directory as a whole."""
        new, old, final = (
            self.directory / f"{dot}{name}{end}" for dot, end in ((".", ".new"), (".", ".old"), ("", ""))
        )
        for leftover in (new, old):  # of a killed run
            _remove(leftover)
        new.mkdir(mode=0o700)
        for file, content in files.items():
            write(new / file, content)
        if final.exists():
            final.rename(old)
        new.rename(final)
        _remove(old)

    def _distribute(self) -> None:
        """Write the accepted holders, revocations and secrets of SRT to all directories that need them."""
        media_secret = read(self._own / keyring.MEDIA_SECRET)
        holders = list(filter(self._in_use, self.holders()))
        common = self._common(holders)
        passwords = {each.name: read(self.directory / each.name / keyring.SECRET) for each in holders}
        for holder in holders:
            directory = self.directory / holder.name
            for name, content in common.items():
                write(directory / name, content)
            if holder.role in VIEWERS:
                write(directory / keyring.MEDIA_SECRET, media_secret)
            if holder.role is Role.VEHICLE:
                write(directory / keyring.PASSPHRASE, keyring.srt_passphrase(media_secret, holder.name).encode())
                write(directory / keyring.PEOPLE, self._people(holder.name, holders, passwords))
            elif holder.role is Role.BROKER:
                lines = (_password_line(name, keyring.mqtt_password(own)) for name, own in passwords.items())
                write(directory / PASSWORDS, "".join(lines).encode())
                write(directory / ACCESS, access_list((each.name, each.role) for each in holders).encode())
                settings = broker_settings(self.installed, listed=keyring.REVOKED in common)
                write(directory / BROKER_SETTINGS, settings.encode())

    def _common(self, holders: Sequence[Issued]) -> dict[str, bytes]:
        """The files that are the same for all holders, and change: here, the revocation list."""
        revoked = [each for each in self._issued() if each.revoked and each.until > self.now()]
        serials = [(int(each.serial, 16), each.revoked) for each in revoked if each.revoked]
        known = self._own / keyring.REVOKED
        with damage_reported(known):
            crl = revocation_list(self._pair, serials, self.now(), read(known) if known.exists() else None)
        write(known, crl)
        return {keyring.REVOKED: crl}

    def _people(self, vehicle: str, holders: Sequence[Issued], secret: Mapping[str, bytes]) -> bytes:
        people = {
            each.name: keyring.Person(
                each.role, keyring.rtsp_password(secret[each.name], vehicle) if each.role in VIEWERS else ""
            )
            for each in holders
            if each.role not in (Role.VEHICLE, Role.BROKER)
        }
        return msgspec.json.format(msgspec.json.encode(people))


def _password_line(name: str, password: str) -> str:
    """A line of mosquitto's password file: PBKDF2-SHA512, as `mosquitto_passwd` writes it."""
    salt = secrets.token_bytes(12)
    digest = hashlib.pbkdf2_hmac("sha512", password.encode(), salt, ROUNDS)
    return f"{name}:$7${ROUNDS}${base64.b64encode(salt).decode()}${base64.b64encode(digest).decode()}\n"


def _secret() -> bytes:
    return secrets.token_urlsafe(32).encode()


def read(path: Path) -> bytes:
    try:
        return read_file(path, keyring.MOST_BYTES)
    except ValueError as error:
        raise RunError(f"{path}: {error}") from None


def _remove(directory: Path) -> None:
    """Remove a directory of keys, if it exists."""
    if directory.exists():
        shutil.rmtree(directory)


def write(path: Path, content: bytes) -> None:
    """Write a file atomically; only its owner may read it, unless it is public."""
    with unfinished(path) as part:
        part.unlink(missing_ok=True)
        mode = 0o644 if path.name in keyring.PUBLIC else 0o600
        with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(content)


@contextmanager
def damage_reported(path: Path, remedy: str = "restore it from a backup") -> Iterator[None]:
    """raises RunError for a file with content that `tod-runner keys` does not write"""
    try:
        yield
    except (ValueError, msgspec.MsgspecError) as error:
        raise RunError(f"{path}: not as `tod-runner keys` writes it: {error}; {remedy}") from None


@contextmanager
def _os_errors_reported() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise RunError(f"{error.filename}: {reason(error)}") from None
