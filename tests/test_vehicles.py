"""Which vehicles a station is for, and what is its own of each."""

from __future__ import annotations

from pathlib import Path

import pytest

from runner.errors import UserError
from runner.verbs import Arguments
from runner.verbs.fleet import run, setup_of, vehicles_of


@pytest.mark.parametrize("text", ["courier-1,robot", "[courier-1,robot]", "[courier-1, robot]"])
def test_vehicles_are_named_as_their_files(text: str) -> None:
    assert vehicles_of(text) == {"courier-1": ("vehicle=courier-1",), "robot": ("vehicle=robot",)}


def test_all_are_those_of_the_broker() -> None:
    assert vehicles_of("all") is None


def test_a_file_states_what_is_a_vehicles_own(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(
        "courier-1: {vehicle: delivery_robot, media: {host: 10.9.0.11, rtp_ports: [20000, 20199]}, keys: null}\n"
        "delivery_robot:\n"
    )
    vehicles = vehicles_of(str(file))
    assert vehicles == {
        "courier-1": (
            *("vehicle=delivery_robot", "name=courier-1"),
            *('media.host="10.9.0.11"', "media.rtp_ports=[20000, 20199]", "keys=null"),
        ),
        "delivery_robot": ("vehicle=delivery_robot",),
    }
    arguments = Arguments("operator", ["media.port=9000"])
    setup = setup_of(arguments, "courier-1", vehicles["courier-1"])
    assert (setup.vehicle.name, setup.media.host, setup.media.port) == ("courier-1", "10.9.0.11", 9000)
    assert setup.media.rtp_ports == (20000, 20199)


def test_a_file_of_another_name_is_refused(tmp_path: Path) -> None:
    (tmp_path / "vehicle").mkdir()
    text = "# @package _global_\ndefaults: [delivery_robot, _self_]\nname: other\n"
    (tmp_path / "vehicle" / "courier.yaml").write_text(text)
    with pytest.raises(UserError) as raised:
        setup_of(Arguments("operator", [], conf=tmp_path), "courier", ("vehicle=courier",))
    rule = "must be courier, as its file is named: the page and the broker know the vehicle by it"
    assert str(raised.value).splitlines()[0] == f"vehicle=courier: name: 'other': {rule}"


@pytest.mark.parametrize(
    "text, problem",
    [
        (
            "a,,b",
            "vehicles: '': must be names of vehicles, such as [courier-1, courier-2], a file that ends in .yaml, ",
        ),
        ("a/b", "vehicles: 'a/b': must be names of vehicles"),
        ("a,a", "vehicles: a,a: names a vehicle twice"),
        ("FILE:[]", "fleet.yaml: must state by name of a vehicle what is its own"),
        ("FILE:{a b: {}}", "fleet.yaml: a b: must be the name of a vehicle: letters, digits, _ and -"),
        ("FILE:{a: 1, b: []}", "fleet.yaml: a: must be a part of a configuration, by its keys"),
    ],
)
def test_what_is_wrong_with_the_vehicles_is_said(tmp_path: Path, text: str, problem: str) -> None:
    if text.startswith("FILE:"):
        file = tmp_path / "fleet.yaml"
        file.write_text(text.removeprefix("FILE:"))
        text = str(file)
    with pytest.raises(UserError) as raised:
        vehicles_of(text)
    assert problem in str(raised.value)


@pytest.mark.parametrize(
    "words, problem",
    [
        (["vehicles=a", "vehicle=b"], "vehicles: a: states what vehicle=b does: give one of them"),
        (["vehicles=a", "log=x"], "log: x: is for one vehicle: give drives=DIR"),
        (["vehicles=delivery_robot", "page.serve=false"], "page.serve: false: vehicles= is for the page"),
        (["vehicles=robot"], "vehicle: robot: no such file in conf/vehicle/; expected one of delivery_robot"),
    ],
)
def test_what_does_not_go_with_several_vehicles_is_refused(words: list[str], problem: str) -> None:
    with pytest.raises(UserError) as raised:
        run(Arguments.parse("operator", words))
    assert problem in str(raised.value)


def test_the_problems_of_all_vehicles_are_reported_together() -> None:
    with pytest.raises(UserError) as raised:
        run(Arguments.parse("operator", ["vehicles=no_such,neither"]))
    text = str(raised.value)
    assert "no_such" in text
    assert "neither" in text


def test_metrics_of_several_stations_need_a_port_each() -> None:
    words = ["vehicles=delivery_robot,tum_q7", "metrics.operator_port=9100"]
    with pytest.raises(UserError) as raised:
        run(Arguments.parse("operator", words))
    rule = "must differ: state one for each vehicle in a file of vehicles"
    assert str(raised.value).endswith(f"metrics.operator_port: 9100: {rule}")
