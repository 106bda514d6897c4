"""Login to the page from another machine, by proof of having its token. Times are passed in, s.

The browser answers a challenge with the HMAC-SHA256 of a random text, keyed with the token. The token itself is never
sent, and a recorded answer cannot be replayed: each challenge accepts a single answer.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections.abc import Callable

CHALLENGE_S = 60.0  # until an unanswered challenge expires
MAX_CHALLENGES = 100  # pending; a new one evicts the oldest
SESSION_S = 43_200.0  # twelve hours; then the browser must log in again
MAX_SESSIONS = 100
COOKIE = "tod_session"


class PageLogin:
    """Pending challenges and open sessions.

    token  returns the page's current token; a new token ends all sessions
    """

    def __init__(self, token: Callable[[], bytes]) -> None:
        self._token = token
        self._session_token = token()
        self._challenges: dict[str, float] = {}  # values: when they expire
        self._sessions: dict[str, float] = {}

    def challenge(self, now: float) -> str:
        """A new challenge."""
        return _add(self._challenges, now, CHALLENGE_S, MAX_CHALLENGES)

    def open(self, challenge: str, answer: str, now: float) -> str | None:
        """Open a session for a correct answer; None if it is wrong, or the challenge expired or was answered before."""
        if self._challenges.pop(challenge, -1.0) < now:
            return None
        expected = hmac.new(self._token(), challenge.encode(), hashlib.sha256).hexdigest()
        if not hmac.compare_digest(expected.encode(), answer.encode(errors="replace")):
            return None
        return _add(self._sessions, now, SESSION_S, MAX_SESSIONS)

    def accepts(self, session: str | None, now: float) -> bool:
        """Whether a session is open."""
        if self._session_token != (token := self._token()):
            self._session_token = token
            self._sessions.clear()
        return session is not None and self._sessions.get(session, -1.0) >= now


def _add(entries: dict[str, float], now: float, lifetime_s: float, limit: int) -> str:
    """Add a random name with an expiry time; returns it."""
    for expired in [name for name, expires in entries.items() if expires < now]:
        del entries[expired]
    if len(entries) >= limit:
        del entries[min(entries, key=lambda name: entries[name])]
    name = secrets.token_urlsafe(32)
    entries[name] = now + lifetime_s
    return name
