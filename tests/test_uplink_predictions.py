"""Predictions of single uplinks as configuration: their sources, their errors, and the lanes that follow them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from helpers import Command

from runner.configuration.config import configuration
from runner.configuration.experiment import lane_overrides
from runner.core.events import BitratePredicted, ClockAdvanced, PositionReported
from runner.errors import RunError
from runner.link.limit import Limit
from runner.settings import Uplink
from runner.vehicle.live import missing_devices

NARROW = ("vehicle=delivery_robot", "source=test")


def trace(path: Path, *kbps: int) -> Path:
    path.write_text("t_s,kbps\n" + "".join(f"{t},{each}\n" for t, each in enumerate(kbps)))
    return path


def predicted(*words: str, t: float = 0) -> dict[str, float]:
    sources, _ = configuration([*NARROW, *words], runnable=False).pqos()
    return {event.uplink: float(event.kbps) for event in sources.observe(ClockAdvanced(t=t))}


def test_an_uplink_states_what_differs_from_the_predictions_of_the_vehicle(tmp_path: Path) -> None:
    one, other = trace(tmp_path / "one.csv", 3000, 2000), trace(tmp_path / "other.csv", 700, 800)
    a = f"a: {{interface: wwan0, pqos: {{file: {one}}}}}"
    words = ("pqos=trace", f"pqos.file={other}", "pqos.wrong={share: 0.5}")
    assert predicted(*words, f"uplinks={{{a}, b: {{interface: wwan1}}}}") == {"": 350, "a": 1500}
    # With predictions for each, none is needed for all together.
    live = "b: {interface: wwan1, pqos: {kind: live}}"
    assert predicted(*words, f"uplinks={{{a}, {live}}}", t=1) == {"a": 1000}
    mounted = ("uplinks={a: {interface: wwan0}}", "+pqos@uplinks.a.pqos=constant", "uplinks.a.pqos.kbps=900")
    assert predicted("pqos=trace", *mounted) == {"a": 900}


def test_warnings_name_the_uplink(tmp_path: Path) -> None:
    swapped = tmp_path / "map.csv"
    swapped.write_text("lon,lat,kbps\n48,11,900\n")
    words = (f"uplinks={{a: {{interface: w, pqos: {{file: {swapped}}}}}}}", "pqos=map", "pqos.position={kind: live}")
    sources, _ = configuration([*NARROW, *words], runnable=False).pqos()
    (event,) = sources.observe(PositionReported(t=1, lat=48, lon=11))
    assert event == BitratePredicted(t=1, uplink="a", kbps=event.kbps) and event.kbps == 1000
    (warning,) = sources.warnings
    assert warning.startswith("uplink a: position lat 48, lon 11 is off the map")


def test_wrong_sources_are_reported_together(tod: Command) -> None:
    a = "a: {interface: w0, pqos: {kind: trace, file: traces/demo_dips.csv}}"
    b = "b: {interface: w1, pqos: {kind: constant, kbps: 3000}}"
    words = ("pqos=map", f"uplinks={{{a}, {b}, c: {{interface: w0, pqos: {{file: nix.csv}}}}}}")
    assert [line.partition(" in /")[0] for line in tod("validate", *NARROW, *words).problems] == [
        "command line: uplinks.c.interface: w0: is already that of another uplink",
        "command line: uplinks.a.pqos.loop: must be given, for kind trace: +pqos@uplinks.a.pqos=trace does",
        "command line: uplinks.b.pqos.period_s: must be given, for kind constant: +pqos@uplinks.b.pqos=constant does",
        "command line: uplinks.c.pqos.file: nix.csv: no such file",
    ]
    assert tod("validate", *NARROW, "uplinks={a: {interface: w0, pqos: {fil: x, kind: trac}}}").problems == [
        "command line: uplinks.a.pqos.fil: unknown key, did you mean file?",
        "command line: uplinks.a.pqos.kind: 'trac': must be one of map, trace, constant, live, did you mean trace?",
    ]


def lanes(*words: str) -> dict[str, float]:
    link = configuration([*NARROW, *words], runnable=False).link()
    assert link

    def kbps(limit: Limit) -> float:
        return round(limit.rates(0).up / 1.1)

    return {name: kbps(limit) for name, limit in link.lanes.items()}


def test_a_lane_without_a_rate_follows_the_predictions_of_its_uplink(tmp_path: Path) -> None:
    one = trace(tmp_path / "one.csv", 3000, 2000)
    own = f"pqos: {{file: {one}, wrong: {{share: 2}}}}"
    words = ("pqos=trace", f"pqos.file={trace(tmp_path / 'other.csv', 700, 700)}")
    named = f"uplinks={{x: {{interface: b, {own}}}, y: {{interface: a}}}}"
    assert lanes(*words, "link=netns", "link.lanes={a: {}, b: {}}", named) == {"a": 700, "b": 3000}
    assert lanes(*words, "link=netns", "link.lanes={a: {}, b: {kbps: 50}}", named) == {"a": 700, "b": 50}
    addressed = named.replace("interface: b", "address: 127.0.1.2")
    for uplinks in (named, addressed):
        assert lanes(*words, "link=relay", "link.lanes={a: {}, b: {}}", uplinks) == {"a": 700, "b": 3000}


def test_an_uplink_that_is_no_lane_is_a_problem(tod: Command) -> None:
    both = "uplinks={a: {interface: a}, b: {address: 127.0.1.2}}"
    other = "must not be given: link=netns takes new addresses for each drive; interface names the lane"

    def found(*words: str) -> list[str]:
        return tod("demo", *NARROW, both, *words, "output=/nowhere").problems

    assert found("link=netns", "link.lanes={b: {}, c: {}}") == [
        "command line: uplinks.a.interface: a: no such lane: link.lanes has b, c",
        f"command line: uplinks.b.address: 127.0.1.2: {other}",
    ]
    assert found("link=netns")[0] == "command line: uplinks.a.interface: a: no such lane: link.lanes is null"
    assert found("link=relay", "link.lanes={b: {}}") == [
        "command line: uplinks.a.interface: a: no such lane: link.lanes has b",
        "command line: uplinks.b.address: 127.0.1.2: no such lane: 127.0.1.1 is b",
    ]


def test_uplinks_of_a_relay_send_from_the_addresses_of_its_lanes() -> None:
    words = (*NARROW, "link=relay", "link.lanes={x: {}, y: {}}", "uplinks={b: {interface: y}, a: {address: 127.0.1.1}}")
    config = configuration(words, runnable=False)
    assert config.link()
    for_vehicle = configuration([*words, *lane_overrides(config.document)], runnable=False).setup()
    assert for_vehicle.uplinks == {"b": Uplink(address="127.0.1.2"), "a": Uplink(address="127.0.1.1")}


def test_print_names_the_sources(tod: Command) -> None:
    words = ("uplinks={a: {interface: w0, pqos: {kind: live}}, b: {address: 10.0.0.7}}", "pqos=constant")
    assert tod("print", *NARROW, *words).out.splitlines()[1:3] == [
        "# uplink a: 1500 kbit/s, interface w0, predictions live",
        "# uplink b: 1500 kbit/s, address 10.0.0.7, predictions constant 5000 kbit/s, for all together",
    ]
    note = "# redundant has no effect on front: it needs two uplinks"
    assert note in tod("print", *NARROW, "++cameras.front.redundant=true").out.splitlines()


def test_a_device_that_does_not_exist_is_reported_and_ends_a_strict_vehicle() -> None:
    uplinks = {"a": Uplink("lo"), "b": Uplink("nix0"), "c": Uplink(address="10.0.0.7")}
    setup = replace(configuration(NARROW, runnable=False).setup(), uplinks=uplinks)
    assert missing_devices(setup) == ["uplink b: nix0: no such device; it is used once there is one"]
    with pytest.raises(RunError, match=r"^uplink b: nix0: no such device$"):
        missing_devices(replace(setup, strict=True))
