"""Login to the page from another machine, by proof of having its token. Times are passed in, s.

The browser answers a challenge with the HMAC-SHA256 of a random text, keyed with the token. The token itself is never
sent, and a recorded answer cannot be replayed: each challenge opens a single session. A challenge states when it
expires and is signed, so that nothing is stored for those who only ask for one.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections.abc import Callable

from runner.security.keyring import derived

CHALLENGE_S = 60.0  # until an unanswered challenge expires
SESSION_S = 43_200.0  # twelve hours after its last use; an open page uses it
MAX_SESSIONS = 100
COOKIE = "__Host-tod_session"  # browsers accept such a name only from this very host, over HTTPS


class PageLogin:
    """Challenges and open sessions.

    token  returns the page's current token; a new token ends all sessions
    """

    def __init__(self, token: Callable[[], bytes]) -> None:
        self._token = token
        self._session_token = token()
        self._signing = secrets.token_bytes(32)  # key of this process
        self._answered: dict[str, float] = {}  # challenges that opened a session; values: when they expire
        self._sessions: dict[str, float] = {}

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
        expected = hmac.new(self._token(), challenge.encode(), hashlib.sha256).hexdigest()
        if not hmac.compare_digest(expected.encode(), answer.encode(errors="replace")):
            return None
        self._answered = {it: until for it, until in self._answered.items() if until >= now} | {challenge: expires}
        return _open(self._sessions, now)

    def accepts(self, session: str | None, now: float) -> bool:
        """Whether a session is open; it then stays open."""
        if self._session_token != (token := self._token()):
            self._session_token = token
            self._sessions.clear()
        if session is None or self._sessions.get(session, -1.0) < now:
            return False
        self._sessions[session] = now + SESSION_S  # it must not end while somebody drives
        return True


def _open(sessions: dict[str, float], now: float) -> str:
    """Add a session with a random name, in place of the oldest if there are too many; returns the name."""
    for expired in [name for name, expires in sessions.items() if expires < now]:
        del sessions[expired]
    if len(sessions) >= MAX_SESSIONS:
        del sessions[min(sessions, key=lambda name: sessions[name])]
    name = secrets.token_urlsafe(32)
    sessions[name] = now + SESSION_S
    return name
