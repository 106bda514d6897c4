"""One side's control link: what it publishes and hears, and why there is none."""

from __future__ import annotations

import json
import ssl
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from paho.mqtt.client import Client, MQTTMessage, MQTTMessageInfo

from runner.mqtt.client import RETRY_S, BrokerClient
from runner.mqtt.login import BrokerLogin, Login
from runner.mqtt.messages import JsonObject, MqttMessage
from runner.security.keyring import Keyring
from runner.settings import PREFIX, Control, Endpoint, Uplink
from runner.system.reports import LimitedReports

KEEPALIVE_S = 1  # s without a message before a ping; the broker publishes a will after one and a half of these
CLOSE_S, CLOSING_S = 2.0, 0.1  # for signing off, and between two looks at whether the connection is still there
PERIODIC = {"telemetry", "reception", "clock", "advice", "steering"}  # the next one follows soon: QoS 0
SUPERSEDED = PERIODIC | {"state"}  # replaced by a later message, and so not sent while the link is behind
MOST_REASONS = 10  # reported of one outage: a peer chooses some of their words
BRIEF_S, MOST_BRIEF = 1.0, 3  # how long a connection must last, and how many in a row may not, until it is said
RETAINED = ("state", "telemetry", "configuration")


class ControlLink:
    """One side's connection to the broker, kept alive until it is closed. Callbacks run in the link's own thread.

    will          topic and message that the broker publishes when this side disappears; None: it publishes none
    listen        by topic filter, the callback for its messages
    on_connected  called with True once this side receives its messages, with False when the connection is lost
    on_report     called with one line when the broker is unreachable, once per reason, and when it is back
    login         credentials of this side; None: the broker does not authenticate
    uplink        name and way of this connection, if it is one of several; None: the system's routes decide
    prefix        what topics begin with at the broker, in place of PREFIX

    A message whose callback raises is reported and counted in `dropped`; the link continues.
    """

    def __init__(
        self,
        broker: Endpoint,
        will: tuple[str, JsonObject] | None,
        listen: Mapping[str, Callable[[MqttMessage], None]],
        on_connected: Callable[[bool], None],
        on_report: Callable[[str], None],
        login: BrokerLogin | None = None,
        uplink: tuple[str, Uplink] | None = None,
        prefix: str = PREFIX,
    ) -> None:
        self._login, self._uplink, self._prefix = login, uplink, prefix
        self._by = f" by uplink {uplink[0]}" if uplink else ""
        self._most_reasons = 1 if uplink else MOST_REASONS  # whether there is one at all matters more than why
        self._broker, self._will, self._listen = broker, will, listen
        self._on_connected, self._on_report = on_connected, on_report
        self.fault: str | None = None  # why there is no connection; None: there is one, or none was lost or tried yet
        self._reported: set[str] = set()  # faults since the last connection
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
        if self._login:
            self._login.report_expiring()
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
        if not behind and is_one_of(SUPERSEDED, topic) and self._client.is_behind():
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
        if not self._listening.is_set():
            return False
        if is_over := self._client.has_moved() or bool(self._login and self._login.has_changed()):
            self._client.drop()
        return is_over

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
        """Whether earlier messages wait for the link."""
        return self._client.is_behind()

    def _new_client(self) -> BrokerClient:
        client = BrokerClient(self._login, self._on_broken, self._uplink[1] if self._uplink else None)
        if self._will:
            topic, message = self._will
            client.will_set(self._there(topic), json.dumps(message), qos=1, retain=_is_retained(topic))
        client.on_pre_connect = self._begin
        client.on_connect_fail = lambda *_: self._on_connect_fail(sys.exception())
        client.on_connect = self._on_connect
        client.on_subscribe = self._on_subscribe
        client.on_disconnect = self._on_disconnect
        for topic_filter, function in self._listen.items():
            client.message_callback_add(self._there(topic_filter), self._guarded(function))
        return client

    def _there(self, topic: str) -> str:
        """A topic as the broker has it."""
        return self._prefix + topic.removeprefix(PREFIX)

    def _here(self, topic: str) -> str:
        return PREFIX + topic.removeprefix(self._prefix)

    def _begin(self, _client: Client, _data: object) -> None:
        self._is_explained = False
        self._client.begin()

    def _guarded(self, function: Callable[[MqttMessage], None]) -> Callable[[Client, object, MQTTMessage], None]:
        def on_message(_client: Client, _data: object, message: MQTTMessage) -> None:
            try:
                function(MqttMessage(self._here(message.topic), bytes(message.payload), message.retain))
            except ValueError as error:  # from the parser: the message is invalid
                self._drop(message, str(error))
            except Exception as error:
                self._drop(message, f"{type(error).__name__}: {error}")

        return on_message

    def _drop(self, message: MQTTMessage, why: str) -> None:
        self.dropped += 1
        self._report_fault(f"a message on {message.topic} was dropped: {why}", message.topic)

    def _send(self, topic: str, message: JsonObject) -> MQTTMessageInfo:
        qos = 0 if is_one_of(PERIODIC, topic) else 1
        return self._client.publish(self._there(topic), json.dumps(message), qos=qos, retain=_is_retained(topic))

    def _on_connect(self, _client: Client, _data: object, _flags: object, code: Any, _properties: object) -> None:
        if code.is_failure:
            self._failed_to_connect(f"refused: {code}".lower(), self._login.source if self._login else "")
        else:
            self._subscribe()

    def _subscribe(self) -> None:
        self._client.subscribe([(self._there(topic_filter), 1) for topic_filter in self._listen])

    def _on_subscribe(self, _client: Client, _data: object, _mid: int, codes: Any, _properties: object) -> None:
        if refused := [self._there(each) for each, code in zip(self._listen, codes, strict=False) if code.is_failure]:
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
            self._failed_to_connect(self._client.why_ended(silent=code == "Keep alive timeout"), perhaps_keys=True)

    def _report_connected(self) -> None:
        if self._reported:
            self._reported.clear()
            self._on_report(f"connected to the MQTT broker at {self._broker}{self._by}")
        self.fault = None

    def _lose(self) -> bool:
        """This side no longer receives its messages; returns whether it did."""
        if not self._listening.is_set():
            return False
        self._listening.clear()
        self._is_explained = True  # paho states the end of a silent connection twice; the next attempt shows why
        self._on_connected(False)
        self._brief = self._brief + 1 if time.monotonic() - self._listened < BRIEF_S else 0
        if self._brief >= MOST_BRIEF:  # such as one that does not allow what this side sends
            self._failed_to_connect("the broker ends each connection soon after it is made")
        return True

    def _on_broken(self, error: Exception) -> None:
        self._failed_to_connect(str(error) if self._lose() else self._client.why_ended())

    def _on_connect_fail(self, error: BaseException | None) -> None:
        from runner.mqtt import refusal

        demands = self._login.demands if self._login else None
        why, remedy = refusal.of_failure(error, demands), refusal.remedy(error, self._broker)
        self._failed_to_connect(why, remedy, perhaps_keys=isinstance(error, ssl.SSLError))

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
        self.fault = f"no control link{self._by}: MQTT broker at {self._broker}: {why}"
        if why not in self._reported and len(self._reported) < self._most_reasons:
            self._reported.add(why)
            self._on_report(f"{self.fault}{remedy}; retrying")


def login_of(control: Control, keyring: Keyring | None, on_report: Callable[[str], None]) -> BrokerLogin | None:
    """The login of a side with these keys; None: the broker does not authenticate.

    on_report  as for `Login`
    raises     UserError if files cannot be used
    """
    if control.foreign:
        from runner.mqtt.foreign import ForeignLogin

        return ForeignLogin(control.foreign, keyring, on_report)
    return Login(keyring, on_report) if keyring else None


def is_one_of(kinds: set[str], topic: str) -> bool:
    return bool(kinds.intersection(topic.split("/")[2:3]))


def _is_retained(topic: str) -> bool:
    return topic.split("/")[2:] in [[name] for name in RETAINED]
