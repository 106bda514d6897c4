"""Access control: who may request what of this vehicle, according to its keys."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from runner.core.roles import DRIVER_EVENTS, Role, denial
from runner.security.keyring import Keyring, Person, Watched


class Access:
    """Decides about each request. Without keys, anyone may request anything.

    on_report  called with the problem of a new list of people
    """

    def __init__(self, keyring: Keyring | None = None, on_report: Callable[[str], None] = print) -> None:
        self._people: Watched[Mapping[str, Person]] | None = None
        if keyring:
            self._people = keyring.watched_people(on_report)

    def denial(self, sender: str, event: str, in_control: str) -> str | None:
        """Why a sender may not request an event now; None if it may.

        in_control  the operator in control, "" for none; while there is one, no other changes what is sent
        """
        if self._people is None:
            return None
        if why := denial(self._role(sender), event):
            return why
        return f"{in_control} is in control" if event in DRIVER_EVENTS and in_control not in ("", sender) else None

    def may_control(self, operator: str) -> bool:
        return self._people is None or self._role(operator) is Role.CONTROLLER

    def _role(self, name: str) -> Role | None:
        assert self._people
        person = self._people.get().get(name)
        return person.role if person else None
