"""Logging in to the page from another machine."""

from __future__ import annotations

import hashlib
import hmac
import tracemalloc

from runner.core.roles import Role
from runner.page.login import CHALLENGE_S, MAX_SESSIONS, SESSION_S, PageLogin, Visitor
from runner.security.page_people import PagePerson

ALICE, BOB = PagePerson(Role.CONTROLLER, b"token"), PagePerson(Role.WATCHER, b"another")


def answer(challenge: str, token: bytes = b"token") -> str:
    return hmac.new(token, challenge.encode(), hashlib.sha256).hexdigest()


def test_a_correct_answer_opens_a_session_until_it_expires() -> None:
    login = PageLogin(lambda: {"alice": ALICE})
    challenge = login.challenge(0)
    session = login.open(challenge, answer(challenge), 1)
    assert session is not None
    assert login.visitor(session, 1 + SESSION_S), "used in time, it stays open"
    assert login.visitor(session, 1 + 2 * SESSION_S)
    assert not login.visitor(session, 2 + 3 * SESSION_S)
    assert not login.visitor(None, 1)
    assert not login.visitor("guessed", 1)


def test_an_answer_is_accepted_once_in_time_and_with_the_token() -> None:
    login = PageLogin(lambda: {"alice": ALICE})
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
    assert PageLogin(lambda: {"alice": ALICE}).open(challenge, answer(challenge), 0) is None  # of another process
    challenge = login.challenge(0)
    assert login.open(challenge, "ä\ud800", 0) is None


def test_each_token_opens_a_session_of_its_person_and_role() -> None:
    people = {"alice": ALICE, "bob": BOB}
    login = PageLogin(lambda: people)
    sessions = []
    for token in (b"token", b"another"):
        challenge = login.challenge(0)
        sessions.append(login.open(challenge, answer(challenge, token), 0))
    alice, bob = sessions
    assert login.visitor(alice, 1) == Visitor("alice", Role.CONTROLLER)
    assert login.visitor(bob, 1) == Visitor("bob", Role.WATCHER)
    assert Visitor("alice", Role.CONTROLLER).may_drive
    assert not Visitor("bob", Role.WATCHER).may_drive


def test_a_new_token_another_role_and_removal_end_the_sessions_of_that_person_only() -> None:
    for changed in ({}, {"bob": PagePerson(Role.WATCHER, b"new")}, {"bob": PagePerson(Role.CONTROLLER, b"another")}):
        people = {"alice": ALICE, "bob": BOB}
        login = PageLogin(lambda people=people: people)  # type: ignore[misc]
        challenge = login.challenge(0)
        alice = login.open(challenge, answer(challenge), 0)
        challenge = login.challenge(0)
        bob = login.open(challenge, answer(challenge, b"another"), 0)
        del people["bob"]
        people |= changed
        assert login.visitor(bob, 1) is None
        assert login.visitor(alice, 1)


def test_many_sessions_of_a_watcher_end_no_session_of_the_operator() -> None:
    login = PageLogin(lambda: {"alice": ALICE, "bob": BOB})

    def opened(token: bytes) -> str | None:
        challenge = login.challenge(0)
        return login.open(challenge, answer(challenge, token), 0)

    alice = opened(b"token")
    bobs = [opened(b"another") for _ in range(MAX_SESSIONS + 3)]
    assert login.visitor(alice, 1)
    assert [login.visitor(bob, 1) is not None for bob in bobs] == [False] * 3 + [True] * MAX_SESSIONS


def test_strangers_who_ask_for_challenges_neither_evict_one_nor_fill_the_memory() -> None:
    login = PageLogin(lambda: {"alice": ALICE})
    challenge = login.challenge(0)
    tracemalloc.start()
    for n in range(1000):
        login.challenge(n / 1000)
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 10_000
    assert login.open(challenge, answer(challenge), 1)
