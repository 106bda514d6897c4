"""The vehicle's control link over several uplinks: it lasts as long as one of them works."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping

from runner.mqtt.copies import FirstCopies
from runner.mqtt.link import PERIODIC, ControlLink, is_one_of
from runner.mqtt.login import BrokerLogin
from runner.mqtt.messages import JsonObject, MqttMessage
from runner.security.exposure import is_loopback
from runner.settings import PREFIX, Endpoint, Uplink


def ways_to(broker: Endpoint, uplinks: Mapping[str, Uplink]) -> dict[str, Uplink]:
    """The uplinks by which a broker is reached: one on this machine, by none that leaves it."""
    local = is_loopback(broker.host)
    return {name: each for name, each in uplinks.items() if not local or is_loopback(each.address or "")}


class ControlLinks:
    """A connection to the broker over each uplink, for a vehicle: otherwise as `runner.mqtt.link.ControlLink`.

    All of them are used all the time: whatever is published goes over all that work, and of what arrives the first copy
    counts. Each connection has a will of its own, which names its uplink.

    on_connected  called with True whenever a connection has been made, with False when the last one is lost
    new_login     returns a login of the vehicle that reports its problems; None: the broker does not authenticate
    prefix        as in `ControlLink`
    """

    def __init__(
        self,
        broker: Endpoint,
        uplinks: Mapping[str, Uplink],
        will: tuple[str, JsonObject],
        listen: Mapping[str, Callable[[MqttMessage], None]],
        on_connected: Callable[[bool], None],
        on_report: Callable[[str], None],
        new_login: Callable[[Callable[[str], None]], BrokerLogin | None] = lambda on_report: None,
        prefix: str = PREFIX,
    ) -> None:
        self._on_connected, self._copies = on_connected, FirstCopies()
        self._lock = threading.Lock()  # held by callbacks: they run one at a time, in order
        self._owed: dict[str, tuple[str, JsonObject]] = {}  # by uplink, the state that it was too far behind for
        self._links: dict[str, ControlLink] = {}
        for name, uplink in uplinks.items():
            # Each connection loads keys of its own. They are the same files, so one of them reports their problems.
            login = new_login((lambda what: None) if self._links else on_report)
            own = {each: self._first(name, function) for each, function in listen.items()}
            named = (will[0], {**will[1], "uplink": name})
            self._links[name] = ControlLink(
                broker, named, own, self._on_changed, on_report, login, (name, uplink), prefix
            )

    @property
    def is_connected(self) -> bool:
        """Whether this side receives its messages, by any uplink."""
        return any(link.is_connected for link in self._links.values())

    def certificate_ends(self) -> Mapping[str, float]:
        """By whose certificate it is, the time until which it is valid, s since 1970; empty without keys."""
        return {whose: end for link in self._links.values() for whose, end in link.certificate_ends().items()}

    def connect(self) -> None:
        """Connect by every uplink, and stay connected; returns immediately."""
        for link in self._links.values():
            link.connect()

    def publish(self, topic: str, message: JsonObject) -> bool:
        """Send a message by every uplink; returns False if all that work have earlier ones waiting."""
        sent = list[bool]()
        for name, link in self._links.items():
            if link.is_connected:
                sent.append(self._publish(name, topic, message))
            else:
                self._owed.pop(name, None)  # whoever publishes does so anew once it is connected
        return any(sent) or not sent

    def close(self, *goodbye: tuple[str, JsonObject]) -> None:
        """Disconnect after sending final messages; together, since one over a dead uplink waits for its end."""
        closing = [threading.Thread(target=link.close, args=goodbye, daemon=True) for link in self._links.values()]
        for each in closing:
            each.start()
        for each in closing:
            each.join()

    def _publish(self, name: str, topic: str, message: JsonObject) -> bool:
        link, owed = self._links[name], self._owed.pop(name, None)
        if owed and owed[0] != topic and not link.publish(*owed):
            self._owed[name] = owed
        sent = link.publish(topic, message)
        if not sent and not is_one_of(PERIODIC, topic):
            # Otherwise an older one that waits would arrive last, and the broker keep it.
            self._owed[name] = (topic, message)
        return sent

    def _first(self, name: str, function: Callable[[MqttMessage], None]) -> Callable[[MqttMessage], None]:
        def on_message(message: MqttMessage) -> None:
            with self._lock:
                if self._copies.is_first(name, message, time.monotonic()):
                    function(message)

        return on_message

    def _on_changed(self, connected: bool) -> None:
        with self._lock:
            if connected or not self.is_connected:
                self._on_connected(connected)
