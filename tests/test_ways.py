"""By which uplinks a broker is reached."""

from __future__ import annotations

from runner.mqtt.ways import ways_to
from runner.settings import Endpoint, Uplink


def test_a_broker_on_the_vehicle_is_reached_by_no_modem() -> None:
    modems = {"a": Uplink("wwan0"), "b": Uplink(address="10.0.0.2"), "c": Uplink("wwan1", "10.0.1.2")}
    tested = {"x": Uplink(address="127.0.1.1"), "y": Uplink(address="::1")}
    assert [*ways_to(Endpoint("10.9.9.9", 1884), modems)] == ["a", "b", "c"]
    assert [*ways_to(Endpoint("localhost", 1884), modems | tested)] == ["x", "y"]
