"""Who may open the page from another machine: whoever proves to have its token. Times are passed in, s.

The browser answers a challenge, HMAC-SHA256 of a random text with the token as key. So the token itself never travels,
and an answer that somebody has recorded is of no use: each challenge is good for one answer.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections.abc import Callable

CHALLENGE_S = 60.0  # how long a challenge waits for its answer
CHALLENGES = 100  # that wait at once; the oldest is forgotten for a new one
SESSION_S = 43_200.0  # twelve hours; then the browser proves itself again
SESSIONS = 100
COOKIE = "tod_session"


class PageLogin:
    """Challenges that wait for an answer, and sessions that followed from a right one.

    token  the page's token, as it is now: with another one all sessions end
    """

    def __init__(self, token: Callable[[], bytes]) -> None:
        self._token = token
        self._used = token()
        self._challenges: dict[str, float] = {}  # and until when
        self._sessions: dict[str, float] = {}

    def challenge(self, now: float) -> str:
        """A new challenge."""
        return _added(self._challenges, now, CHALLENGE_S, CHALLENGES)

    def open(self, challenge: str, answer: str, now: float) -> str | None:
        """The session that a right answer opens; None for a wrong one, and for a challenge that was answered before."""
        if self._challenges.pop(challenge, -1.0) < now:
            return None
        expected = hmac.new(self._token(), challenge.encode(), hashlib.sha256).hexdigest()
        if not hmac.compare_digest(expected.encode(), answer.encode(errors="replace")):
            return None
        return _added(self._sessions, now, SESSION_S, SESSIONS)

    def accepts(self, session: str | None, now: float) -> bool:
        """Whether a session is open."""
        if self._used != (token := self._token()):
            self._used = token
            self._sessions.clear()
        return session is not None and self._sessions.get(session, -1.0) >= now


def _added(known: dict[str, float], now: float, seconds: float, most: int) -> str:
    for old in [name for name, until in known.items() if until < now]:
        del known[old]
    if len(known) >= most:
        del known[min(known, key=lambda name: known[name])]
    name = secrets.token_urlsafe(32)
    known[name] = now + seconds
    return name
