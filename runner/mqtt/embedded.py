"""The broker as a part of one side, so that two machines need no other program: `control.broker=embedded`."""

from __future__ import annotations

import errno
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import Queue

from runner.core.roles import Role
from runner.errors import RunError, UserError
from runner.mqtt.broker import START_S, Broker, find_mosquitto
from runner.security.exposure import is_loopback
from runner.security.keyring import HOLDER, Keyring
from runner.settings import Control, Setup
from runner.system.ports import check_port_free, ip_address_of

CHECK_S = 0.25
AGAIN_S = 1.0  # from the end of a broker to the next one
END_S = 1.0  # how long its end may take


@contextmanager
def embedded_broker(setup: Setup, on_report: Callable[[str], None]) -> Iterator[None]:
    """mosquitto at control.host during the block, started again should it end.

    on_report  called, from another thread, with a line about clients that it refuses, and when it had to start again
    raises     UserError if control.host is no address of this machine, or if its keys are missing; RunError if
               mosquitto is missing or does not start
    """
    find_mosquitto()
    _check_own(setup.control)
    supervised = _Supervised(setup.control, broker_keys(setup), on_report)
    try:
        yield
    finally:
        supervised.end()


def broker_keys(setup: Setup) -> Path | None:
    """The broker's keys, in the directory `broker` next to this side's; None: nothing is encrypted.

    raises  UserError
    """
    if setup.keys is None:
        return None
    directory, host = Path(setup.keys).absolute().with_name("broker"), setup.control.host
    if not (directory / HOLDER).exists():
        rule = f"needs the broker's keys in {directory}: those that `tod-runner keys output=DIR broker={host}` makes"
        raise UserError("", "control.broker", "embedded", rule)
    holder = Keyring.of(directory).holder
    if holder.role is not Role.BROKER or not (is_loopback(host) or host in holder.hosts):
        found = f"{holder.role} at {', '.join(holder.hosts)}" if holder.hosts else str(holder.role)
        rule = f"must be those of a broker at control.host: tod-runner keys output=DIR broker={host}"
        raise UserError(str(directory), "", found, rule)
    return directory


def _check_own(control: Control) -> None:
    """raises UserError if the broker's address belongs to another machine; RunError if its port is taken"""
    try:
        address = ip_address_of(control.host)
        with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET) as probe:
            probe.bind((address, 0))
    except OSError as error:
        if error.errno != errno.EADDRNOTAVAIL:
            raise RunError(f"control.host {control.host}: {error.strerror}") from None
        rule = "is no address of this machine: control.broker=embedded belongs to the side that has it"
        raise UserError("", "control.host", control.host, rule) from None
    try:
        check_port_free(control)
    except RunError as error:
        raise RunError(f"{error}; if a broker runs there already, leave out control.broker=embedded") from None


class _Supervised:
    """A broker, and the thread that starts it, and another one should it end.

    The kernel ends a broker with the thread that has started it: this one lasts as long as the side.
    """

    def __init__(self, control: Control, keys: Path | None, on_report: Callable[[str], None]) -> None:
        self._control, self._keys, self._on_report = control, keys, on_report
        self._ending = threading.Event()
        self._first: Queue[RunError | None] = Queue()
        self._thread = threading.Thread(target=self._run, name="embedded broker", daemon=True)
        self._thread.start()
        if why := self._first.get(timeout=START_S + END_S):
            raise why

    def end(self) -> None:
        self._ending.set()
        self._thread.join(END_S)

    def _run(self) -> None:
        try:
            broker: Broker | None = self._started()
            self._first.put(None)
        except RunError as error:
            self._first.put(error)
            return
        reported = False  # that there is none
        while not self._ending.wait(CHECK_S if broker else AGAIN_S):
            try:
                if broker:
                    broker.check()
                else:
                    broker, reported = self._started(), False
                    self._on_report(f"the MQTT broker on {self._control} runs again")
            except RunError as error:
                if not reported:
                    self._on_report(f"{error}; it is started again")
                broker, reported = None, True
        if broker:
            broker.end()

    def _started(self) -> Broker:
        broker = Broker(self._control, self._keys, self._on_report)
        try:
            broker.wait_until_it_answers()
        except RunError:
            broker.end()
            raise
        return broker
