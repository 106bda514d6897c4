"""A client of an MQTT broker: it connects again and again, survives the broker's errors, and notices a dead link."""

from __future__ import annotations

import errno
import select
import socket
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode

from runner.errors import RunError, UserError
from runner.mqtt.login import BrokerLogin
from runner.settings import Uplink
from runner.system.interfaces import addresses_by

CONNECT_S = 1.0  # one attempt to connect
RETRY_S = (0.25, 0.5)  # between attempts, initially and at most: after an outage the vehicle waits for its operator
STALLED_S = 1.5  # a connection without progress for this long is dropped
LOOP_S = 0.25  # how often the keepalive is checked
UNSENT_BYTES = 4096  # with so much queued a connection is behind: after an outage it would delay current messages
HEARD_BYTES = 32  # what a program says first tells which one it is


class BrokerClient(Client):
    """A client whose loop survives a broker that violates the protocol, and which knows how a connection began.

    login      credentials of this side; None: the broker does not authenticate
    on_broken  called with a violation
    uplink     by which it connects; None: the system's routes decide
    """

    _heard = b""  # the first bytes that arrived over the connection
    _error: OSError | None = None  # of its socket before it was in use; None: none occurred

    def __init__(
        self, login: BrokerLogin | None, on_broken: Callable[[Exception], None], uplink: Uplink | None = None
    ) -> None:
        # With a fixed id, a new connection ends the old one, whose will the broker would otherwise publish later.
        super().__init__(CallbackAPIVersion.VERSION2, client_id=f"tod{uuid.uuid4().hex[:20]}")
        self._login, self._on_broken, self._uplink = login, on_broken, uplink
        self.connect_timeout = CONNECT_S
        self.reconnect_delay_set(*RETRY_S)  # type: ignore[arg-type]  # s; fractions work
        self.on_socket_open = self._on_opened
        if login:
            self.tls_set_context(login.context)

    def begin(self) -> None:
        """To be called before each connection, which uses the current keys: they may have been replaced."""
        self._heard, self._error = b"", None  # paho keeps neither what it could not read nor the error to itself
        self.__dict__["_sock_recv"] = self._recv_first  # of this instance only
        if self._login:
            try:
                password = self._login.refresh()  # and the user
                self.username_pw_set(self._login.user, password)
            except UserError as error:
                raise ConnectionError(str(error)) from None  # the loop tries again after an OSError only

    def use(self) -> None:
        """To be called once a connection works: it reads as paho does, since a flood takes four reads a message."""
        self.__dict__.pop("_sock_recv", None)

    def drop(self) -> None:
        """Shut the connection down; the loop reconnects."""
        with suppress(OSError, AttributeError):  # it has just been lost
            self.socket().shutdown(socket.SHUT_RDWR)  # type: ignore[union-attr]

    def is_behind(self) -> bool:
        """Whether the kernel has UNSENT_BYTES or more queued for sending."""
        poll, sock = select.poll(), self.socket()
        try:
            poll.register(sock, select.POLLOUT)  # type: ignore[arg-type]  # None is a TypeError
            return not poll.poll(0)
        except (OSError, TypeError, ValueError):  # the connection has just been lost
            return False

    def has_moved(self) -> bool:
        """Whether this machine no longer has the local address of the connection, for example after roaming.

        Its packets are then lost, which TCP would notice only after STALLED_S.
        """
        sock = self.socket()
        try:
            own, _, *scope = sock.getsockname()  # type: ignore[union-attr]  # None is an AttributeError
            with socket.socket(sock.family, socket.SOCK_DGRAM) as probe:  # type: ignore[union-attr]
                probe.bind((own, 0, *scope))
                return False
        except AttributeError:  # the connection has just been lost
            return False
        except OSError as error:
            return error.errno == errno.EADDRNOTAVAIL

    def why_ended(self, silent: bool = False) -> str:
        """Why the connection ended before this side could listen.

        silent  whether this side gave up waiting
        """
        from runner.mqtt import refusal

        return refusal.of_end(self._heard, self._error, silent, tls=self._login is not None)

    def loop_forever(self, timeout: float = LOOP_S, retry_first_connection: bool = False) -> MQTTErrorCode:
        """Run in the thread started by `loop_start`."""
        while True:
            try:
                return super().loop_forever(timeout, retry_first_connection)
            except Exception as error:
                self._on_broken(error)
                time.sleep(RETRY_S[-1])
                with suppress(Exception):  # the loop tries again, and reports what fails
                    self.reconnect()

    def _create_socket_connection(self) -> socket.socket:
        if self._uplink is None:
            return super()._create_socket_connection()
        return connected_by(self._uplink, self._host, self._port)

    def _recv_first(self, bufsize: int) -> bytes:
        try:
            data = super()._sock_recv(bufsize)
        except BlockingIOError:
            raise
        except OSError as error:
            self._error = error
            raise
        self._heard += data[: HEARD_BYTES - len(self._heard)]
        return data

    def _on_opened(self, _client: object, _data: object, sock: Any) -> None:
        if self._login:
            try:
                self._login.check(sock)
            except RunError as error:
                sock.close()  # nothing that this peer sends is read
                raise ConnectionError(str(error)) from None
        if isinstance(sock, socket.socket):
            # Otherwise small messages are delayed by 20 ms (Nagle's algorithm).
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1000 * STALLED_S))
            # A socket that is behind becomes writable again when half of this is left.
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, 2 * UNSENT_BYTES)


def connected_by(uplink: Uplink, host: str, port: int) -> socket.socket:
    """A connection that leaves by an uplink, whatever the routes say.

    raises  OSError, also if the uplink has no address to reach the host from
    """
    failed = OSError(errno.ENETUNREACH, f"{host} has no address")
    for family, kind, _, _, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
        own = socket.socket(family, kind)
        try:
            own.settimeout(CONNECT_S)
            if uplink.interface:
                own.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, uplink.interface.encode())
            own.bind((_source(uplink, family), 0))  # by which rules of routes may choose
            own.connect(address)
            return own
        except OSError as error:
            own.close()
            failed = error
    raise failed


def _source(uplink: Uplink, family: int) -> str:
    """The address of an uplink in a family.

    raises  OSError
    """
    for address in addresses_by(uplink):
        if (":" in address) == (family == socket.AF_INET6):
            return address
    raise OSError(errno.EADDRNOTAVAIL, f"{uplink.interface or uplink.address} has no address to reach it from")
