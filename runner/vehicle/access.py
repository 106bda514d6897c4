"""Access control: who may request what of this vehicle, according to its keys."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from runner.core.driving import Control, Driving
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

    def denial(self, sender: str, event: str) -> str | None:
        """Why the role of a sender may not request an event; None if it may."""
        return None if self._people is None else denial(self.role(sender), event)

    def unheld(self, sender: str, event: str, driving: Driving) -> str | None:
        """Why a sender, who is not in control, may not change what is sent; None if it may.

        While nobody drives, programs may that are no operator's side. Without keys, which prove no name, they may also
        while somebody drives.
        """
        if event not in DRIVER_EVENTS or driving.in_control == sender:
            return None
        if driving.state is Control.LOST:
            return f"{driving.holder} was in control and is lost: only its return, or a supervisor, changes that"
        if sender not in driving.present and (driving.state is Control.FREE or self._people is None):
            return None
        return f"{driving.in_control} is in control" if driving.in_control else "nobody is in control: request it"

    def role(self, name: str) -> Role | None:
        """The role of an operator; None: it may no longer do anything. Without keys, all may do everything."""
        if self._people is None:
            return Role.SUPERVISOR
        person = self._people.get().get(name)
        return person.role if person else None
