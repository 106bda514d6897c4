"""Cameras that encode by themselves: the rules take what they send off the total first."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from helpers import Command, Drive

from runner.core.events import StreamMeasured
from runner.core.step import start
from runner.records.vehicle import CameraReading, EncoderCounts
from runner.vehicle.noticed import Streams

REAR = (
    "+source@cameras.rear.source=rtsp",
    "+graph@cameras.rear.graph=pass_through",
    "+cameras.rear.address=rtsp://h/a",
)


def drive(kbps: float, *words: str, sends: float | None = None, modes: str = "paper") -> Drive:
    """A robot whose rear camera encodes by itself, and was measured to send this much; `kbps` are predicted."""
    made = Drive("vehicle=delivery_robot", f"modes={modes}", *REAR, *words)
    if sends is not None:
        made.accept("stream_measured", camera="rear", kbps=sends)
    made.accept("bitrate_predicted", kbps=kbps)
    return made


@pytest.mark.parametrize("modes", ["paper", "safe", "equal"])
def test_it_comes_off_the_total_first(modes: str) -> None:
    """b_full, 1500 kbit/s, is what it is taken to send until it is measured."""
    assert [drive(3000, modes=modes, sends=sends)["rear"].kbps for sends in (None, 800, 2400)] == [1500, 800, 2400]
    for sends in (800, 2400):
        others = [drive(3000, modes=modes, sends=sends)[name].kbps for name in ("front", "mast")]
        assert 3000 - sends - len(others) <= sum(others) <= 3000 - sends


def test_it_is_sent_whole_in_one_size_as_the_camera_encodes_it() -> None:
    for kbps in (2000, 3000, 20000):
        rear = drive(kbps, sends=1234)["rear"]
        assert (rear.scaling, rear.width, rear.height, rear.kbps) == (1, 848, 480, 1234)
        assert rear.reason.startswith("1234 of 1234 kbit/s, as the camera encodes it")


def test_bitrates_below_which_other_sizes_would_be_sent_do_not_concern_it() -> None:
    assert drive(3000, "cameras.rear.rate_quality.b_full_kbps=100")["rear"].kbps == 100


def test_what_does_not_fit_is_said() -> None:
    made = drive(1000, sends=1500)
    assert [made[name].kbps for name in ("front", "rear", "mast")] == [0, 1500, 0]
    assert "cameras that encode by themselves send 1500 of 1000 kbit/s" in made["rear"].reason
    assert "by themselves" not in drive(1500, sends=1500)["rear"].reason


FLOORS = ("++cameras.front.floor_kbps=600", "++cameras.mast.floor_kbps=200")


def test_it_is_given_up_when_the_rest_would_fall_below_their_floors() -> None:
    def sent(kbps: float) -> dict[str, int]:
        made = drive(kbps, *FLOORS, "++cameras.rear.shed=1", sends=1500, modes="safe")
        return {name: made[name].kbps for name in ("front", "rear", "mast")}

    assert sent(2300)["rear"] == 1500
    assert sent(2299) == {"front": 1739, "rear": 0, "mast": 559} or sent(2299)["rear"] == 0


def test_one_that_is_never_given_up_leaves_the_others_what_is_left() -> None:
    made = drive(2000, *FLOORS, sends=1500, modes="safe")
    assert made["rear"].kbps == 1500
    assert made["front"].kbps + made["mast"].kbps <= 500


def test_in_mode_s_too(tod: Command) -> None:
    made = drive(3000, sends=900)
    made.accept("mode_selected", mode="single")
    assert made["rear"].kbps == 900
    made.accept("stream_measured", camera="rear", kbps=1100)
    assert (made["rear"].kbps, made["rear"].reason) == (1100, "1100 kbit/s, as the camera encodes it")


@pytest.mark.parametrize(
    "event, instead",
    [
        ({"event": "camera_configured", "kbps": 500}, "switch it off to send less"),
        ({"event": "roi_set", "x": 0, "y": 0, "width": 400, "height": 200}, "choose the region on the page"),
    ],
)
def test_what_only_the_camera_could_do_is_refused(event: dict[str, Any], instead: str) -> None:
    made = drive(3000)
    made.accept("mode_selected", mode="single")
    refused = made.feed(camera="rear", **event).refused
    assert refused is not None
    assert str(refused) == f"the pictures of rear are sent as the camera encodes them; {instead}"


def test_off_and_on_again() -> None:
    made = drive(3000, sends=900)
    made.accept("camera_switched", camera="rear", on=False)
    assert (made["rear"].kbps, made["front"].kbps + made["mast"].kbps) == (0, 2999)
    made.accept("camera_switched", camera="rear", on=True)
    assert made["rear"].kbps == 900


@pytest.mark.parametrize("graph, source", [("pass_through", "test"), ("pass_through", "appsrc")])
def test_a_source_of_raw_pictures_has_nothing_to_pass_on(tod: Command, graph: str, source: str) -> None:
    result = tod("validate", f"graph={graph}", f"source={source}")
    assert result.status == 2
    assert f"graph/{graph}.yaml: passes: h264: needs a source with `encoded` pictures of this format" in result.err


def test_its_pictures_cannot_be_recorded_raw(tod: Command, tmp_path: Path) -> None:
    result = tod("record", "vehicle=delivery_robot", *REAR, f"output={tmp_path}")
    assert result.status == 2
    assert "graph: rear: these cameras are passed on as they encode; record their raw pictures" in result.err


def test_more_than_is_stated_is_said_and_taken_off_as_measured() -> None:
    made = drive(3000, sends=1800)
    assert "1800 of 1800 kbit/s, as the camera encodes it, more than its b_full of 1500" in made["rear"].reason
    assert made["front"].kbps + made["mast"].kbps <= 1200
    assert "more than" not in drive(3000, sends=1500)["rear"].reason


# --- whose bitrate can be set -----------------------------------------------------------------------------------------

SETTABLE = ("++cameras.rear.graph.lowest_kbps=300",)
COMMAND = "cameras.rear.graph.knobs.bitrate=[{command: [/bin/set, '{kbps}']}]"


def settable(kbps: float, *words: str, sends: float | None = None, modes: str = "paper") -> Drive:
    return drive(kbps, COMMAND, *SETTABLE, *words, sends=sends, modes=modes)


@pytest.mark.parametrize("modes", ["paper", "safe", "equal"])
def test_one_that_can_be_set_shares_with_the_others(modes: str) -> None:
    decoded = Drive("vehicle=delivery_robot", f"modes={modes}")
    decoded.accept("bitrate_predicted", kbps=3000)
    made = settable(3000, modes=modes)
    assert {n: made[n].kbps for n in ("front", "rear", "mast")} == {
        n: decoded[n].kbps for n in ("front", "rear", "mast")
    }
    assert made["rear"].reason.endswith("kbit/s, as the camera is asked to encode it")


@pytest.mark.parametrize("modes", ["paper", "safe", "equal"])
def test_it_gets_no_less_than_it_can_be_set_to(modes: str) -> None:
    made = settable(600, modes=modes)
    assert made["rear"].kbps == 300
    assert 298 <= made["front"].kbps + made["mast"].kbps <= 300
    scarce = settable(200, modes=modes)
    assert [scarce[name].kbps for name in ("front", "rear", "mast")] == [0, 300, 0]
    assert "cameras that encode by themselves send 300 of 200 kbit/s" in scarce["rear"].reason


@pytest.mark.parametrize("modes", ["paper", "safe", "equal"])
def test_one_that_sends_more_than_asked_costs_what_it_sends(modes: str) -> None:
    asked = settable(3000, modes=modes)["rear"].kbps
    made = settable(3000, modes=modes, sends=1400)
    assert made["rear"].kbps == asked < 1400
    assert 1597 <= made["front"].kbps + made["mast"].kbps <= 1600
    assert made["rear"].reason.endswith("as the camera is asked to encode it, but it sends 1400")
    made.accept("stream_measured", camera="rear", kbps=0)
    assert settable(3000, modes=modes)["front"].kbps == made["front"].kbps


def test_it_is_given_up_like_others_with_what_it_sends() -> None:
    words = (*FLOORS, "++cameras.rear.shed=1")
    assert settable(1100, *words, modes="safe")["rear"].kbps >= 300
    assert settable(1099, *words, modes="safe")["rear"].kbps == 0
    assert settable(1899, *words, sends=1100, modes="safe")["rear"].kbps == 0


def test_in_mode_s_its_bitrate_is_the_operators() -> None:
    made = settable(3000)
    made.accept("mode_selected", mode="single")
    made.accept("camera_configured", camera="rear", kbps=700)
    assert (made["rear"].kbps, made["rear"].reason) == (700, "700 kbit/s, as the camera is asked to encode it")
    for event, why in (
        ({"kbps": 299}, "299 kbit/s for rear is outside 300 to 1500, its b_full"),
        ({"scaling": 0.5}, "the pictures of rear are sent as the camera encodes them; set its bitrate"),
    ):
        assert str(made.feed(event="camera_configured", camera="rear", **event).refused) == why


def test_a_lowest_bitrate_above_the_highest_is_refused(tod: Command) -> None:
    result = tod("validate", "vehicle=delivery_robot", *REAR, COMMAND, "++cameras.rear.graph.lowest_kbps=3000")
    assert "cameras.rear.graph.lowest_kbps: 3000: must be at most the b_full_kbps of the camera, 1500" in result.err


def test_a_command_needs_pictures_that_are_passed_on_and_a_place_for_the_value(tod: Command) -> None:
    result = tod("validate", "vehicle=delivery_robot", "graph.knobs.bitrate=[{command: [set, '{kbps}']}]")
    assert "knobs.bitrate: a command sets the bitrate of pictures that are passed on" in result.err
    result = tod("validate", "vehicle=delivery_robot", *REAR, "cameras.rear.graph.knobs.bitrate=[{command: [set]}]")
    assert "one word of the command must have {kbps} or {bps}" in result.err


def test_print_shows_the_command_with_its_value(tod: Command) -> None:
    command = "cameras.rear.graph.knobs.bitrate=[{command: [set, '{address}', '{camera}=', '{bps}']}]"
    result = tod("print", "vehicle=delivery_robot", *REAR, command, "total_kbps=3000")
    assert "# sets the bitrate: set rtsp://h/a rear= 375000" in result.out


V4L2 = (
    "+source@cameras.rear.source=v4l2",
    "+graph@cameras.rear.graph=pass_through_v4l2",
    "+cameras.rear.device=/dev/video9",
    "+cameras.rear.capture={format: h264, controls: {auto_exposure: 1}}",
)


def test_a_v4l2_camera_is_set_by_its_control_and_keeps_the_others(tod: Command) -> None:
    result = tod("print", "vehicle=delivery_robot", *V4L2, "total_kbps=3000")
    assert "extra-controls=controls,auto_exposure=1,video_bitrate=375000" in result.out
    result = tod("validate", "vehicle=delivery_robot", *V4L2, "cameras.rear.source.frozen_s=1")
    assert "source.frozen_s: 1: is of a source that is replaced when it freezes" in result.err


# --- measured ---------------------------------------------------------------------------------------------------------


def measured(*counts: tuple[float, int], known: dict[str, Fraction] | None = None, sending: bool = True) -> list[Any]:
    """What is reported for (time, bytes so far) of a camera."""
    streams, run = Streams({"rear"}), start(drive(3000).vehicle)
    found: list[Any] = []
    for t, size in counts:
        reading = CameraReading(applied={"sending": sending}, encoded=EncoderCounts(0, size))
        for event in streams.events(run, {"rear": reading}, t):
            assert isinstance(event, StreamMeasured)
            found.append((t, int(event.kbps)))
    return found


def test_what_a_camera_sends_is_the_mean_of_some_seconds() -> None:
    counts = [(t / 10, 12_500 * t) for t in range(31)]  # 1000 kbit/s
    assert measured(*counts)[0] == (2.0, 1000)
    assert measured(*counts, sending=False) == []


def test_nothing_that_arrives_is_no_lower_rate() -> None:
    counts = [(t / 10, 12_500 * min(t, 25)) for t in range(100)]
    assert {kbps for t, kbps in measured(*counts) if t < 2.6} <= {1000, 1001}
    assert all(kbps > 0 for _, kbps in measured(*counts))


def over_asked(kbps: int, *asked: tuple[float, int]) -> list[tuple[float, int]]:
    """What is reported of a camera that sends `kbps` and is asked for others from times on."""
    streams, run, found = Streams((), {"rear"}), start(settable(3000).vehicle), list[tuple[float, int]]()
    for t in (tick / 10 for tick in range(300)):
        wanted = [value for since, value in asked if since <= t][-1]
        reading = CameraReading(applied={"sending": True}, encoded=EncoderCounts(0, int(125 * kbps * t)))
        run = replace(run, commanded={"rear": {"bitrate": wanted}})
        for event in streams.events(run, {"rear": reading}, t):
            assert isinstance(event, StreamMeasured)
            run = replace(run, state=replace(run.state, streams={"rear": event.kbps}))
            found.append((round(t), round(event.kbps)))
    return found


def test_a_camera_that_can_be_set_has_time_to_follow() -> None:
    assert over_asked(1000, (0, 1000)) == []
    assert over_asked(1000, (0, 900)) == []
    assert over_asked(1000, (0, 1000), (5, 500)) == [(15, 1000)]
    assert over_asked(1000, (0, 500), (20, 1000)) == [(2, 1000), (20, 0)]
