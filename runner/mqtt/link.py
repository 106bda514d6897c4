"""One side's connection to the MQTT broker: kept alive, re-established when lost, robust against broker errors."""

from __future__ import annotations

import errno
import json
import select
import socket
import ssl
import sys
import threading
import time
import uuid
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from paho.mqtt.client import Client, MQTTMessage, MQTTMessageInfo
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode

from runner.errors import RunError, UserError
from runner.mqtt.login import Login
from runner.mqtt.messages import JsonObject, MqttMessage
from runner.security.exposure import is_loopback
from runner.settings import Endpoint
from runner.system.reports import LimitedReports

CONNECT_S = 1.0  # one attempt to connect
RETRY_S = (0.25, 0.5)  # between attempts, initially and at most: after an outage the vehicle waits for its operator
STALLED_S = 1.5  # a connection without progress for this long is dropped
KEEPALIVE_S = 1  # s without a message before a ping; the broker publishes a will after one and a half of these
LOOP_S = 0.25  # how often the keepalive is checked
CLOSE_S, CLOSING_S = 2.0, 0.1  # for signing off, and between two looks at whether the connection is still there
PERIODIC = {"telemetry", "reception", "clock", "advice", "steering"}  # the next one follows soon: QoS 0
SUPERSEDED = PERIODIC | {"state"}  # replaced by a later message, and so not sent ...
UNSENT_BYTES = 4096  # ... while this much is queued: after an outage it would delay current messages
MOST_REASONS = 10  # reported of one outage: a peer chooses some of their words
BRIEF_S, MOST_BRIEF = 1.0, 3  # how long a connection must last, and how many in a row may not, until it is said
HEARD_BYTES = 32  # what a program says first tells which one it is
RETAINED = ("state", "telemetry", "configuration")


class _Client(Client):
    """A client whose loop survives a broker that violates the protocol, and which knows how a connection began.

    on_broken  called with the violation
    heard      the first bytes that arrived over the connection
    error      of its socket before it was in use; None: none occurred
    """

    on_broken: Callable[[Exception], None]
    heard = b""
    error: OSError | None = None

    def begin(self) -> None:
        """To be called before each connection: paho keeps neither what it could not read nor the error to itself."""
        self.heard, self.error = b"", None
        self.__dict__["_sock_recv"] = self._recv_first  # of this instance only

    def use(self) -> None:
        """To be called once a connection works: it reads as paho does, since a flood takes four reads a message."""
        self.__dict__.pop("_sock_recv", None)

    def _recv_first(self, bufsize: int) -> bytes:
        try:
            data = super()._sock_recv(bufsize)
        except BlockingIOError:
            raise
        except OSError as error:
            self.error = error
            raise
        self.heard += data[: HEARD_BYTES - len(self.heard)]
        return data

    def loop_forever(self, timeout: float = LOOP_S, retry_first_connection: bool = False) -> MQTTErrorCode:
        """Run in the thread started by `loop_start`."""
        while True:
            try:
                return super().loop_forever(timeout, retry_first_connection)
            except Exception as error:
                self.on_broken(error)
                time.sleep(RETRY_S[-1])
                with suppress(Exception):  # the loop tries again, and reports what fails
                    self.reconnect()


class ControlLink:
    """One side's connection to the broker, kept alive until it is closed. Callbacks run in the link's own thread.

    will          topic and message that the broker publishes when this side disappears; None: it publishes none
    listen        by topic filter, the callback for its messages
    on_connected  called with True once this side receives its messages, with False when the connection is lost
    on_report     called with one line when the broker is unreachable, once per reason, and when it is back
    login         credentials of this side; None: the broker does not authenticate

    A message whose callback raises is reported and counted in `dropped`; the link continues.
    """

    def __init__(
        self,
        broker: Endpoint,
        will: tuple[str, JsonObject] | None,
        listen: Mapping[str, Callable[[MqttMessage], None]],
        on_connected: Callable[[bool], None],
        on_report: Callable[[str], None],
        login: Login | None = None,
    ) -> None:
        self._login = login
        self._broker, self._will, self._listen = broker, will, listen
        self._on_connected, self._on_report = on_connected, on_report
        self.fault: str | None = None  # why there is no connection; None: there is one, or none was lost or tried yet
        self._reported: set[str] = set()  # faults since the last connection
        self._expiring: set[str] = set()  # certificates that were reported
        self._listened, self._brief = 0.0, 0  # since when by time.monotonic; connections in a row that soon ended
        self._is_explained = False  # whether it was said why this connection has failed
        self._report_fault = LimitedReports(on_report)  # of a message
        self.dropped = 0
        self._listening, self._closing = threading.Event(), threading.Event()
        self._client = self._new_client()

    @property
    def is_connected(self) -> bool:
        """Whether this side receives its messages."""
        return self._listening.is_set()

    def certificate_ends(self) -> Mapping[str, float]:
        """By whose certificate it is, the time until which it is valid, s since 1970; empty without keys."""
        return self._login.ends() if self._login else {}

    def connect(self) -> None:
        """Connect, and stay connected; returns immediately."""
        self._report_expiring()
        self._client.connect_async(self._broker.host, self._broker.port, KEEPALIVE_S)
        self._client.loop_start()

    def wait_connected(self, seconds: float) -> bool:
        """Wait until this side receives its messages; returns whether it does."""
        return self._listening.wait(seconds)

    def publish(self, topic: str, message: JsonObject, *, behind: bool = False) -> bool:
        """Send a message; the broker keeps state, telemetry and configuration for late subscribers.

        Without a connection nothing is sent or queued: after a reconnection only current values count. Messages with
        acknowledgement that were in flight when the connection was lost are resent. A message that a later one
        supersedes is not sent while earlier ones wait for the link.

        behind   send it although earlier ones wait
        returns  False if it was not sent because earlier ones wait
        """
        if self.check() or not self._listening.is_set():
            return True
        if not behind and _is_one_of(SUPERSEDED, topic) and self.is_behind():
            return False
        self._send(topic, message)
        return True

    def check(self) -> bool:
        """Connect again if this side's address or keys have changed, or the broker's keys are revoked.

        `publish` does so, too: for a side that sends nothing, to be called a few times a second.

        returns  whether the connection was dropped
        """
        if self._listening.is_set() and self._brief and time.monotonic() - self._listened > BRIEF_S:
            self._brief = 0
            self._report_connected()
        if not self._listening.is_set() or not (self._has_moved() or (self._login and self._login.has_changed())):
            return False
        self._drop_connection()
        return True

    def close(self, *goodbye: tuple[str, JsonObject]) -> None:
        """Disconnect after sending final messages, such as that of the last will."""
        self._closing.set()
        end = time.monotonic() + CLOSE_S / 2
        for topic, message in goodbye:
            with suppress(ValueError, RuntimeError):  # the connection has just been lost
                sent = self._send(topic, message) if self._listening.is_set() else None
                while sent and not sent.is_published() and self._listening.is_set() and time.monotonic() < end:
                    sent.wait_for_publish(CLOSING_S)
        self._client.disconnect()
        ending = threading.Thread(target=self._client.loop_stop, daemon=True)  # waits without a timeout
        ending.start()
        # Without a connection it sleeps until its next attempt to connect.
        ending.join(CLOSE_S if self._listening.is_set() else CLOSING_S)

    def is_behind(self) -> bool:
        """Whether the kernel has UNSENT_BYTES or more queued for sending."""
        poll, sock = select.poll(), self._client.socket()
        try:
            poll.register(sock, select.POLLOUT)  # type: ignore[arg-type]  # None is a TypeError
            return not poll.poll(0)
        except (OSError, TypeError, ValueError):  # the connection has just been lost
            return False

    def _has_moved(self) -> bool:
        """Whether this machine no longer has the local address of the connection, for example after roaming.

        Its packets are then lost, which TCP would notice only after STALLED_S.
        """
        sock = self._client.socket()
        try:
            own, _, *scope = sock.getsockname()  # type: ignore[union-attr]  # None is an AttributeError
            with socket.socket(sock.family, socket.SOCK_DGRAM) as probe:  # type: ignore[union-attr]
                probe.bind((own, 0, *scope))
                return False
        except AttributeError:  # the connection has just been lost
            return False
        except OSError as error:
            return error.errno == errno.EADDRNOTAVAIL

    def _drop_connection(self) -> None:
        """Shut the connection down; the loop reconnects."""
        with suppress(OSError, AttributeError):  # it has just been lost
            self._client.socket().shutdown(socket.SHUT_RDWR)  # type: ignore[union-attr]

    def _new_client(self) -> _Client:
        # With a fixed id, a new connection ends the old one, whose will the broker would otherwise publish later.
        client = _Client(CallbackAPIVersion.VERSION2, client_id=f"tod{uuid.uuid4().hex[:20]}")
        client.on_broken = self._on_broken
        client.connect_timeout = CONNECT_S
        client.reconnect_delay_set(*RETRY_S)  # type: ignore[arg-type]  # s; fractions work
        if self._will:
            topic, message = self._will
            client.will_set(topic, json.dumps(message), qos=1, retain=_is_retained(topic))
        client.on_pre_connect = self._begin
        client.on_socket_open = _configure_socket
        if self._login:
            client.tls_set_context(self._login.context)
            client.on_socket_open = self._check_broker
        client.on_connect_fail = lambda *_: self._on_connect_fail(sys.exception())
        client.on_connect = self._on_connect
        client.on_subscribe = self._on_subscribe
        client.on_disconnect = self._on_disconnect
        for topic_filter, function in self._listen.items():
            client.message_callback_add(topic_filter, self._guarded(function))
        return client

    def _begin(self, client: Client, _data: object) -> None:
        """Use the current keys, which may have been replaced since the last connection."""
        self._client.begin()
        self._is_explained = False
        if self._login is None:
            return
        try:
            client.username_pw_set(self._login.user, self._login.refresh())
        except UserError as error:
            raise ConnectionError(str(error)) from None  # the loop tries again after an OSError only

    def _check_broker(self, client: Client, data: object, sock: Any) -> None:
        assert self._login
        try:
            self._login.check(sock)
        except RunError as error:
            sock.close()  # nothing that this peer sends is read
            raise ConnectionError(str(error)) from None
        self._report_expiring()
        _configure_socket(client, data, sock)

    def _report_expiring(self) -> None:
        """Report, once each, which certificates expire soon."""
        if self._login is None:
            return
        from runner.security.validity import expiring

        for line in expiring(self._login.ends(), time.time()):
            if line not in self._expiring:
                self._expiring.add(line)
                self._on_report(f"{line}: `tod-runner keys output=DIR rotate=NAME` renews it")

    def _guarded(self, function: Callable[[MqttMessage], None]) -> Callable[[Client, object, MQTTMessage], None]:
        def on_message(_client: Client, _data: object, message: MQTTMessage) -> None:
            try:
                function(MqttMessage(message.topic, bytes(message.payload), message.retain))
            except ValueError as error:  # from the parser: the message is invalid
                self._drop(message, str(error))
            except Exception as error:
                self._drop(message, f"{type(error).__name__}: {error}")

        return on_message

    def _drop(self, message: MQTTMessage, why: str) -> None:
        self.dropped += 1
        self._report_fault(f"a message on {message.topic} was dropped: {why}", message.topic)

    def _send(self, topic: str, message: JsonObject) -> MQTTMessageInfo:
        qos = 0 if _is_one_of(PERIODIC, topic) else 1
        return self._client.publish(topic, json.dumps(message), qos=qos, retain=_is_retained(topic))

    def _on_connect(self, _client: Client, _data: object, _flags: object, code: Any, _properties: object) -> None:
        if code.is_failure:
            self._failed_to_connect(f"refused: {code}".lower())
        else:
            self._subscribe()

    def _subscribe(self) -> None:
        self._client.subscribe([(topic_filter, 1) for topic_filter in self._listen])

    def _on_subscribe(self, _client: Client, _data: object, _mid: int, codes: Any, _properties: object) -> None:
        if refused := [each for each, code in zip(self._listen, codes, strict=False) if code.is_failure]:
            self._failed_to_connect(f"refused to subscribe to {', '.join(refused)}")
            retry = threading.Timer(RETRY_S[-1], self._subscribe)
            retry.daemon = True
            retry.start()
            return
        self._client.use()
        self._listened = time.monotonic()
        if self._brief < MOST_BRIEF:
            self._report_connected()
        self._listening.set()
        self._on_connected(True)

    def _on_disconnect(self, _client: Client, _data: object, _flags: object, code: Any, _properties: object) -> None:
        if not self._lose() and not self._is_explained:
            self._failed_to_connect(self._end(silent=code == "Keep alive timeout"), perhaps_keys=True)

    def _report_connected(self) -> None:
        if self._reported:
            self._reported.clear()
            self._on_report(f"connected to the MQTT broker at {self._broker}")
        self.fault = None

    def _lose(self) -> bool:
        """This side no longer receives its messages; returns whether it did."""
        if not self._listening.is_set():
            return False
        self._listening.clear()
        self._on_connected(False)
        self._brief = self._brief + 1 if time.monotonic() - self._listened < BRIEF_S else 0
        if self._brief >= MOST_BRIEF:  # such as one that does not allow what this side sends
            self._failed_to_connect("the broker ends each connection soon after it is made")
        return True

    def _on_broken(self, error: Exception) -> None:
        self._failed_to_connect(str(error) if self._lose() else self._end())

    def _end(self, silent: bool = False) -> str:
        """Why the connection ended before this side could listen."""
        from runner.mqtt import refusal

        client = self._client
        return refusal.of_end(client.heard, client.error, silent, tls=self._login is not None)

    def _on_connect_fail(self, error: BaseException | None) -> None:
        from runner.mqtt import refusal

        why = refusal.of_failure(error, tls=self._login is not None)
        self._failed_to_connect(why, self._remedy(error), perhaps_keys=isinstance(error, ssl.SSLError))

    def _failed_to_connect(self, why: str, remedy: str = "", perhaps_keys: bool = False) -> None:
        """Report once why there is no control link.

        remedy        said once, beside the reason
        perhaps_keys  a certificate of this side that does not count is the cause
        """
        self._is_explained = True
        if self._closing.is_set():
            return
        if perhaps_keys and self._login:
            why = self._login.invalid() or why
        self.fault = f"no control link: MQTT broker at {self._broker}: {why}"
        if why not in self._reported and len(self._reported) < MOST_REASONS:
            self._reported.add(why)
            self._on_report(f"{self.fault}{remedy}; retrying")

    def _remedy(self, error: BaseException | None) -> str:
        if not isinstance(error, ConnectionRefusedError):
            return ""
        if is_loopback(self._broker.host):
            return f" (start one on this machine: mosquitto -p {self._broker.port})"
        return " (does one run there, reachable from other machines? See docs/deployment.md)"


def _is_one_of(kinds: set[str], topic: str) -> bool:
    return bool(kinds.intersection(topic.split("/")[2:3]))


def _is_retained(topic: str) -> bool:
    return topic.split("/")[2:] in [[name] for name in RETAINED]


def _configure_socket(_client: object, _data: object, sock: Any) -> None:
    if isinstance(sock, socket.socket):
        # Otherwise small messages are delayed by 20 ms (Nagle's algorithm).
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1000 * STALLED_S))
        # A socket that is behind becomes writable again when half of this is left.
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, 2 * UNSENT_BYTES)
