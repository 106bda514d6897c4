"""What `doctor` finds about a broker that `tod-runner keys` did not set up."""

from __future__ import annotations

import socket
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from paho.mqtt.client import Client, MQTTv5
from paho.mqtt.enums import CallbackAPIVersion

from runner.core.roles import Role
from runner.errors import ConfigError, RunError, UserError
from runner.mqtt import refusal
from runner.mqtt.link import login_of
from runner.mqtt.login import BrokerLogin
from runner.security.broker_files import permitted
from runner.security.exposure import check_guarded
from runner.security.foreign import ForeignFiles
from runner.security.keyring import Keyring
from runner.security.validity import date
from runner.settings import Control, Setup
from runner.verbs.doctor_uplinks import Diagnosis

ANSWER_S = 5.0
KEEPALIVE_S = 10
NOBODY = "doctor-probe"  # in whose name nobody may write
LOST = "the broker ended the connection"


def check_broker(setup: Setup, verb: str) -> Iterator[Diagnosis]:
    """Whether its files, its address, its certificate, the login and its rules for topics work for a side."""
    control, keyring = setup.control, Keyring(Path(setup.keys)) if setup.keys else None
    if wrong := list(_wrong(control, keyring)):
        yield from (Diagnosis(False, each) for each in wrong)
        return
    name = f"broker {control}"
    login = login_of(control, keyring, lambda what: None)
    assert login
    fine, found = _handshake(control, login)
    yield Diagnosis(fine, f"{name}: {found}")
    if fine:
        role = keyring.holder.role if keyring else Role.VEHICLE if verb == "vehicle" else Role.CONTROLLER
        for result in _Probe(control, login).examine(setup.vehicle.name, role):
            yield Diagnosis(result.fine, f"{name}: {result.what}")


def _wrong(control: Control, keyring: Keyring | None) -> Iterator[str]:
    """What a start would refuse."""
    assert control.foreign
    foreign, checks = control.foreign, list[Callable[[], object]]()
    checks += [lambda: check_guarded(control), lambda: Keyring.of(keyring.directory) if keyring else None]
    checks.append(lambda: ForeignFiles.of(foreign, keyring).check())
    for check in checks:
        try:
            check()
        except ConfigError as error:
            yield from map(str, error.problems)
        except UserError as error:
            yield str(error)


def _handshake(control: Control, login: BrokerLogin) -> Diagnosis:
    """Whether it is reached, and its certificate is accepted."""
    try:
        with (
            socket.create_connection((control.host, control.port), ANSWER_S) as line,
            login.context.wrap_socket(line, server_hostname=control.host) as secured,
        ):
            login.check(secured)
    except RunError as error:
        return Diagnosis(False, str(error))
    except (OSError, ValueError) as error:
        return Diagnosis(False, refusal.of_failure(error, login.demands))
    ends = login.ends()["the broker's"]
    return Diagnosis(True, f"its certificate names it, and is valid until {date(ends)}")


class _Probe:
    """A connection by MQTT 5, whose answers say what the broker refuses, and why."""

    def __init__(self, control: Control, login: BrokerLogin) -> None:
        self._control, self._login = control, login
        self._answers: SimpleQueue[str] = SimpleQueue()  # why something is refused; "": it is granted
        self._is_lost = False
        client = Client(CallbackAPIVersion.VERSION2, client_id=_new_id(), protocol=MQTTv5, reconnect_on_failure=False)
        client.on_connect = lambda _client, _data, _flags, code, _properties: self._answer(code)
        client.on_publish = lambda _client, _data, _mid, code, _properties: self._answer(code)
        client.on_subscribe = lambda _client, _data, _mid, codes, _properties: self._answer(codes[0])
        client.on_disconnect = client.on_connect_fail = self._on_lost
        client.tls_set_context(login.context)
        password = login.refresh()
        client.username_pw_set(login.user, password)
        self._client = client

    def examine(self, vehicle: str, role: Role) -> Iterator[Diagnosis]:
        """Whether a side may log in, read and write what it must, and nothing in the name of another."""
        control = self._control
        try:
            refused = self._ask(self._connect)
            yield Diagnosis(not refused, f"login {refused}{self._login.source}" if refused else self._logged_in())
            if refused:
                return
            name = vehicle if role is Role.VEHICLE else self._login.identity
            _, reads = permitted(control.prefix, vehicle, name, role)
            own = f"clock/{NOBODY}" if role is Role.VEHICLE else f"request/{name}"
            own, other = (f"{control.prefix}/{vehicle}/{each}" for each in (own, f"request/{NOBODY}"))
            lacking = [f"read {each}" for each in reads if self._ask(lambda each=each: self._client.subscribe(each, 1))]  # type: ignore[misc]
            lacking += [f"write {own}"] if self._ask(lambda: self._client.publish(own, b"", 1)) else []
            yield Diagnosis(
                not lacking, f"refuses to let it {', '.join(lacking)}" if lacking else "refuses none of its topics"
            )
            if self._is_lost:
                return
            refused = self._ask(lambda: self._client.publish(other, b"", 1))
            guards = "lets nobody write in the name of another" if refused else f"lets it write {other}: see its rules"
            yield Diagnosis(bool(refused), guards)
        finally:
            self._client.disconnect()
            self._client.loop_stop()

    def _connect(self) -> None:
        self._client.connect_async(self._control.host, self._control.port, KEEPALIVE_S)
        self._client.loop_start()

    def _logged_in(self) -> str:
        return f"login accepted{f' as {self._login.user}' if self._login.user else ''}"

    def _on_lost(self, *_: object) -> None:
        self._is_lost = True
        self._answers.put(LOST)

    def _answer(self, code: Any) -> None:
        self._answers.put(f"refused: {code}".lower() if code.is_failure else "")

    def _ask(self, send: Callable[[], object]) -> str:
        """Why the broker refuses something; "" if it does not."""
        if self._is_lost:
            return LOST
        send()
        try:
            return self._answers.get(timeout=ANSWER_S)
        except Empty:
            return "refused: no answer"


def _new_id() -> str:
    return f"tod{uuid.uuid4().hex[:20]}"
