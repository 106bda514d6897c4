"""Who may log in at a page beside its operator: a file of lines NAME ROLE TOKEN that only its owner may read.

The tokens are random and as long as an operator's own (`page.token`). Removing a line, or replacing its token, ends the
sessions of that person.
"""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from runner.core.roles import Role
from runner.errors import ArgumentError, UserError
from runner.security.keyring import NAME
from runner.system.files import exposure, read_file, write_whole

MOST_BYTES = 100_000
LEAST_TOKEN = 32  # characters; what `tod-runner keys` draws has 43
ROLES = (Role.CONTROLLER, Role.WATCHER)
HEAD = "# who may log in at the page: name, role, token"
RULE = "must be 1 to 64 letters, digits, _ and -"


class PagePerson(NamedTuple):
    """role: a controller may take control of the page, a watcher only looks at it."""

    role: Role
    token: bytes


def read_people(path: Path) -> Mapping[str, PagePerson]:
    """By name.

    raises  UserError, with all problems, also if others may read the file
    """
    return _people(path, _read(path))


def _read(path: Path) -> str:
    try:
        return read_file(path, MOST_BYTES).decode()
    except (ValueError, UnicodeDecodeError) as error:
        raise UserError("page.people", "", str(path), str(error)) from None


def _people(path: Path, text: str) -> dict[str, PagePerson]:
    problems = [exposed] if (exposed := exposure(path)) else []
    people: dict[str, PagePerson] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not (words := _words(line)):
            continue
        if problem := _problem(words, people):
            problems.append(f"line {number}: {problem}")
        else:
            people[words[0]] = PagePerson(Role(words[1]), words[2].encode())
    if problems:
        raise UserError("page.people", "", str(path), "; ".join(problems))
    return people


def _words(line: str) -> list[str]:
    """Those before a comment."""
    return line.partition("#")[0].split()


def _problem(words: list[str], before: Mapping[str, PagePerson]) -> str | None:
    """What is wrong with a line; never shows what may be a token."""
    if len(words) != 3:
        return f"has {len(words)} words, must have three: name, role and token"
    name, role, token = words
    rules = (
        (not NAME.fullmatch(name), f"the name {RULE}"),
        (name in before, f"{name} has a line already"),
        (role not in ROLES, f"the role of {name} must be {' or '.join(ROLES)}"),
        (len(token) < LEAST_TOKEN, f"the token of {name} must have at least {LEAST_TOKEN} characters"),
        (token.encode() in {other.token for other in before.values()}, f"the token of {name} is another one's, too"),
    )
    return next((text for is_broken, text in rules if is_broken), None)


def change_people(
    path: Path, wanted: Mapping[str, Role], rotate: str | None = None, revoke: str | None = None
) -> Mapping[str, PagePerson]:
    """Add people with new tokens, give others another role, replace a token, and remove a person, in this order.

    The other lines of the file stay as they are. Returns everybody in it then.

    raises  UserError, and nothing is changed
    """
    for name, role in wanted.items():
        if not NAME.fullmatch(name):
            raise ArgumentError(role, repr(name), RULE)
    text = _read(path) if path.exists() else HEAD
    people = _people(path, text) if path.exists() else {}
    lines = text.splitlines()
    for name, role in wanted.items():
        known = people.get(name)
        people[name] = PagePerson(role, known.token if known else _new_token())
        lines = _replaced(lines, name, people[name])
    if rotate is not None:
        people[rotate] = PagePerson(_known("rotate", rotate, people).role, _new_token())
        lines = _replaced(lines, rotate, people[rotate])
    if revoke is not None:
        _known("revoke", revoke, people)
        del people[revoke]
        lines = [line for line in lines if _words(line)[:1] != [revoke]]
    if lines != text.splitlines():
        write_whole(path, "\n".join([*lines, ""]).encode(), secret=True)
    return people


def _new_token() -> bytes:
    return secrets.token_urlsafe(32).encode()


def _replaced(lines: list[str], name: str, person: PagePerson) -> list[str]:
    """The lines with that of a person replaced, or appended."""
    own = f"{name} {person.role} {person.token.decode()}"
    if any(_words(line)[:1] == [name] for line in lines):
        return [own if _words(line)[:1] == [name] and _words(line) != own.split() else line for line in lines]
    return [*lines, own]


def _known(argument: str, name: str, people: Mapping[str, PagePerson]) -> PagePerson:
    if name not in people:
        known = f"one of {', '.join(people)}" if people else "somebody in the file, which names nobody"
        raise ArgumentError(argument, name, f"must be {known}")
    return people[name]
