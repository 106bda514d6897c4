"""What an operator's side receives that has the pictures sent only while somebody looks at them. Pure."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from math import inf

from runner.operator.station import Presence

LINGER_S = 2.0  # what nobody looks at any more is received for so long: a page may be loading again


@dataclass
class Demand:
    """What the open windows of all pages ask for. Times are s."""

    _shown: frozenset[str] = frozenset()
    _is_open: bool = False
    _seen: dict[str, float] = field(default_factory=dict)  # by camera, when it was last asked for
    _opened: float = -inf  # when a page was last open

    def ask(self, cameras: Collection[str], *, is_open: bool, now: float) -> None:
        """Windows show these cameras from now on.

        is_open  whether one of them is a page, with which a person drives, and not only a picture
        """
        self._note(now)
        self._shown, self._is_open = frozenset(cameras), is_open
        self._note(now)

    def cameras(self, now: float) -> frozenset[str]:
        """The cameras to receive."""
        self._note(now)
        return frozenset(name for name, seen in self._seen.items() if now - seen < LINGER_S)

    def presence(self, now: float, *, holds_control: bool) -> Presence:
        """How to show it to the vehicle. An operator that holds control does not leave by closing the page.

        Control that is left from an earlier run returns with a page, not by itself.
        """
        self._note(now)
        if now - self._opened < (inf if holds_control else LINGER_S):
            return Presence.DRIVING
        return Presence.WATCHING if self.cameras(now) else Presence.ABSENT

    def _note(self, now: float) -> None:
        self._seen |= dict.fromkeys(self._shown, now)
        if self._is_open:
            self._opened = now
