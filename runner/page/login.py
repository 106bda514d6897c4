"""Login to the page from another machine, by proof of having a token. Times are passed in, s.

The browser answers a challenge with the HMAC-SHA256 of a random text, keyed with the token. The token itself is never
sent, and a recorded answer cannot be replayed: each challenge opens a single session. A challenge states when it
expires and is signed, so that nothing is stored for those who only ask for one. Whose token it is tells who logs in.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from runner.core.roles import Role
from runner.errors import UserError
from runner.security.keyring import TOKEN, Keyring, Watched, derived
from runner.security.page_people import PagePerson, read_people

CHALLENGE_S = 60.0  # until an unanswered challenge expires
SESSION_S = 43_200.0  # twelve hours after its last use; an open page uses it
MAX_SESSIONS = 20  # of one person, who cannot end those of others by opening more
COOKIE = "__Host-tod_session"  # browsers accept such a name only from this very host, over HTTPS


class Visitor(NamedTuple):
    """Who has a page open. name: "" for whoever uses the operator's own machine."""

    name: str
    role: Role

    @property
    def may_drive(self) -> bool:
        return self.role is not Role.WATCHER

    def words(self) -> str:
        """As a relay states it to a station, which `of` reads."""
        return f"{self.role} {self.name}"

    @staticmethod
    def of(words: str) -> Visitor:
        role, _, name = words.partition(" ")
        return Visitor(name, Role(role))


OPERATOR = Visitor("", Role.CONTROLLER)
RELAYED = "Tod-Visitor"  # header of a request that the page of several vehicles passes on: whose it is


def people_of(
    keyring: Keyring, file: str | None, on_report: Callable[[str], None]
) -> Callable[[], Mapping[str, PagePerson]]:
    """Returns who may log in now: the operator, and those in a file.

    raises  UserError
    """
    name, token = keyring.holder.name, keyring.watched(TOKEN, on_report)
    others = Watched(Path(file), lambda: read_people(Path(file)), on_report) if file else None
    if others and name in others.get():
        rule = f"must not name {name}, whose page it is and whose token is in {TOKEN}"
        raise UserError("page.people", name, str(file), rule)
    return lambda: {**(others.get() if others else {}), name: PagePerson(Role.CONTROLLER, token.get())}


class _Session(NamedTuple):
    name: str
    person: PagePerson
    expires: float


class PageLogin:
    """Challenges and open sessions.

    people  returns who may log in now, by name; who is removed, or has another token or role, has no session any more
    """

    def __init__(self, people: Callable[[], Mapping[str, PagePerson]]) -> None:
        self._people = people
        self._signing = secrets.token_bytes(32)  # key of this process
        self._answered: dict[str, float] = {}  # challenges that opened a session; values: when they expire
        self._sessions: dict[str, _Session] = {}  # by random name, the oldest first

    def challenge(self, now: float) -> str:
        """A new challenge: when it expires, ms, a random text, and a signature, separated by dots."""
        text = f"{round(1000 * (now + CHALLENGE_S))}.{secrets.token_urlsafe(32)}"
        return f"{text}.{derived(self._signing, text)}"

    def open(self, challenge: str, answer: str, now: float) -> str | None:
        """Open a session for a correct answer; None if it is wrong, or the challenge expired or opened one before."""
        text, _, signature = challenge.encode(errors="replace").decode().rpartition(".")
        if not hmac.compare_digest(derived(self._signing, text).encode(), signature.encode()):
            return None
        expires = int(text.partition(".")[0]) / 1000
        if expires < now or challenge in self._answered:
            return None
        whose = self._whose(challenge, answer)
        if whose is None:
            return None
        self._answered = {it: until for it, until in self._answered.items() if until >= now} | {challenge: expires}
        return self._open(*whose, now)

    def _whose(self, challenge: str, answer: str) -> tuple[str, PagePerson] | None:
        """Whose token an answer proves. All are compared, so that the time it takes tells nothing."""
        found = None
        for name, person in self._people().items():
            expected = hmac.new(person.token, challenge.encode(), hashlib.sha256).hexdigest()
            if hmac.compare_digest(expected.encode(), answer.encode(errors="replace")):
                found = name, person
        return found

    def visitor(self, session: str | None, now: float) -> Visitor | None:
        """Whose session is open, which then stays open; None if it is not open."""
        found = self._sessions.get(session) if session else None
        if session is None or found is None or found.expires < now or self._people().get(found.name) != found.person:
            return None
        # It must not end while somebody drives.
        self._sessions[session] = found._replace(expires=now + SESSION_S)
        return Visitor(found.name, found.person.role)

    def _open(self, name: str, person: PagePerson, now: float) -> str:
        """Add a session, in place of the person's oldest if there are too many; returns its random name."""
        self._sessions = {key: each for key, each in self._sessions.items() if each.expires >= now}
        own = [key for key, each in self._sessions.items() if each.name == name]
        for key in own[: max(0, len(own) + 1 - MAX_SESSIONS)]:
            del self._sessions[key]
        session = secrets.token_urlsafe(32)
        self._sessions[session] = _Session(name, person, now + SESSION_S)
        return session
