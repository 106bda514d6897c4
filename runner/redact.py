"""Removes passwords from addresses in everything that is shown, logged or stored, and escapes control characters."""

from __future__ import annotations

import re
from typing import Any, TypeVar

T = TypeVar("T")

# User name and password, as GStreamer reads them: they end at the first @, / or ?, and may contain # and blanks. To the
# last @, since a password that contains one is no less secret for not working.
_USER = re.compile(r"(?<=://)[^/?\n]*@")
_NAMED = re.compile(r"(?i)((?<=[?&])(?:password|passwd|pwd)|\buser-pw)=[^&\s\"']+")  # in a query; property of rtspsrc


# Control characters but newline and tab, and those that reorder text: a terminal obeys them, whoever sent them.
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


def has_password(address: str) -> bool:
    """Whether an address contains a user name or a password."""
    return bool(_USER.search(address) or _NAMED.search(address))


def printable(text: str) -> str:
    """A message that may be printed: without passwords, control characters escaped as in Python."""
    return _CONTROL.sub(lambda found: found.group().encode("unicode_escape").decode(), redacted(text))


def redacted(value: T) -> T:
    """A text, or a document containing texts, with `user:password@` removed from addresses."""
    found: Any = value
    if isinstance(value, str):
        found = _NAMED.sub(r"\1=***", _USER.sub("", value))
    elif isinstance(value, dict):
        found = {key: "***" if key == "user-pw" else redacted(inner) for key, inner in value.items()}
    elif isinstance(value, list | tuple):
        found = type(value)(map(redacted, value))
    result: T = found
    return result
