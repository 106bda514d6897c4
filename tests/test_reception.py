"""Reception reports: as messages, as measurements of the uplink, and headers on the wire."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction

import pytest
from helpers import Drive, vehicle
from hypothesis import given
from hypothesis import strategies as st

from runner.core.budget import on_the_wire, unplaced, video_kbps, wire_kbps
from runner.core.events import LinkMeasured, LinkState
from runner.core.model import Camera, Roi
from runner.core.rules.safe import sent_cameras
from runner.h264.region import region_unit
from runner.mqtt.messages import MqttMessage, read_reception, topic
from runner.records import to_json
from runner.records.lines import line_from_json, line_to_json
from runner.records.reception import ReceptionReport, ReceptionReported, UnitReceived
from runner.schema import MAX_ERRORS
from runner.vehicle.uplink import MeasuredUplink

ROBOT = vehicle("vehicle=delivery_robot")
APART = vehicle("vehicle=delivery_robot", "graph.sender.1.properties.aggregate-mode=none")
NAMES = tuple(ROBOT.cameras)
REPORT = ReceptionReport(
    at=100.04,
    as_of=3.2,
    units=(
        UnitReceived("front", 0.012, 0.0031, 2500, True, 0.0042, 3, 2100, 4, 3300),
        UnitReceived("rear", 0.0, 0.004, 900, whole=False),
    ),
    packets=4,
    lost=1,
)


def message(document: object, sender: str = "me", *, retained: bool = False) -> MqttMessage:
    return MqttMessage(topic("v", "reception", sender), json.dumps(document).encode(), retained)


REST = (True, 0, 0, 0, 0, 0)  # of a unit


def test_a_report_is_read_back_as_it_was_sent() -> None:
    assert read_reception(message(to_json(REPORT))) == REPORT
    assert to_json(REPORT)["units"][0] == ("front", 0.012, 0.0031, 2500, True, 0.0042, 3, 2100, 4, 3300)
    line = ReceptionReported(3.25, "me", True, REPORT)
    assert line_from_json(json.loads(json.dumps(line_to_json(line)))) == line


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"units": [["front", -1, 0, 5, *REST]]}, "units[0][1]: -1: must be at least 0"),
        ({"units": [["front", 1, 0]]}, 'units[0]: ["front", 1, 0]: must have at least 10 entries'),
        ({"units": [["front", 1, 0, 5.5, *REST]]}, "units[0][3]: 5.5: must be a whole number"),
        ({"lost": -1}, "lost: -1: must be at least 0"),
        (
            {"extra": 1},
            "extra: unknown key; expected one of at, as_of, units, packets, lost, latency_ms, damaged, sent, run, "
            "uplink, view, offset_s",
        ),
    ],
)
def test_an_invalid_report_is_rejected(change: dict[str, object], problem: str) -> None:
    with pytest.raises(ValueError) as raised:
        read_reception(message(to_json(REPORT) | change))
    assert str(raised.value) == problem


def test_a_report_must_be_current_and_have_a_sender() -> None:
    with pytest.raises(ValueError, match="must not be retained"):
        read_reception(message(to_json(REPORT), retained=True))
    with pytest.raises(ValueError, match="an operator's id must be"):
        read_reception(message(to_json(REPORT), sender="not allowed"))


def reports(count: int, *, kbytes: float = 10, operator: str = "me", in_control: bool = True, delay_s: float = 0.0):  # type: ignore[no-untyped-def]
    """Reports of a steady stream of every camera, 25 a second."""
    for number in range(count):
        units = tuple(UnitReceived(name, 0.02, delay_s, int(kbytes * 1000 / 25 / len(NAMES))) for name in NAMES)
        report = ReceptionReport(50 + 0.04 * number, 1 + 0.04 * number - 0.07, units, len(NAMES), 0)
        yield ReceptionReported(1 + 0.04 * number, operator, in_control, report)


def test_a_steady_stream_means_a_clear_link_and_headers_count() -> None:
    uplink = MeasuredUplink(ROBOT)
    measured = [uplink.take(reported) for reported in reports(30)]
    last = measured[-1]
    assert isinstance(last, LinkMeasured)
    assert (last.t, last.state, last.queue_ms, last.loss) == (pytest.approx(2.16), LinkState.CLEAR, 0, 0)
    assert last.rtt_ms == pytest.approx(70)
    assert float(last.kbps or 0) == pytest.approx(80 + 25 * 58 * 8 / 1000 * len(NAMES), rel=0.02)


def test_only_the_operator_in_control_is_measured() -> None:
    uplink = MeasuredUplink(ROBOT)
    assert not any(uplink.take(reported) for reported in reports(30, in_control=False))


def test_a_change_of_control_restarts_the_estimate() -> None:
    """A second place has another path: its longer delay is no queue."""
    uplink = MeasuredUplink(ROBOT)
    for reported in reports(30):
        uplink.take(reported)
    measured = [uplink.take(reported) for reported in reports(30, operator="you", delay_s=0.5)]
    assert {link.queue_ms for link in measured if link} == {0}


def of_run(run: int, begin: float, count: int, delay_s: float) -> list[ReceptionReported]:
    """Reports of one process, from a time on."""
    return [
        replace(each, t=each.t + begin, report=replace(each.report, at=each.report.at + begin, run=run))
        for each in reports(count, delay_s=delay_s)
    ]


def test_a_restarted_operator_restarts_the_estimate() -> None:
    """Its delays have another base: those of the process before would look like a queue."""
    uplink = MeasuredUplink(ROBOT)
    for reported in of_run(1, 0, 100, -0.25):
        uplink.take(reported)
    measured = [uplink.take(reported) for reported in of_run(2, 6, 100, 0)]
    assert {(link.queue_ms, link.state) for link in measured if link} == {(0, LinkState.CLEAR)}
    assert measured[-1]


def test_of_two_processes_of_one_operator_the_first_is_measured() -> None:
    uplink, both = MeasuredUplink(ROBOT), zip(of_run(1, 0, 50, 0), of_run(2, 0.02, 50, 0.5), strict=True)
    found = [
        (uplink.is_rival(first), uplink.take(first), uplink.is_rival(second), uplink.take(second))
        for first, second in both
    ]
    assert [(rival, is_rival, ignored) for rival, _, is_rival, ignored in found] == [(False, True, None)] * 50
    assert found[-1][1]
    assert not uplink.is_rival(of_run(2, 3.2, 1, 0)[0]), "the first has ended"


def test_units_of_unknown_cameras_are_left_out() -> None:
    uplink = MeasuredUplink(ROBOT)
    strange = replace(REPORT, units=(UnitReceived("side", 0.0, 0.0, 5),))
    assert uplink.take(ReceptionReported(1, "me", True, strange)) is None


@pytest.mark.parametrize("says", [lambda camera: camera, unplaced])
@given(video=st.integers(0, 10**5))
def test_video_and_wire_rates_convert_back_and_forth(says: Callable[[Camera], Camera], video: int) -> None:
    cameras = tuple(map(says, ROBOT.cameras.values()))
    assert video_kbps(cameras, wire_kbps(cameras, Fraction(video))) == video
    assert video_kbps(cameras, Fraction(1)) == 0


def test_headers_of_an_access_unit() -> None:
    graph = ROBOT.cameras["front"].graph
    assert [on_the_wire(graph, size) for size in (1, 1186, 1187, 5000)] == [59, 1244, 1303, 5290]


@given(size=st.integers(1, 5000), hz=st.sampled_from([5, 15, 40]), shares=st.booleans())
def test_that_pictures_say_what_they_show_is_counted(size: int, hz: int, shares: bool) -> None:
    """Of a small picture in its packet, else in a packet of its own, as with a payloader that puts nothing together."""
    camera = replace((ROBOT if shares else APART).cameras["rear"], fps=Fraction(hz))
    stated = len(region_unit(Roi(1000, 1000, 1000, 1000)))
    is_apart = not shares or size + 2 + 3 + stated > 1186
    sent = on_the_wire(camera.graph, size) + (on_the_wire(camera.graph, stated) if is_apart else 3 + stated)
    kbit = Fraction(8 * hz, 1000)
    bound = wire_kbps((camera,), size * kbit) / kbit
    assert sent <= bound <= sent + 58 * 3
    assert bound > wire_kbps((unplaced(camera),), size * kbit) / kbit


def test_only_cameras_that_send_a_region_are_counted_so() -> None:
    drive = connected("mode=single", kbps=6000)
    before = sent_cameras(drive.vehicle, drive.run.state, {})
    drive.accept("roi_set", camera="rear", x=0, y=0, width=424, height=240)
    after = {camera.name: camera.graph.places for camera in sent_cameras(drive.vehicle, drive.run.state, {})}
    assert not any(camera.graph.places for camera in before)
    assert [name for name, places in after.items() if places] == ["rear"]


# --- the total that follows ------------------------------------------------------------------------------------------


def connected(*overrides: str, **prediction: float) -> Drive:
    """A drive with a prediction, in kbit/s, whose operator has connected."""
    drive = Drive("vehicle=delivery_robot", "modes=safe", *overrides)
    drive.accept("bitrate_predicted", **{"valid_s": 1000, **prediction})
    drive.accept("operator_connected")
    return drive


def measured(drive: Drive, begin: float, kbps: float, seconds: float = 2, **evidence: float) -> Fraction:
    """The total after reports, 25 a second, of a link that is busy and carries this much."""
    return [drive.reports(begin + n / 25, kbps, **evidence) for n in range(round(25 * seconds))][-1]


def test_the_total_is_what_the_link_carries_without_headers() -> None:
    drive = connected(kbps=6000)
    total, cameras = measured(drive, 0.1, 3000), tuple(map(unplaced, drive.vehicle.cameras.values()))
    wire = Fraction(round(drive.run.memory["follow_link", "follow_link"]["belief"].total, 1)).limit_denominator(10)
    assert total == Fraction(int(10 * video_kbps(cameras, wire)), 10)
    assert 0.75 * 3000 < total < 3000
    assert "capacity of the link, believed to be" in drive[NAMES[0]].reason


def test_a_reserve_is_left_to_others() -> None:
    rule = "modes.automatic.follow_link.reserve_kbps=500"
    totals = [measured(connected(*more, kbps=6000), 0.1, 3000) for more in ((), (rule,))]
    assert totals[0] - totals[1] == pytest.approx(500, rel=0.1)


def test_a_prediction_is_a_limit_only_where_it_is_a_ceiling() -> None:
    """As in a slice that enforces it."""
    rule = "modes.automatic.follow_link.ceiling=prediction"
    assert measured(connected(kbps=2000), 0.1, 4000) > 3000
    assert measured(connected(rule, kbps=2000), 0.1, 4000) == 2000


def test_the_measurement_ends_when_the_operator_leaves() -> None:
    drive = connected(kbps=3000)
    measured(drive, 1, 1500, 0.5)
    drive.accept("operator_disconnected", t=1.6)
    drive.accept("operator_connected", t=20)
    drive.accept("clock_advanced", t=30)
    assert drive.total == 3000


# --- without a prediction ---------------------------------------------------------------------------------------------


def test_without_a_prediction_the_measurement_alone_decides() -> None:
    drive = connected(kbps=3000, valid_s=2)
    assert measured(drive, 0.1, 1500, 4) == pytest.approx(1500, rel=0.2)
    assert measured(drive, 4.1, 4000, 4) == pytest.approx(4000, rel=0.2)


@pytest.mark.parametrize("prediction", [{"kbps": 2000, "lower_kbps": 0}, {"kbps": 0}, {"kbps": 2}])
def test_a_prediction_of_nothing_stops_no_video_of_a_link_that_is_measured(prediction: dict[str, float]) -> None:
    drive = connected(**prediction)
    assert drive.total < 3
    assert measured(drive, 0.1, 3000) > 2000


@pytest.mark.parametrize("kbps", [0, 2])
def test_a_stale_prediction_of_nothing_that_was_never_measured_leaves_the_floor(kbps: int) -> None:
    """Otherwise nothing is sent, so that nothing can be measured, until the next prediction."""
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", t=0, kbps=kbps)
    totals = [drive.accept("clock_advanced", t=t).decision.total for t in (1, 1.9, 2.1, 5)]
    assert totals == [kbps, kbps, 500, 500]


def test_without_a_prediction_and_a_measurement_the_total_fades() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", t=0, kbps=3000)
    for t in (1, 2.5, 3.6, 10):
        drive.accept("clock_advanced", t=t)
    assert drive.total == 500


def test_an_operator_who_asks_for_more_does_not_make_the_link_wider() -> None:
    drive = connected(kbps=3000)
    drive.accept("mode_selected", mode="collective")
    drive.accept("total_set", kbps=3000)
    known = measured(drive, 0.1, 1500)
    drive.accept("total_set", t=2.1, kbps=6000)
    assert drive.total == pytest.approx(known, rel=0.05)
    assert measured(drive, 2.14, 7000) == 6000


# --- mode S -----------------------------------------------------------------------------------------------------------


def single(*overrides: str) -> Drive:
    drive = connected(*overrides, kbps=3000)
    drive.accept("clock_advanced", t=6)  # the start is over
    drive.accept("mode_selected", mode="single")
    for name in NAMES:
        drive.accept("camera_configured", camera=name, kbps=1000, scaling=1)
    return drive


def test_in_mode_s_all_cameras_are_cut_by_one_factor_and_return() -> None:
    drive = single()
    assert {drive.sent(name) for name in NAMES} == {(1000, 1.0)}
    measured(drive, 6, 1200)
    sent = {name: drive.sent(name) for name in NAMES}
    weights = {name: camera.weight for name, camera in drive.vehicle.cameras.items()}
    assert sum(kbps for kbps, _ in sent.values()) < 1200
    assert sent["front"][0] == pytest.approx(float(sent["mast"][0] * weights["front"] / weights["mast"]), abs=2)
    assert all(factor is not None and factor < 1 for _, factor in sent.values())
    assert drive.run.decision.asked == 3000
    assert "as set in mode single, sent with" in drive["front"].reason
    measured(drive, 8, 5000)
    assert {drive.sent(name) for name in NAMES} == {(1000, 1.0)}


def test_settings_of_mode_s_entered_under_a_limit_recover_with_the_link() -> None:
    drive = connected(kbps=3000)
    drive.accept("clock_advanced", t=6)
    before = {name: drive.sent(name) for name in NAMES}
    low = measured(drive, 6, 1200)
    drive.accept("mode_selected", t=8, mode="single")
    assert drive.total == pytest.approx(low, rel=0.03)
    measured(drive, 8.1, 5000)
    assert {name: drive.sent(name) for name in NAMES} == before


def test_a_camera_switched_off_under_a_limit_returns_without_it_in_mode_s() -> None:
    drive = connected(kbps=3000)
    drive.accept("clock_advanced", t=6)
    before = drive.sent("rear")
    measured(drive, 6, 1200)
    drive.accept("camera_switched", t=8, camera="rear", on=False)
    drive.accept("mode_selected", t=8, mode="single")
    drive.accept("camera_switched", t=8, camera="rear", on=True)
    measured(drive, 8.1, 5000)
    assert drive.sent("rear") == before


def test_floors_come_first_in_mode_s_too() -> None:
    drive = single("cameras.front.floor_kbps=900")
    measured(drive, 6, 1700)
    assert drive.sent("front")[0] == 900
    assert drive.sent("rear")[0] < 400


def test_a_floor_above_what_the_operator_asks_for_reserves_nothing() -> None:
    """Of the floor of 800 only the 200 that the camera is set to are needed."""
    drive = single("cameras.front.floor_kbps=800")
    drive.accept("camera_configured", camera="front", kbps=200, scaling=1)
    measured(drive, 6, 900, 6)
    assert drive.total < 900
    assert drive.sent("front")[0] == 200


SHED = ("cameras.front.floor_kbps=600", "cameras.rear.floor_kbps=300", "cameras.rear.shed=1")


def test_in_mode_s_a_camera_is_given_up_for_the_floors_of_others_and_returns() -> None:
    drive = single(*SHED)
    measured(drive, 6, 800, 30)
    assert drive["front"].kbps >= 600
    assert (drive["front"].sending, drive["rear"].sending) == (True, False)
    assert drive["front"].reason.endswith("rear given up for the floors of others")
    measured(drive, 36, 5000)
    assert {drive.sent(name) for name in NAMES} == {(1000, 1.0)}
    assert "given up" not in drive["front"].reason


def test_a_camera_is_given_up_for_the_floors_of_others() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe", *SHED)
    drive.accept("bitrate_predicted", kbps=800)
    assert (drive["front"].sending, drive["rear"].sending) == (True, False)
    assert drive["front"].reason.endswith("rear given up for the floors of others")
    drive.accept("bitrate_predicted", kbps=2000)
    assert drive["rear"].sending


# --- several copies ---------------------------------------------------------------------------------------------------


def test_the_total_counts_every_copy_that_leaves_the_vehicle() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", kbps=3000)
    one = {name: drive[name].kbps for name in NAMES}
    drive.accept("copies_counted", copies={"front": 2})
    two = {name: drive[name].kbps for name in NAMES}
    assert sum(two.values()) + two["front"] <= 3000
    assert sum(two.values()) + two["front"] == pytest.approx(3000, abs=4)
    assert all(two[name] < one[name] for name in NAMES)
    drive.accept("copies_counted", copies={})
    assert {name: drive[name].kbps for name in NAMES} == one


def test_copies_for_other_viewers_occupy_the_measured_link_too() -> None:
    """All cameras twice: the operator measures half of what the link carries."""
    drive = connected(kbps=6000)
    drive.accept("copies_counted", copies=dict.fromkeys(NAMES, 2))
    assert 0.75 * 3000 < measured(drive, 0.1, 1500) < 3000
    assert 2 * sum(drive[name].kbps for name in NAMES) <= drive.total


def test_control_of_an_unmeasured_link_begins_like_a_connection() -> None:
    """Watchers stayed, so the link was never unused: their reports do not count, and the limit has been lifted."""
    drive = connected(kbps=6000)
    drive.accept("control_passed", t=0, operator="me")
    assert drive.total == 3000
    assert measured(drive, 0.1, 7000, 8) > 6000
    drive.accept("control_passed", t=8.1, operator="")
    drive.accept("clock_advanced", t=14)
    assert drive.total == 6000
    drive.accept("control_passed", t=15, operator="me")
    assert drive.total == 3000


# --- what must not happen ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["delivery_robot", "tum_q7"])
@pytest.mark.parametrize("copies", [1, 2])
def test_a_long_stall_never_stops_all_cameras(name: str, copies: int) -> None:
    """Headers alone take 130 kbit/s of eight cameras: without any picture the link could not be measured again."""
    drive = connected(f"vehicle={name}", kbps=3000)
    drive.accept("copies_counted", copies=dict.fromkeys(drive.vehicle.cameras, copies))
    measured(drive, 0.1, 3000)
    for n in range(100):
        drive.reports(2.1 + n / 25, 0, silent_s=n / 25)
    assert all(setting.sending for setting in drive.run.decision.settings.values())
    assert drive.total < 100
    assert measured(drive, 6.1, 3500, 1) > 2000


def test_what_the_link_carries_is_known_for_a_while_without_an_operator() -> None:
    drive = connected(kbps=6000)
    known = measured(drive, 0.1, 2500)
    drive.accept("operator_disconnected", t=2.2)
    drive.accept("clock_advanced", t=3)
    assert drive.total == known
    drive.accept("operator_connected", t=4)
    assert drive.total == known
    drive.accept("clock_advanced", t=8)
    assert drive.total == 3000, "of an operator who measures nothing"
    drive.accept("clock_advanced", t=9.1)
    assert drive.total == 6000


def test_all_cameras_off_and_a_stale_prediction() -> None:
    drive = connected(kbps=3000, valid_s=2)
    for name in NAMES:
        drive.accept("camera_switched", camera=name, on=False)
    measured(drive, 5, 0, 0.04)
    drive.accept("camera_switched", camera="front", on=True)
    assert measured(drive, 5.1, 3000) > 2000
    assert drive.run.fault is None


def test_in_mode_s_a_camera_that_is_switched_on_again_is_as_the_operator_has_set_it() -> None:
    drive = single()
    measured(drive, 6, 1200)
    drive.accept("camera_switched", camera="front", on=False)
    drive.accept("camera_switched", camera="front", on=True)
    measured(drive, 8.1, 5000)
    assert drive.sent("front") == (1000, 1.0)


def test_a_second_viewer_in_mode_s_is_no_reason_to_send_less() -> None:
    drive = single()
    drive.accept("copies_counted", copies=dict.fromkeys(NAMES, 2))
    assert {drive.sent(name) for name in NAMES} == {(1000, 1.0)}
    assert drive.total == 6000


def test_an_operators_clock_that_goes_back_restarts_the_estimate() -> None:
    uplink = MeasuredUplink(ROBOT)
    for reported in (*reports(30), *reports(30, delay_s=-7)):
        link = uplink.take(reported)
    assert link is not None
    assert (link.queue_ms, link.state) == (0, LinkState.CLEAR)


def test_numbers_out_of_range_are_refused() -> None:
    for key in ("at", "as_of"):
        with pytest.raises(ValueError, match=f"{key}: 1e.308: must be at most"):
            read_reception(message(to_json(REPORT) | {key: 1e308}))


def test_the_number_of_explained_mistakes_is_limited() -> None:
    """A flood of long invalid reports must not keep the vehicle from hearing its operator."""
    with pytest.raises(ValueError) as raised:
        read_reception(message(to_json(REPORT) | {"units": [[]] * 1900}))
    assert str(raised.value).count("must have at least 10 entries") == MAX_ERRORS
