"""Removes passwords from addresses in everything that is shown, logged or stored."""

from __future__ import annotations

import re
from typing import Any, TypeVar

T = TypeVar("T")

_USER = re.compile(r"(?<=://)[^/?#\s]*@")  # userinfo of RFC 3986, section 3.2.1
_NAMED = re.compile(r"(?i)((?<=[?&])(?:password|passwd|pwd)|\buser-pw)=[^&\s\"']+")  # in a query; property of rtspsrc


def has_password(address: str) -> bool:
    """Whether an address contains a user name or a password."""
    return bool(_USER.search(address) or _NAMED.search(address))


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
