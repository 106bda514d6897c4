"""Freezes of hand-made arrivals, percentiles, shares of time, quality between measured points."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from drives import write_drive, write_model

from runner.drive.camera_series import CameraSeries, DecidedSeries, ReceivedSeries, Sent
from runner.drive.latency import Freeze, Latency, freezes, latency, per_second
from runner.drive.read import read_drive
from runner.drive.series import series
from runner.drive.statistics import (
    CameraStatistics,
    Model,
    RateCurve,
    camera_statistics,
    estimate,
    rate_curves,
    slow_time,
    statistics,
)
from runner.drive.tables import camera_rows
from runner.rate_quality.artefact import read_model
from runner.rate_quality.curves import Point, draw_curves, mean_score

pytestmark = pytest.mark.slow  # reads whole drives

NAN = float("nan")
ALWAYS = [(0.0, 1000.0)]


def arrivals(*gaps: float, first: float = 0.0) -> np.ndarray:
    return first + np.concatenate([[0.0], np.cumsum(gaps)])


# --- freezes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "gap_s, long_s, frozen",
    [
        (0.025, 0.174, False),  # 40 Hz: mean + 150 ms = 175 ms is the larger
        (0.025, 0.175, True),
        (0.025, 0.080, False),  # 3 * mean alone is not enough
        (0.1, 0.299, False),  # 10 Hz: 3 * mean = 300 ms is the larger
        (0.1, 0.301, True),
    ],
)
def test_a_gap_freezes_from_the_larger_of_both_bounds_on(gap_s: float, long_s: float, frozen: bool) -> None:
    arrived = arrivals(*[gap_s] * 40, long_s, *[gap_s] * 5)
    found = freezes(arrived, [(0.0, float(arrived[-1]))])
    assert found == ([(pytest.approx(40 * gap_s), pytest.approx(long_s))] if frozen else [])


def test_the_mean_is_of_the_last_30_gaps() -> None:
    # After 30 gaps of 25 ms, the 200 ms before them are forgotten and 175 ms is a freeze again; not so after 29.
    for since, frozen in ((30, True), (29, False)):
        arrived = arrivals(*[0.2] * 40, *[0.025] * since, 0.176, 0.025)
        assert bool(freezes(arrived, [(0.0, float(arrived[-1]))])) is frozen


def test_a_freeze_is_part_of_later_means() -> None:
    arrived = arrivals(*[0.025] * 40, 6.0, 0.3, 0.025)
    # The mean is then (29 * 25 + 6000) / 30 = 224 ms: 300 ms is no freeze any more.
    assert freezes(arrived, [(0.0, float(arrived[-1]))]) == [(pytest.approx(1.0), pytest.approx(6.0))]


def test_no_freeze_is_judged_by_fewer_than_five_gaps() -> None:
    assert freezes(arrivals(*[0.025] * 4, 1.0, 0.025), [(0.0, 1.125)]) == []
    assert len(freezes(arrivals(*[0.025] * 5, 1.0, 0.025), [(0.0, 1.15)])) == 1
    assert freezes(np.empty(0), [(0.0, 1.9)]) == []


def test_a_stream_that_never_starts_or_stops_early_freezes() -> None:
    assert freezes(np.empty(0), [(0.0, 50.0), (60.0, 100.0)]) == [Freeze(0.0, 50.0), Freeze(60.0, 40.0)]
    assert freezes(arrivals(*[0.025] * 40, first=9.0), [(0.0, 10.0)]) == [Freeze(0.0, 9.0)]
    assert freezes(arrivals(*[0.025] * 40, first=1.9), [(0.0, 2.9)]) == []
    assert freezes(arrivals(0.025, 0.025), [(0.0, 10.0)])[-1].seconds == pytest.approx(9.95, abs=0.1)


def test_a_camera_that_is_not_sent_does_not_freeze() -> None:
    arrived = np.concatenate([arrivals(*[0.025] * 40), arrivals(*[0.025] * 40, first=11.0)])
    assert freezes(arrived, [(0.0, 12.0)]) == [Freeze(pytest.approx(1.0), pytest.approx(10.0))]
    assert freezes(arrived, [(0.0, 1.01), (11.0, 12.0)]) == []


def test_a_stream_that_stops_for_good_is_frozen_to_the_end_of_the_span() -> None:
    arrived = arrivals(*[0.025] * 40)
    assert freezes(arrived, [(0.0, 5.0)]) == [Freeze(pytest.approx(1.0), pytest.approx(4.0))]
    assert freezes(arrived, [(0.0, 1.1)]) == []


def test_freezes_of_a_drive(tmp_path: Path) -> None:
    path = write_drive(tmp_path / "drive", seconds=20, freezes={"top_rear": [(6.0, 1.5)], "front_left": [(9, 0.5)]})
    found = statistics(series(read_drive(path)))
    by_camera = {name: camera.freezes for name, camera in found.cameras.items()}
    for name, at, seconds in (("top_rear", 6.0, 1.5), ("front_left", 9.0, 0.5)):
        frozen = by_camera.pop(name)
        assert frozen == (Freeze(pytest.approx(at, abs=0.1), pytest.approx(seconds, abs=0.15)),)
    assert set(by_camera.values()) == {()}
    assert found.freezes == 2
    assert found.frozen_s == pytest.approx(2.0, abs=0.3)


# --- latency ----------------------------------------------------------------------------------------------------------


def test_percentiles_interpolate_and_leave_out_what_is_unknown() -> None:
    assert latency(np.array([NAN, *range(101)])) == Latency(50, 95, 99)
    assert latency(np.array([10.0, 20.0])) == Latency(15, 19.5, pytest.approx(19.9))
    assert all(np.isnan(latency(np.array([NAN]))))


def test_latency_of_each_second_is_over_all_cameras(tmp_path: Path) -> None:
    drive = series(read_drive(write_drive(tmp_path / "drive", seconds=10)))
    seconds = per_second(drive)
    np.testing.assert_array_equal(seconds.t, np.arange(10))
    received = [c.received for c in drive.cameras.values() if c.received]
    third = np.concatenate([r.arrival_ms[(r.arrival_t >= 3) & (r.arrival_t < 4)] for r in received])
    assert seconds.median[3] == pytest.approx(np.median(third))
    assert seconds.p95[3] == pytest.approx(np.percentile(third, 95))


# --- means and shares -------------------------------------------------------------------------------------------------


def test_a_drive_with_both_sides(tmp_path: Path) -> None:
    found = statistics(series(read_drive(write_drive(tmp_path / "drive", seconds=30))))
    assert found.share == pytest.approx(1.0, abs=0.05)
    assert found.lost == sum(camera.lost or 0 for camera in found.cameras.values())
    front, top = found.cameras["front_left"], found.cameras["top_left"]
    assert front.hz == pytest.approx(40, rel=0.02)
    assert top.hz == pytest.approx(30, rel=0.02)
    for camera in (front, top):
        assert sum(camera.factors.values()) == pytest.approx(1)
        assert sum(camera.sizes.values()) == pytest.approx(1, abs=0.02)
    assert set(front.factors) == {0.25, 0.5}
    assert front.arrival.median < front.decode.median


def test_sizes_are_listed_in_the_order_of_their_factors(tmp_path: Path) -> None:
    camera = statistics(series(read_drive(write_drive(tmp_path / "drive", seconds=5)))).cameras["front_left"]
    reordered = replace(camera, factors={0.25: 0.2, 0.5: 0.8}, sizes={(960, 540): 0.8, (480, 270): 0.2})
    headings, (row,) = camera_rows(SimpleNamespace(metric=None, cameras={"front": reordered}))
    assert row[headings.index("factor: time")] == "0.25: 20%\n0.5: 80%"
    assert row[headings.index("sizes px")] == "480x270\n960x540"


def test_a_vehicle_alone_has_no_latency_and_no_losses(tmp_path: Path) -> None:
    found = statistics(series(read_drive(write_drive(tmp_path / "drive", ["vehicle"], seconds=20))))
    assert (found.freezes, found.lost, found.frozen_s) == (None, None, None)
    assert np.isnan(found.arrival.median)
    assert np.isnan(found.decode.median)
    assert found.share == pytest.approx(1.0, abs=0.05)
    assert found.cameras["front_left"].hz == pytest.approx(40, rel=0.02)


@pytest.mark.parametrize(("hz", "expected"), [(10, (18, 10)), (27, (18, 27)), (29, None), (40, None)])
def test_a_report_says_for_how_long_a_camera_was_slow(hz: float, expected: tuple[float, float] | None) -> None:
    t = np.arange(0, 20.2, 0.2)
    sent = Sent(t, np.floor(t * hz + 1e-6), t, t)
    found = slow_time(replace(camera(400, 0.5), sent=sent, fps=40.0), 20.0)
    assert found == (expected and pytest.approx(expected, rel=0.05))


def test_a_camera_is_not_slow_while_rules_send_fewer_of_its_pictures() -> None:
    t = np.arange(0, 20.2, 0.2)
    sent = Sent(t, np.floor(t * 10 + 1e-6), t, t)
    fewer = camera(400, 0.5)
    fewer = replace(fewer, sent=sent, fps=40.0, decided=replace(fewer.decided, fps=np.array([10.0])))
    assert slow_time(fewer, 20.0) is None


# --- quality ----------------------------------------------------------------------------------------------------------

MODEL = Model("mssim", {0.5: RateCurve(np.array([100.0, 400.0]), np.array([0.6, 0.8]))})


def camera(kbps: float, scaling: float, *, sending: bool = True, share: float = 1.0) -> CameraSeries:
    def column(value: float) -> np.ndarray:
        return np.array([value], dtype=float)

    flag, t = np.array([sending]), np.array([1.0])
    decided = DecidedSeries(
        column(0), flag, column(kbps), column(scaling), column(2), column(2), column(share), ("",), column(np.nan)
    )
    return CameraSeries("one", decided, None, Sent(t, column(1), column(1), column(kbps)))


@pytest.mark.parametrize(
    "kbps, scaling, share, quality, clamped",
    [
        (100, 0.5, 1, 0.6, 0),
        (200, 0.5, 1, 0.7, 0),  # half way in log bitrate
        (400, 0.5, 1, 0.8, 0),
        (100, 0.5, 0.5, 0.7, 0),  # for half the picture: like 200 for all of it
        (50, 0.5, 1, 0.6, 1),
        (900, 0.5, 1, 0.8, 1),
    ],
)
def test_quality_between_measured_points(
    kbps: float, scaling: float, share: float, quality: float, clamped: float
) -> None:
    found = estimate(camera(kbps, scaling, share=share), MODEL)
    assert (found.mean, found.clamped) == (pytest.approx(quality), clamped)


def test_quality_is_read_from_the_curve_that_model_draws() -> None:
    """Of bent points; two of them, where the encoder cannot use more, are at the same bitrate."""
    rates, scores = (100, 200, 400, 800), (0.6, 0.8, 0.85, 0.86)
    points = [Point(Fraction(1, 2), r, r, r, 1.0, {"mssim": (s,)}) for r, s in zip(rates, scores, strict=True)]
    curves = draw_curves(points, mean_score("mssim"))
    document = {
        "metric": "mssim",
        "points": [
            {"scaling": 0.5, "actual_kbps": float(r), "mssim": s}
            for r, s in (*zip(rates[:3], scores[:3], strict=True), (800.0, 0.855), (800.0, 0.865))
        ],
    }
    for index in (60, 200, 333):
        found = estimate(camera(float(curves.kbps[index]), 0.5), rate_curves(document))
        assert found.mean == pytest.approx(curves.quality[Fraction(1, 2)][index], abs=1e-9)


def interrupted(begin: float, end: float, kbps: float = 400, seconds: float = 25) -> CameraSeries:
    """A camera at 10 Hz with a gap in its arrivals; rates over a second, as the operator measures them."""
    every = np.arange(1, 10 * seconds + 1) / 10
    arrived = every[(every <= begin) | (every > end)]
    t = np.arange(1, 4 * seconds + 1) / 4
    frames = np.searchsorted(arrived, t, "right").astype(float)
    rates = np.where(t < 1, NAN, (frames - np.searchsorted(arrived, t - 1, "right")) * kbps / 10)
    zero, size, latency = np.zeros(t.shape), np.full(t.shape, 2.0), np.full(arrived.shape, 50.0)
    received = ReceivedSeries(
        t, rates, size, size, size, size, frames, frames * kbps * 12.5, zero, zero, zero, arrived, latency
    )
    decided = camera(kbps, 0.5).decided
    return CameraSeries("one", decided, received, None)


def test_a_frozen_picture_keeps_its_quality_and_its_share_of_the_time_is_reported() -> None:
    found = camera_statistics(interrupted(10, 20), 25.0, MODEL)
    assert found.quality is not None
    assert found.frozen == pytest.approx(10 / 25, abs=0.02)
    assert found.quality.moving == pytest.approx(0.8)
    assert found.quality.mean == pytest.approx(0.8)  # an upper bound, reached if nothing moved meanwhile
    t, quality = found.quality.line
    assert np.isfinite(quality[(t > 10) & (t <= 20)]).all()
    assert np.isnan(quality[(t > 20.1) & (t < 21)]).all()  # the second behind this rate includes part of the freeze
    (column,) = [row for row in zip(*table_of(found), strict=True) if row[0].endswith("frozen")]
    assert column[1] in ("40%", "41%")


def test_a_frozen_share_counts_the_quality_before_it_and_not_the_mean() -> None:
    """Poor pictures, then none, then good ones: during the gap the last poor one was on screen."""
    series = interrupted(10, 20)
    assert series.received is not None
    rates = np.where(series.received.t <= 10.5, series.received.kbps / 4, series.received.kbps)
    found = estimate(replace(series, received=replace(series.received, kbps=rates)), MODEL, (Freeze(10.0, 10.1),))
    t, quality = found.line
    assert quality[(t > 10.5) & (t <= 20)] == pytest.approx(0.6)
    assert quality[t > 21.1] == pytest.approx(0.8)
    assert found.mean < found.moving


def test_a_camera_without_arrivals_has_no_quality() -> None:
    found = estimate(interrupted(0, 25), MODEL, (Freeze(0.0, 25.0),))
    assert np.isnan(found.mean)


def table_of(found: CameraStatistics) -> tuple[tuple[str, ...], tuple[str, ...]]:
    headings, (row,) = camera_rows(SimpleNamespace(metric="mssim", cameras={"one": found}))
    return headings, row


def test_no_quality_without_a_picture_or_a_curve() -> None:
    assert np.isnan(estimate(camera(0, 0.5), MODEL).mean)
    assert np.isnan(estimate(camera(200, 0.5, sending=False), MODEL).mean)
    other = estimate(camera(200, 0.25), MODEL)
    assert np.isnan(other.mean)
    assert other.unknown == (0.25,)


def test_curves_of_a_model_file_are_over_what_came_out_of_the_encoder(tmp_path: Path) -> None:
    model = rate_curves(read_model(write_model(tmp_path / "one.model.json", "one", [0.25, 0.5], 3000)))
    assert (model.metric, list(model.curves)) == ("mssim", [0.25, 0.5])
    assert model.curves[0.5].kbps[0] == pytest.approx(50 * 0.97)
    assert (np.diff(model.curves[0.5].quality) > 0).all()
