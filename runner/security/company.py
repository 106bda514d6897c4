"""Keys whose certificates another authority signs, such as a company's: requests go out, certificates come in."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
from cryptography import x509

from runner.core.roles import Role
from runner.errors import ConfigError, Problem, UserError
from runner.security import keyring, signed
from runner.security.authority import Authority, Issued, Wanted, damage_reported, read, write
from runner.security.certificates import Pair, fingerprint, fingerprint_of, fingerprint_of_key, new_request
from runner.security.keyring import Holder
from runner.system.files import read_file

REQUESTS = "requests"  # below the output, for the authority; below `authority`, their keys
BUNDLE = "bundle.pem"  # the authority's certificates, as they were given


def is_of_company(directory: Path) -> bool:
    """Whether another authority signs the certificates of this directory."""
    return (directory / "authority" / BUNDLE).exists()


@dataclass(frozen=True, slots=True)
class CompanyAuthority(Authority):
    """The directory of keys, without a key that signs. A certificate counts by its public key (`Identities`).

    bundle  file with the authority's certificates, new ones too; None: as before
    """

    bundle: Path | None = None

    def issue(self, name: str, role: Role, hosts: Sequence[str]) -> bool:
        """Write a request; returns False if there is one, or a certificate, with the same role and hosts."""
        wanted = Wanted(name, role, tuple(hosts))
        wanted.check()
        self.check([wanted])
        present = next((each for each in self.holders() if each.name == name and self._in_use(each)), None)
        for known in (self.waiting().get(name), present):
            if known and (not hosts or set(hosts) == set(known.hosts)):
                return False
        self._request(Holder(name, role, wanted.hosts or (present.hosts if present else ()), company=True))
        return True

    def rotate(self, name: str) -> None:
        """Write a request with a new key. The previous keys stay in force until its certificate is taken in."""
        known = self._known(name, "rotate")
        self._request(Holder(known.name, known.role, known.hosts, company=True))

    def revoke(self, name: str) -> None:
        """Withdraw a holder's keys: nobody knows their public key any more, whatever the authority says."""
        self._drop(name)
        if any(issued.name == name for issued in self.holders()):
            super(CompanyAuthority, self).revoke(name)

    def waiting(self) -> dict[str, Holder]:
        """By name, whose requests wait for their certificates."""
        found = {}
        for path in sorted(self._requests.glob("*.json")):
            with damage_reported(path):
                found[path.stem] = msgspec.json.decode(read(path), type=Holder)
        return found

    def request(self, name: str) -> Path:
        """The file for the authority."""
        return self.directory / REQUESTS / f"{name}.csr"

    def take(self, files: Sequence[Path]) -> list[str]:
        """Take in signed certificates, each with those between it and the authority if its bundle lacks them.

        returns  whose they are
        raises   ConfigError with all problems; nothing is then taken in
        """
        found, problems = dict[str, tuple[Holder, bytes]](), list[Problem]()
        for file in files:
            try:
                holder, chain = self._read_signed(file)
                found[holder.name] = (holder, chain)
            except UserError as error:
                problems += getattr(error, "problems", [Problem("", "", None, str(error))])
        if problems:
            raise ConfigError(problems, "nothing was taken in")
        for holder, chain in found.values():
            self._take(holder, chain)
        return list(found)

    def take_list(self, file: Path) -> None:
        """Take in the authority's revocation list; raises UserError"""
        try:
            content = read_file(file, keyring.MOST_BYTES)
            in_use = filter(self._in_use, self.holders())
            self._bundle.check_list(
                content, (read(self.directory / each.name / keyring.CERTIFICATE) for each in in_use)
            )
        except ValueError as error:
            raise UserError(str(file), "", None, f"must be a revocation list (PEM): {error}") from None
        write(self._own / keyring.REVOKED, content)
        self._distribute()

    # --- files --------------------------------------------------------------------------------------------------------

    @property
    def _requests(self) -> Path:
        return self._own / REQUESTS

    @property
    def _bundle(self) -> signed.Bundle:
        path = self._own / BUNDLE
        with damage_reported(path):
            return signed.Bundle(read(path))

    def prepare(self) -> None:
        """Take in the authority's certificates, if they were given; raises UserError"""
        if self.bundle is None:
            return
        try:
            content = read_file(self.bundle, keyring.MOST_BYTES)
            root = signed.Bundle(content).root
        except ValueError as error:
            raise UserError(str(self.bundle), "", None, f"must be certificates (PEM): {error}") from None
        write(self._own / keyring.AUTHORITY, root)
        write(self._own / BUNDLE, content)
        if (self._own / keyring.MEDIA_SECRET).exists():
            self._distribute()

    def _create(self) -> None:
        self.prepare()
        self._complete()

    def _roles(self) -> dict[str, Role]:
        return {**super(CompanyAuthority, self)._roles(), **{name: each.role for name, each in self.waiting().items()}}

    def _known(self, name: str, argument: str, revoked: bool = False) -> Issued:
        asked = self.waiting().get(name)
        if asked and argument == "revoke":
            return Issued(name, asked.role, "0", asked.hosts, self.now())
        return super(CompanyAuthority, self)._known(name, argument, revoked)

    def _common(self, holders: Sequence[Issued]) -> dict[str, bytes]:
        known = {
            fingerprint_of(read(self.directory / each.name / keyring.CERTIFICATE)): Holder(each.name, each.role)
            for each in holders
        }
        common = {
            keyring.AUTHORITY: read(self._own / keyring.AUTHORITY),
            keyring.HOLDERS: msgspec.json.format(msgspec.json.encode(known)),
        }
        listed = self._own / keyring.REVOKED
        return {**common, keyring.REVOKED: read(listed)} if listed.exists() else common

    def _request(self, holder: Holder) -> None:
        self._drop(holder.name)
        asked = new_request(holder.name, holder.role, holder.hosts)
        self._requests.mkdir(exist_ok=True)
        self.request(holder.name).parent.mkdir(exist_ok=True)
        write(self._requests / f"{holder.name}.key", asked.key)
        write(self.request(holder.name), asked.certificate)
        write(self._requests / f"{holder.name}.json", msgspec.json.encode(holder))  # last: marks it as complete

    def _drop(self, name: str) -> None:
        """Forget a request, if there is one."""
        for path in (self._requests / f"{name}.json", self._requests / f"{name}.key", self.request(name)):
            path.unlink(missing_ok=True)

    def _keys(self) -> Iterator[tuple[str, Holder]]:
        """Fingerprints of all keys that a certificate may be for: of requests, and of certificates in use."""
        for name, holder in self.waiting().items():
            yield fingerprint_of_key(read(self._requests / f"{name}.key")), holder
        for issued in filter(self._in_use, self.holders()):
            key = read(self.directory / issued.name / keyring.KEY)
            yield fingerprint_of_key(key), Holder(issued.name, issued.role, issued.hosts, company=True)

    def _read_signed(self, file: Path) -> tuple[Holder, bytes]:
        """Whose certificate a file has, and its chain; raises UserError, ConfigError"""
        try:
            certificates = x509.load_pem_x509_certificates(read_file(file, keyring.MOST_BYTES))
        except ValueError as error:
            raise UserError(str(file), "", None, f"must be a certificate (PEM): {error}") from None
        keys = dict(self._keys())
        leaf = next((each for each in certificates if fingerprint(each.public_key()) in keys), None)
        if leaf is None:
            rule = f"is for none of the requests in {self.directory / REQUESTS}: its key is another one"
            raise UserError(str(file), "", None, rule)
        holder = keys[fingerprint(leaf.public_key())]
        wrong = list(signed.problems(leaf, holder, self.now()))
        try:
            chain = self._bundle.chain(leaf, certificates)
        except ValueError as error:
            wrong.append(str(error))
        if wrong:
            raise ConfigError([Problem(str(file), f"{holder.role} {holder.name}", None, each) for each in wrong])
        return holder, chain

    def _take(self, holder: Holder, chain: bytes) -> None:
        leaf = x509.load_pem_x509_certificate(chain)
        issued = Issued(holder.name, holder.role, f"{leaf.serial_number:x}", holder.hosts, leaf.not_valid_after_utc)
        if holder.name in self.waiting():
            key = read(self._requests / f"{holder.name}.key")
            if fingerprint(leaf.public_key()) == fingerprint_of_key(key):
                self._install(issued, Pair(chain, key), company=True)
                self._drop(holder.name)
                return
        # A new certificate for the key in use: all else stays.
        self._write_issued([*(each for each in self._issued() if each.name != holder.name), issued])
        write(self.directory / holder.name / keyring.CERTIFICATE, chain)
