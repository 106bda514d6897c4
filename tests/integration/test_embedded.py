"""control.broker=embedded: a side that brings the broker of the control link with it."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from keyed import issue
from rig import ROBOT, Operator, free_port, process, run, until
from runner.configuration.config import configuration
from runner.core.roles import Role
from runner.errors import RunError, UserError
from runner.live import live_operator
from runner.mqtt import broker as broker_module
from runner.mqtt.embedded import broker_keys
from runner.security.authority import Authority
from runner.settings import Endpoint

EMBEDDED = "control.broker=embedded"


@pytest.fixture
def ports() -> tuple[str, ...]:
    return f"control.port={free_port()}", f"media.port={free_port()}"


def endpoint(ports: tuple[str, ...]) -> Endpoint:
    return Endpoint("127.0.0.1", int(ports[0].partition("=")[2]))


def brokers(parent: int) -> list[int]:
    """Process ids of the brokers that a process has started."""
    found = subprocess.run(["pgrep", "-P", str(parent), "mosquitto"], capture_output=True, text=True, check=False)
    return [int(line) for line in found.stdout.split()]


def ended(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def lines_of(child: subprocess.Popen[str]) -> Iterator[str]:
    assert child.stdout
    return iter(child.stdout)


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_the_broker_lasts_as_long_as_the_vehicle(ports: tuple[str, ...], how: int) -> None:
    with process("vehicle", *ROBOT, *ports, EMBEDDED) as vehicle:
        (broker,) = until(lambda: brokers(vehicle.pid))
        operator = Operator(endpoint(ports))
        operator.state(lambda state: state["online"])
        assert operator.ask("1", event="mode_selected", mode="collective")["result"] == "applied"
        vehicle.send_signal(how)
        until(lambda: ended(broker))


def test_a_broker_that_is_killed_is_started_again(ports: tuple[str, ...]) -> None:
    with process("vehicle", *ROBOT, *ports, EMBEDDED) as vehicle:
        said = lines_of(vehicle)
        next(line for line in said if "rtsp://" in line)
        (broker,) = brokers(vehicle.pid)
        os.kill(broker, signal.SIGKILL)
        killed = next(line for line in said if "broker on" in line)
        assert "killed by SIGKILL" in killed and "it is started again" in killed
        assert "runs again" in next(line for line in said if "broker on" in line)
        operator = Operator(endpoint(ports))
        operator.state(lambda state: state["online"])


def test_it_runs_at_the_operator_with_keys(ports: tuple[str, ...], tmp_path: Path) -> None:
    keys = issue(tmp_path / "keys")
    with (
        live_operator([*ROBOT, *ports, EMBEDDED, f"keys={keys / 'alice'}"]) as operator,
        process("vehicle", *ROBOT, *ports, f"keys={keys / 'delivery_robot'}", stdout=subprocess.DEVNULL),
    ):
        operator.start()
        until(lambda: operator.station.state)


def refusal(*words: str, **options: object) -> str:
    done = run("vehicle", *ROBOT, EMBEDDED, *words, **options)
    assert done.returncode in (1, 2)
    return done.stderr


def test_what_keeps_it_from_starting_is_said(ports: tuple[str, ...], tmp_path: Path) -> None:
    said = refusal(*ports, "control.host=192.0.2.1", "insecure=true")
    assert "control.host: 192.0.2.1: is no address of this machine: control.broker=embedded belongs" in said
    with process("vehicle", *ROBOT, *ports, EMBEDDED) as other:
        until(lambda: brokers(other.pid))
        said = refusal(ports[0], f"media.port={free_port()}", "name=other")
        assert "address already in use" in said and "leave out control.broker=embedded" in said
    two = "uplinks={a: {interface: lo}, b: {address: 127.0.0.1}}"
    assert "a vehicle with several uplinks" in refusal(*ports, two)
    assert "control.foreign is another broker" in refusal(*ports, "control.foreign=true")


def test_the_broker_needs_keys_of_its_own(ports: tuple[str, ...], tmp_path: Path) -> None:
    keys = issue(tmp_path / "keys")
    own = tmp_path / "moved"
    (keys / "delivery_robot").rename(own)
    assert f"needs the broker's keys in {tmp_path / 'broker'}" in refusal(*ports, f"keys={own}")
    authority = Authority(keys)
    with authority.opened():
        authority.issue("broker", Role.BROKER, ["192.0.2.9"])
    (keys / "broker").rename(tmp_path / "broker")
    setup = configuration([*ROBOT, *ports, EMBEDDED, f"keys={own}", "control.host=192.0.2.7"]).setup()
    with pytest.raises(UserError, match=r"broker at 192\.0\.2\.9: must be those of a broker at control.host"):
        broker_keys(setup)


def test_without_mosquitto_it_says_which_package(ports: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(broker_module.shutil, "which", lambda *_, **__: None)
    with pytest.raises(RunError, match="apt-get install mosquitto"), live_operator([*ROBOT, *ports, EMBEDDED]):
        pass


@pytest.mark.parametrize("verb", ["demo", "latency"])
def test_verbs_that_start_a_broker_anyway_refuse_it(ports: tuple[str, ...], verb: str) -> None:
    more = ["loop=true", "camera=front"] if verb == "latency" else []
    done = run(verb, *ROBOT, *ports, EMBEDDED, *more)
    assert done.returncode == 2
    assert "control.broker: embedded: this verb starts a broker of its own" in done.stderr
