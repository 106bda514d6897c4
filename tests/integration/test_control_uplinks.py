"""The control link of a vehicle with two uplinks: it lasts while one of them works."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from itertools import count, groupby, pairwise
from pathlib import Path
from typing import Any

import pytest
from test_link import WIDE, _ends

from keyed import CONTROLLER, VEHICLE, WATCHER, issue
from rig import Operator, RecordingListener, needs_root, process, repeating, small_robot, until
from runner.configuration.config import configuration
from runner.link import limited_link
from runner.link.limit import Cut
from runner.mqtt.broker import private_broker
from runner.mqtt.link import ControlLink
from runner.mqtt.login import Login
from runner.mqtt.messages import topic
from runner.operator.station import Station
from runner.records.vehicle import VehicleState
from runner.security.keyring import Keyring
from runner.settings import Endpoint

WORDS = (
    *small_robot("front"),
    "source=test",
    "fps_max=5",
    "modes=safe",
    "mode=collective",
    "pqos=constant",
    "pqos.kbps=3000",
    "uplinks={a: {interface: a}, b: {interface: b}}",
)
CUT_S, BOTH_S, ONE_S, ALL_S = 0.2, 1.3, 2.5, 4.2  # when lane a is cut, when b is, when b is back, and when a is
ANSWERED_S = 0.5
TOPIC = topic(VEHICLE, "state")


class Side:
    """An operator's side, and what the broker says of its vehicle.

    keys  of everybody; None: there are none
    """

    def __init__(self, station: Station, broker: Endpoint, keys: Path | None) -> None:
        self.station, self.listener = station, RecordingListener()
        self._broker, self._keys, self._totals = broker, keys, count(1000)
        self.heard = Operator(broker, name="heard", keys=keys and keys / WATCHER)
        station.listeners.append(self.listener)

    def answered_s(self) -> float:
        """How long a request takes until it is answered; it must have been applied."""
        replies, began = [], time.monotonic()
        self.station.ask({"event": "total_set", "kbps": next(self._totals)}, replies.append)
        until(lambda: replies, every_s=0.002)
        assert replies[0].result == "applied"
        return time.monotonic() - began

    def copies(self) -> int:
        """How often telemetry came that was sent 0.3 s ago: once by each connection that works."""
        times = [each["t"] for each in tuple(self.heard.telemetry)]
        settled = [t for t in times if t < max(times) - 0.3]
        return settled.count(settled[-1]) if settled else 0

    def states(self) -> list[VehicleState | None]:
        return [record for kind, record in self.listener.received if kind == "state"]

    def lose(self, uplink: str) -> None:
        """Publish the will of a connection of the vehicle, as the broker does, sooner or later."""
        login = Login(Keyring(self._keys / VEHICLE), print) if self._keys else None
        link = ControlLink(self._broker, None, {TOPIC: lambda message: None}, lambda here: None, print, login)
        link.connect()
        until(lambda: link.wait_connected(0.1))
        link.close((TOPIC, {"online": False, "uplink": uplink}))

    def kept(self) -> Any:
        """The state that the broker has kept for those who come late."""
        late = Operator(self._broker, name="late", keys=self._keys and self._keys / WATCHER)
        state = late.state(lambda state: True)
        late.link.close()
        return state


@contextmanager
def driving(directory: Path, how: str, with_keys: bool) -> Iterator[tuple[Side, float]]:
    """A vehicle whose lanes are cut from then on, and when that began, by time.monotonic."""
    keys = issue(directory / "keys") if with_keys else None
    cuts = {"a": Cut(CUT_S, ALL_S - CUT_S, how), "b": Cut(BOTH_S, ONE_S - BOTH_S, how)}
    lanes = {name: replace(WIDE, delay_ms=delay, cuts=(cuts[name],)) for name, delay in (("a", 0), ("b", 30))}
    with ExitStack() as stack:
        link = stack.enter_context(limited_link("netns", WIDE, *_ends(), lambda sample: None, lanes=lanes))
        broker = stack.enter_context(private_broker(link.broker, keys / "broker" if keys else None))
        station = Station(
            configuration([*WORDS, *link.operator_overrides]).setup(), {}, Keyring(keys / CONTROLLER) if keys else None
        )
        words = [*WORDS, *link.vehicle_overrides, f"log={directory / 'log'}"]
        words += [f"keys={keys / VEHICLE}"] if keys else []
        stack.enter_context(process("vehicle", *words, before=link.vehicle_command))
        side = Side(station, link.broker, keys)
        stack.callback(side.heard.link.close)
        stack.callback(station.close)
        station.connect()
        stack.enter_context(repeating(lambda: station.take({}), 0.1))
        until(lambda: side.copies() == 2 and station.state)
        side.listener.received.clear()
        link.start(time.time())
        yield side, time.monotonic()
        broker.check()
        link.check()


def _check_cuts(directory: Path, how: str, with_keys: bool) -> None:
    with driving(directory, how, with_keys) as (side, began):
        time.sleep(max(0.0, began + CUT_S - time.monotonic()))
        answered = []
        while time.monotonic() < began + BOTH_S - ANSWERED_S:
            answered.append(side.answered_s())
        assert max(answered) < ANSWERED_S
        assert None not in side.states()
        until(lambda: side.station.state is None)
        assert BOTH_S < time.monotonic() - began < ONE_S
        until(lambda: side.station.state)
        assert ONE_S < time.monotonic() - began < ALL_S  # by b alone
        until(lambda: side.copies() == 2)
        assert side.answered_s() < ANSWERED_S
        side.lose("a")
        until(lambda: side.kept()["online"])  # the vehicle contradicts it
        states = side.states()
        assert [online for online, _ in groupby(states, bool)][:3] == [True, False, True]
        assert all(before.t <= after.t for before, after in pairwise(filter(None, states)))
    lines = [json.loads(line) for line in (directory / "log" / "drive.jsonl").read_text().splitlines()]
    notes = [line["text"] for line in lines if line.get("log") == "note" and " by uplink a" in line["text"]]
    assert [note.partition(" by ")[0].partition(" at ")[0] for note in notes] == [
        "no control link",
        "connected to the MQTT broker",
    ]


@needs_root
@pytest.mark.alone
def test_the_control_link_survives_a_cut_with_keys(tmp_path: Path) -> None:
    _check_cuts(tmp_path, "silence", with_keys=True)


@needs_root
@pytest.mark.alone
@pytest.mark.soak
@pytest.mark.parametrize("how", ["silence", "carrier", "down", "hold"])
def test_the_control_link_survives_every_cut(tmp_path: Path, how: str) -> None:
    _check_cuts(tmp_path, how, with_keys=False)
