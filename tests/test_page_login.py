"""Logging in to the page from another machine."""

from __future__ import annotations

import hashlib
import hmac
import tracemalloc

from runner.page.login import CHALLENGE_S, SESSION_S, PageLogin


def answer(challenge: str, token: bytes = b"token") -> str:
    return hmac.new(token, challenge.encode(), hashlib.sha256).hexdigest()


def test_a_correct_answer_opens_a_session_until_it_expires() -> None:
    login = PageLogin(lambda: b"token")
    challenge = login.challenge(0)
    session = login.open(challenge, answer(challenge), 1)
    assert session is not None
    assert login.accepts(session, 1 + SESSION_S), "used in time, it stays open"
    assert login.accepts(session, 1 + 2 * SESSION_S)
    assert not login.accepts(session, 2 + 3 * SESSION_S)
    assert not login.accepts(None, 1)
    assert not login.accepts("guessed", 1)


def test_an_answer_is_accepted_once_in_time_and_with_the_token() -> None:
    login = PageLogin(lambda: b"token")
    challenge = login.challenge(0)
    assert login.open(challenge, answer(challenge), 0)
    assert login.open(challenge, answer(challenge), 0) is None  # replayed
    challenge = login.challenge(0)
    assert login.open(challenge, answer(challenge, b"another"), 0) is None
    assert login.open(challenge, answer(challenge), 0)
    challenge = login.challenge(0)
    assert login.open(challenge, answer(challenge), CHALLENGE_S + 0.1) is None
    for made_up in ("made up", "60000.made up", "", challenge.replace("60000", "90000"), "60000.ä.\ud800"):
        assert login.open(made_up, answer("made up"), 0) is None
    assert PageLogin(lambda: b"token").open(challenge, answer(challenge), 0) is None  # of another process
    challenge = login.challenge(0)
    assert login.open(challenge, "ä\ud800", 0) is None


def test_a_new_token_ends_all_sessions() -> None:
    tokens = [b"token"]
    login = PageLogin(lambda: tokens[-1])
    challenge = login.challenge(0)
    session = login.open(challenge, answer(challenge), 0)
    assert login.accepts(session, 1)
    tokens.append(b"new")
    assert not login.accepts(session, 1)


def test_strangers_who_ask_for_challenges_neither_evict_one_nor_fill_the_memory() -> None:
    login = PageLogin(lambda: b"token")
    challenge = login.challenge(0)
    tracemalloc.start()
    for n in range(1000):
        login.challenge(n / 1000)
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 10_000
    assert login.open(challenge, answer(challenge), 1)
