"""The login of a side at its broker, whoever set that up."""

from __future__ import annotations

from collections.abc import Callable

from runner.mqtt.login import BrokerLogin, Login
from runner.security.keyring import Keyring
from runner.settings import Control


def login_of(control: Control, keyring: Keyring | None, on_report: Callable[[str], None]) -> BrokerLogin | None:
    """The login of a side with these keys; None: the broker does not authenticate.

    on_report  as for `Login`
    raises     UserError if files cannot be used
    """
    if control.foreign:
        from runner.mqtt.foreign import ForeignLogin

        return ForeignLogin(control.foreign, keyring, on_report)
    return Login(keyring, on_report) if keyring else None
