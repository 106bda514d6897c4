"""Whether an element's property takes a value that is written as text, as GStreamer reads it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable

from runner.core.model import Value
from runner.elements.description import EnumValue, Property
from runner.turning import text

_WHOLE = re.compile(r"[+-]?(?:0x(?P<hexadecimal>[0-9a-f]+)|0(?P<octal>[0-7]+)|[0-9]+)", re.IGNORECASE)
_REAL = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE)
_FRACTION = re.compile(r"[+-]?\d+(/0*[1-9]\d*)?")
_INTEGERS = ("gint", "guint", "glong", "gulong", "gint64", "guint64", "gchar", "guchar")
_REALS = ("gfloat", "gdouble")
_TRUTH = ("true", "t", "yes", "1", "false", "f", "no", "0")
_BOUNDS = ("min", "max")  # of the type


def value_problem(kind: Property, value: Value, reads: Callable[[str, str], bool]) -> str | None:
    """Why a property does not take a value; None if it does.

    reads  whether a text is a value of a type that is not known here, such as GstCaps
    """
    written = text(value).strip()
    if kind.type in (*_INTEGERS, *_REALS):
        return _number_problem(kind, written)
    if kind.enum or kind.flags:
        listed = kind.enum or kind.flags
        words = [written] if kind.enum else written.split("+")
        fits = all(_is_listed(word, listed, any_number=bool(kind.flags)) for word in words)
        return None if fits else f"must be one of {', '.join(each.nick for each in listed)}"
    return None if _reads(kind.type, written, reads) else f"must be a {kind.type.removeprefix('g')}"


def _reads(kind: str, written: str, reads: Callable[[str, str], bool]) -> bool:
    if kind == "gchararray":
        return True
    if kind == "gboolean":
        return written.lower() in _TRUTH
    if kind == "GstFraction":
        return bool(_FRACTION.fullmatch(written)) or written.lower() in _BOUNDS
    return reads(kind, written)


def _number_problem(kind: Property, written: str) -> str | None:
    if written.lower() in _BOUNDS:
        return None
    whole = _WHOLE.fullmatch(written)
    if not (whole or (kind.type in _REALS and _REAL.fullmatch(written))):
        return f"must be a {kind.type.removeprefix('g')}"
    number = _whole(whole) if whole else float(written)
    if kind.least is None or kind.most is None or kind.least <= number <= kind.most:
        return None
    return f"must be from {kind.least} to {kind.most}"


def _whole(found: re.Match[str]) -> int:
    """A whole number as C writes it: 10, 0xa, 012."""
    base = 16 if found["hexadecimal"] else 8 if found["octal"] else 10
    return int(found[0], base)


def _is_listed(word: str, listed: Iterable[EnumValue], *, any_number: bool) -> bool:
    """Whether a word names one of the values, or is the number of one. GStreamer 1.28 alone ignores upper case."""
    if any(word in (each.nick, each.name) for each in listed):
        return True
    number = _WHOLE.fullmatch(word)
    return number is not None and (any_number or _whole(number) in [each.number for each in listed])
