"""Reception reports: as messages, as measurements of the uplink, and headers on the wire."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import pytest
from helpers import Drive, vehicle
from hypothesis import given
from hypothesis import strategies as st

from runner.core.budget import on_the_wire, video_kbps, wire_kbps
from runner.core.events import LinkMeasured
from runner.core.uplink import LinkState
from runner.mqtt.messages import MqttMessage, read_reception, topic
from runner.records import ReceptionReport, ReceptionReported, UnitReceived, line_from_json, line_to_json, to_json
from runner.schema import MAX_ERRORS
from runner.vehicle.uplink import MeasuredUplink

ROBOT = vehicle("vehicle=delivery_robot")
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


def test_a_report_is_read_back_as_it_was_sent() -> None:
    assert read_reception(message(to_json(REPORT))) == REPORT
    assert to_json(REPORT)["units"][0] == ("front", 0.012, 0.0031, 2500, True, 0.0042, 3, 2100, 4, 3300)
    older = {**to_json(REPORT), "units": [unit[:4] for unit in to_json(REPORT)["units"]]}
    assert all(unit.whole for unit in read_reception(message(older)).units)
    line = ReceptionReported(3.25, "me", True, REPORT)
    assert line_from_json(json.loads(json.dumps(line_to_json(line)))) == line


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"units": [["front", -1, 0, 5]]}, "units[0][1]: -1: must be at least 0"),
        ({"units": [["front", 1, 0]]}, 'units[0]: ["front", 1, 0]: must have at least 4 entries'),
        ({"units": [["front", 1, 0, 5.5]]}, "units[0][3]: 5.5: must be a whole number"),
        ({"lost": -1}, "lost: -1: must be at least 0"),
        (
            {"extra": 1},
            "extra: unknown key; expected one of at, as_of, units, packets, lost, latency_ms, damaged, sent, run, "
            "offset_s",
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


@given(video=st.integers(0, 10**5))
def test_video_and_wire_rates_convert_back_and_forth(video: int) -> None:
    cameras = tuple(ROBOT.cameras.values())
    assert video_kbps(cameras, wire_kbps(cameras, Fraction(video))) == video
    assert video_kbps(cameras, Fraction(1)) == 0


def test_headers_of_an_access_unit() -> None:
    graph = ROBOT.cameras["front"].graph
    assert [on_the_wire(graph, size) for size in (1, 1186, 1187, 5000)] == [59, 1244, 1303, 5290]


def test_the_cap_is_a_total_without_headers() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", kbps=6000)
    drive.accept("link_measured", kbps=3000, queue_ms=60, state="filling", rtt_ms=30)
    cameras = tuple(drive.vehicle.cameras.values())
    assert drive.total == Fraction(int(10 * video_kbps(cameras, Fraction(3000) * Fraction(17, 20))), 10)
    assert "measured capacity of the link" in drive[NAMES[0]].reason


def test_a_reserve_is_left_to_others() -> None:
    drives = [Drive("vehicle=delivery_robot", "modes=safe", *more) for more in ((), (RESERVE,))]
    for drive in drives:
        drive.accept("bitrate_predicted", kbps=6000)
        drive.accept("link_measured", kbps=3000, queue_ms=60, state="filling", rtt_ms=30)
    assert drives[0].total - drives[1].total == pytest.approx(200, rel=0.1)


def test_a_cap_of_little_more_than_the_reserve_recovers() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe", RESERVE.replace("200", "1000"))
    drive.accept("bitrate_predicted", kbps=4000, valid_s=1000)
    measured(drive, 0.1, 1400, "filling", 60)
    assert drive.total < 400
    for t in range(10, 1000):
        measured(drive, t / 25, float(drive.total))
    assert drive.total == 4000


RESERVE = "modes.automatic=[{total_from_prediction:{start_kbps:3000}},{cap_by_link:{reserve_kbps:200}},{demand_from_roi:{}},{share_by_demand:{}},{scaling_from_rate_quality:{}}]"  # fmt: skip  # noqa: E501


def test_the_measurement_ends_when_the_operator_leaves() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", kbps=3000, valid_s=1000)
    drive.accept("link_measured", t=1, kbps=3000, queue_ms=0, state="clear", rtt_ms=30)
    drive.accept("operator_disconnected", t=1.1)
    drive.accept("operator_connected", t=20)
    drive.accept("clock_advanced", t=30)
    assert drive.total == 3000


@pytest.mark.parametrize("kbps", [0, 2])
def test_video_that_is_not_sent_is_no_stall(kbps: int) -> None:
    """A total below 1 kbit/s for each camera stops all of them: nothing can arrive."""
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", kbps=kbps, valid_s=1000)
    for tenth in range(50):
        drive.accept("link_measured", t=tenth / 10, queue_ms=0, state="stalled")
    drive.accept("bitrate_predicted", kbps=3000, valid_s=1000)
    assert drive.total == 3000


# --- without a prediction ---------------------------------------------------------------------------------------------


def measured(
    drive: Drive, t: float, kbps: float, state: str = "clear", queue_ms: float = 0, loss: float = 0
) -> Fraction:
    drive.accept("link_measured", t=t, kbps=kbps, queue_ms=queue_ms, state=state, loss=loss, rtt_ms=30)
    return drive.run.decision.total


def test_without_a_prediction_the_measurement_alone_decides() -> None:
    """From what was sent last up to what the link carries, by careful steps."""
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", t=0, kbps=3000)
    totals = [measured(drive, t / 25, 3000) for t in range(250)]
    assert set(totals[:50]) == {3000}
    steps = [after / before for before, after in pairwise(totals) if after != before]
    assert 1 < min(steps) < 1.03
    assert max(steps) < 1.5
    full = sum(camera.rate_quality.b_full for camera in drive.vehicle.cameras.values())
    assert totals[-1] == full
    cut = measured(drive, 10.02, 2000, "filling", 60)
    assert cut < 2000
    drive.accept("bitrate_predicted", t=10.1, kbps=1000)
    assert drive.total == 1000


@pytest.mark.parametrize("prediction", [{"kbps": 2000, "lower_kbps": 0}, {"kbps": 0}, {"kbps": 2}])
def test_a_stale_prediction_of_nothing_stops_no_video(prediction: dict[str, int]) -> None:
    """As in a dead spot, after which the predictor falls silent: the link measured before shows that reports arrive."""
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", t=0, **prediction)
    assert measured_until(drive, 0, 2, kbps=100) < 3
    assert measured(drive, 2.04, 100, "stalled") >= 50
    for t in range(200):
        measured(drive, 2.1 + t / 25, float(drive.total))
    assert drive.total > 2000
    drive.accept("bitrate_predicted", t=11, **prediction)
    assert drive.total < 3


def test_a_link_known_to_be_narrow_is_probed_from_what_it_carries() -> None:
    """Once the prediction, which was too high, is stale."""
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", t=0, kbps=3000, valid_s=5)
    measured_until(drive, 0, 4, kbps=3000)
    for t in range(100, 115):  # for longer than jitter lasts
        measured(drive, t / 25, 1000, "filling", 60)
    totals = [measured(drive, t / 25, min(1000, float(drive.total))) for t in range(115, 200)]
    steps = [after / before for before, after in pairwise(totals) if before > 1000]
    assert steps
    assert max(steps) < 1.1


def test_a_doubted_prediction_that_becomes_stale_is_followed_no_further_than_before() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", t=0, kbps=4000, valid_s=20)
    for t in range(4, 13, 2):  # each time that it is followed, the queue grows
        measured(drive, t, 2800, "filling", 60)
        for n in range(1, 48):
            measured(drive, t + n / 25, 2800)
    assert drive.run.memory["cap_by_link"].trust.share < 0.8
    totals = [measured(drive, 14 + n / 25, 4000) for n in range(200)]
    assert all(after < 1.1 * before for before, after in pairwise(totals[140:160]))


def test_a_prediction_that_returns_restores_the_total_at_once() -> None:
    """What the link carried was measured under another limit, the sum of all b_full."""
    drive = Drive("vehicle=tum_q7", "modes=safe")
    drive.accept("bitrate_predicted", t=0, kbps=3000)
    measured_until(drive, 0, 4, kbps=3000)
    for t in range(100, 110):
        measured(drive, t / 25, 2500, "filling", 200)
    assert drive.total < 1700
    for t in range(111, 113):
        measured(drive, t / 25, 1500)
    drive.accept("bitrate_predicted", t=7, kbps=2200, valid_s=1000)
    for t in range(25):
        measured(drive, 7 + t / 25, float(drive.total))
    assert drive.total >= 2000


def test_the_total_fades_from_the_last_measurement_on_while_the_link_is_known() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", t=0, kbps=20000)
    measured_until(drive, 0, 20, kbps=3000)
    drive.accept("control_passed", t=20, operator="another")
    totals = [drive.accept("clock_advanced", t=t).decision.total for t in (20.5, 21.1, 21.5, 23.2)]
    assert [round(total) for total in totals] == [10000, 5000, 5000, 500]


def test_without_new_measurements_no_more_is_sent_than_the_link_carried() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", t=0, kbps=10000)
    measured_until(drive, 0, 10, kbps=3000)
    for t in (10, 10.3, 10.6, 11):
        known = measured(drive, t, 800, "filling", 200)
    assert known < 900
    drive.accept("control_passed", t=11, operator="another")
    totals = [drive.accept("clock_advanced", t=11 + n / 10).decision.total for n in range(1, 50)]
    assert max(totals) <= max(known, 500)


def test_a_stale_prediction_fades_although_a_link_is_measured_that_does_not_replace_it() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe", "~modes.automatic.2.cap_by_link.alone_after_s")
    drive.accept("bitrate_predicted", t=0, kbps=8000)
    measured_until(drive, 0, 20, kbps=3000)
    assert drive.total == 500


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
    """Only a prediction that rises says that."""
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("mode_selected", mode="collective")
    drive.accept("total_set", kbps=3000)
    total = measured_until(drive, 0, 10, kbps=3000)
    for t in (10, 10.3, 10.6, 11):
        total = measured(drive, t, 1500, "filling", 100)
    drive.accept("total_set", t=12, kbps=6000)
    totals = []
    for n in range(25):
        totals.append(total := measured(drive, 12 + n / 25, min(float(total), 1500)))
    assert 1300 < totals[-1] <= max(totals) < 1600, "careful steps beyond what the link carried"


# --- mode S -----------------------------------------------------------------------------------------------------------


def single(*overrides: str) -> Drive:
    drive = Drive("vehicle=delivery_robot", "modes=safe", *overrides)
    drive.accept("mode_selected", mode="single")
    for name in NAMES:
        drive.accept("camera_configured", camera=name, kbps=1000, scaling=1)
    return drive


def test_in_mode_s_all_cameras_are_cut_by_one_factor_and_return() -> None:
    drive = single()
    assert {drive.sent(name) for name in NAMES} == {(1000, 1.0)}
    measured(drive, 0.1, 1200, "filling", 60)
    sent = {name: drive.sent(name) for name in NAMES}
    weights = {name: camera.weight for name, camera in drive.vehicle.cameras.items()}
    assert sum(kbps for kbps, _ in sent.values()) < 1200
    assert sent["front"][0] == pytest.approx(float(sent["mast"][0] * weights["front"] / weights["mast"]), abs=2)
    assert all(factor is not None and factor < 1 for _, factor in sent.values())
    assert drive.run.decision.asked == 3000
    assert "as set in mode single, sent with" in drive["front"].reason
    for t in range(10, 400):
        measured(drive, t / 25, 3200)
    assert {drive.sent(name) for name in NAMES} == {(1000, 1.0)}


def test_settings_of_mode_s_entered_under_a_cap_recover_with_the_link() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", kbps=3000, valid_s=1000)
    before = {name: drive.sent(name) for name in NAMES}
    measured(drive, 0.1, 1200, "filling", 60)
    capped = drive.total
    drive.accept("mode_selected", t=0.1, mode="single")
    assert drive.total == capped
    for t in range(10, 400):
        measured(drive, t / 25, 3200)
    assert {name: drive.sent(name) for name in NAMES} == before


def test_a_camera_switched_off_under_a_cap_returns_uncapped_in_mode_s() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", kbps=3000, valid_s=1000)
    before = drive.sent("rear")
    measured(drive, 0.1, 1200, "filling", 60)
    drive.accept("camera_switched", t=0.1, camera="rear", on=False)
    drive.accept("mode_selected", t=0.1, mode="single")
    drive.accept("camera_switched", t=0.1, camera="rear", on=True)
    for t in range(10, 600):
        measured(drive, t / 25, 3600)
    assert drive.sent("rear") == before


def test_floors_come_first_in_mode_s_too() -> None:
    drive = single("cameras.front.floor_kbps=900")
    measured(drive, 0.1, 1700, "filling", 60)
    assert drive.sent("front")[0] == 900
    assert drive.sent("rear")[0] < 300


def test_a_cut_ends_at_the_floors_unless_they_are_too_much_for_the_link() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe", "cameras.front.floor_kbps=500", "cameras.mast.floor_kbps=100")
    drive.accept("bitrate_predicted", kbps=3000, valid_s=1000)
    measured(drive, 0.1, 300, "filling", 200)
    assert (drive.total, drive["front"].kbps, drive["mast"].kbps) == (600, 500, 100)
    for n in range(20):
        measured(drive, 0.2 + n / 25, 550, "filling", 300 + n)
    assert drive.total == 600, "competing traffic fills the queue, and the floors arrive"
    measured(drive, 1.2, 300, "filling", 400)
    assert drive.total < 300


def test_a_floor_above_what_the_operator_asks_for_reserves_nothing() -> None:
    """Of the floor of 800 only the 200 that the camera is set to are needed."""
    drive = single("cameras.front.floor_kbps=800")
    drive.accept("camera_configured", camera="front", kbps=200, scaling=1)
    measured(drive, 0.1, 750, "filling", 200)
    assert drive.total < 750
    assert drive.sent("front")[0] == 200


def test_a_full_queue_of_the_floors_alone_gives_them_up() -> None:
    """10 % less than the floors arrives: competing traffic would have backed off after the losses."""
    drive = Drive("vehicle=delivery_robot", "modes=safe", "cameras.front.floor_kbps=500", "cameras.mast.floor_kbps=100")
    drive.accept("bitrate_predicted", kbps=3000, valid_s=1000)
    measured(drive, 0.1, 300, "filling", 200)
    for n in range(1, 400):
        measured(drive, 0.1 + n / 25, 590, "filling", 300, loss=0.1 if n % 100 else 0.0)
    assert drive.total == 600, "losses stop every 4 s, as with competing flows"
    for n in range(400, 620):
        measured(drive, 0.1 + n / 25, 590, "filling", 300, loss=0.1)
    assert drive.total < 0.95 * 590


def test_the_total_recovers_although_all_cameras_were_given_up() -> None:
    """Nothing arrives then, which must not keep the cap from growing."""
    shed = [f"cameras.{name}.{key}" for name in NAMES for key in ("floor_kbps=300", f"shed={NAMES.index(name) + 1}")]
    drive = Drive("vehicle=delivery_robot", "modes=safe", *shed)
    drive.accept("bitrate_predicted", kbps=3000, valid_s=1000)
    measured(drive, 0.1, 150, "filling", 200)
    assert not any(drive[name].sending for name in NAMES)
    for n in range(1, 3000):
        sent = sum(drive[name].kbps for name in NAMES)
        measured(drive, 0.1 + n / 25, 1.06 * sent)
    assert drive.total == 3000


SHED = ("cameras.front.floor_kbps=600", "cameras.rear.floor_kbps=300", "cameras.rear.shed=1")


def test_in_mode_s_a_camera_is_given_up_for_the_floors_of_others_and_returns() -> None:
    drive = single(*SHED)
    measured(drive, 0.1, 800, "filling", 60)
    assert drive["front"].kbps >= 600
    assert (drive["front"].sending, drive["rear"].sending) == (True, False)
    assert drive["front"].reason.endswith("rear given up for the floors of others")
    for t in range(10, 400):
        measured(drive, t / 25, 3200)
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
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", kbps=6000)
    drive.accept("copies_counted", copies=dict.fromkeys(NAMES, 2))
    measured(drive, 0.1, 1500, "filling", 60)
    assert 0.75 * 3000 < drive.total < 3000
    assert 2 * sum(drive[name].kbps for name in NAMES) <= drive.total


def test_after_a_prediction_of_0_no_more_is_sent_than_the_link_is_known_to_carry() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", kbps=3000, valid_s=1)
    measured(drive, 0.1, 250, "filling", 200)
    known = drive.total
    assert known < 250
    drive.accept("bitrate_predicted", t=0.2, kbps=0, valid_s=1)
    drive.accept("control_passed", t=0.2, operator="another")
    assert drive.accept("clock_advanced", t=1).decision.total == 0
    assert drive.accept("clock_advanced", t=1.5).decision.total == known
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", kbps=0, valid_s=1)
    assert drive.accept("clock_advanced", t=1.5).decision.total == 500, "nothing is known"


def test_control_of_an_unmeasured_link_begins_like_a_connection() -> None:
    """Watchers stayed, so the link was never unused: their reports do not count, and the cap has been lifted."""
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", kbps=6000, valid_s=1000)
    drive.accept("operator_connected", t=0)
    drive.accept("control_passed", t=0, operator="me")
    assert drive.total < 3100
    for n in range(1, 200):
        measured(drive, n / 25, 6500)
    assert drive.total == 6000
    drive.accept("control_passed", t=8, operator="")
    drive.accept("clock_advanced", t=11)
    assert drive.total == 6000
    drive.accept("control_passed", t=12, operator="me")
    assert drive.total < 3100


def test_copies_count_with_the_bitrate_that_they_have() -> None:
    """Front, with a small ROI, asks for a tenth of its b_full: its second copy adds little."""
    drive = single()
    drive.accept("roi_set", camera="front", x=0, y=0, width=320, height=288)
    drive.accept("mode_selected", mode="automatic")
    drive.accept("bitrate_predicted", kbps=3000, valid_s=1000)
    drive.accept("copies_counted", copies={"front": 2})
    one = {name: float(drive[name].kbps) for name in NAMES}
    share = 1 + one["front"] / sum(one.values())
    assert 1.05 < share < 1.25
    measured(drive, 0.1, 2000, "filling", 60)
    carried = share * 2000
    assert 0.75 * carried < drive.total < 0.9 * carried


# --- what must not happen ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["delivery_robot", "tum_q7"])
@pytest.mark.parametrize("copies", [1, 2])
def test_a_long_stall_never_stops_all_cameras(name: str, copies: int) -> None:
    """Headers alone take 130 kbit/s of eight cameras: without any picture the link could not be measured again."""
    drive = Drive(f"vehicle={name}", "modes=safe")
    drive.accept("bitrate_predicted", kbps=3000, valid_s=1000)
    drive.accept("copies_counted", copies=dict.fromkeys(drive.vehicle.cameras, copies))
    for t in range(100):
        drive.accept("link_measured", t=t / 10, queue_ms=0, state="stalled", rtt_ms=30)
    assert all(setting.sending for setting in drive.run.decision.settings.values())
    assert drive.total < 100
    assert measured_until(drive, 10, 20, kbps=3500) == 3000


def measured_until(drive: Drive, begin: float, end: float, kbps: float) -> Fraction:
    for step in range(int((end - begin) * 25)):
        total = measured(drive, begin + step / 25, kbps)
    return total


def test_an_operator_that_is_lost_lifts_no_cap() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", kbps=6000, valid_s=1000)
    measured(drive, 0.1, 300, "filling", 100)
    drive.accept("operator_disconnected", t=0.2)
    drive.accept("clock_advanced", t=0.3)
    assert drive.total < 300


def test_an_operator_that_does_not_measure_is_not_capped_forever() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", kbps=6000, valid_s=1000)
    measured(drive, 0.1, 300, "filling", 100)
    drive.accept("control_passed", t=1, operator="another")
    drive.accept("clock_advanced", t=1.5)
    assert drive.total < 300
    drive.accept("clock_advanced", t=4)
    assert drive.total == 6000


def test_all_cameras_off_and_a_stale_prediction() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    for name in NAMES:
        drive.accept("camera_switched", camera=name, on=False)
    measured(drive, 5, 0, "clear")
    drive.accept("camera_switched", camera="front", on=True)
    assert measured_until(drive, 5.1, 12, kbps=3000) > 3000
    assert drive.run.fault is None


def test_trust_in_predictions_concerns_mode_a_only() -> None:
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", kbps=6000, valid_s=1000)
    for t in range(50):
        measured(drive, t / 5, 3000, *(("filling", 60) if t % 6 >= 4 else ()))
    believed = drive.total
    assert believed < 4000
    drive.accept("mode_selected", mode="collective")
    drive.accept("total_set", kbps=2000)
    assert drive.total == 2000


def test_in_mode_s_a_camera_that_is_switched_on_again_is_as_the_operator_has_set_it() -> None:
    drive = single()
    measured(drive, 0.1, 600, "filling", 60)
    drive.accept("camera_switched", camera="front", on=False)
    drive.accept("camera_switched", camera="front", on=True)
    measured_until(drive, 0.2, 20, kbps=3500)
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
    assert str(raised.value).count("must have at least 4 entries") == MAX_ERRORS


# --- silence ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rtt_ms", "silent_s"), [(30, 0.3), (90, 0.3), (200, 0.52), (400, 0.92)])
def test_without_reports_the_total_is_halved_once_per_silent_period_and_recovers_quickly(
    rtt_ms: float, silent_s: float
) -> None:
    """max(300 ms, 2 RTT + 3 report intervals); then half of what arrived before, and x1.5 per RTT + 100 ms."""
    drive = Drive("vehicle=delivery_robot", "modes=safe")
    drive.accept("bitrate_predicted", t=0, kbps=4000, valid_s=60)

    def reported(t: float, kbps: float) -> float:
        drive.accept("link_measured", t=t, kbps=kbps, queue_ms=0, state="clear", rtt_ms=rtt_ms)
        return float(drive.total)

    last = 4.0
    for number in range(101):
        assert reported(number / 25, 4100) == 4000
    totals = {}
    for number in range(1, 200):
        drive.accept("clock_advanced", t=last + number / 100)
        totals[number / 100] = float(drive.total)
    changes = [at for (_, before), (at, after) in pairwise(totals.items()) if after != before]
    assert changes[0] == pytest.approx(silent_s, abs=0.011)
    assert all(b - a >= silent_s - 0.011 for a, b in pairwise(changes)), "once per silent period"
    levels = [4000.0, *(totals[at] for at in changes)]
    assert all(0.42 < after / before < 0.5 for before, after in pairwise(levels[:3])), "headers are not halved"

    began = last + 2.0
    first = reported(began, levels[-1])
    assert 0.42 < first / 4000 <= 0.5
    step_s = 0.1 + rtt_ms / 1000
    times = [began + number / 25 for number in range(1, 100)]
    grown = [(t, total) for t in times if (total := reported(t, float(drive.total))) != first]
    assert grown[0][0] - began <= step_s + 0.05
    assert 1.4 < grown[0][1] / first < 1.6
    assert reported(began + 4, 4100) == 4000
