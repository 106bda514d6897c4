"""Eq. (4): the factor of a bitrate, and the size of the picture that follows from it."""

from __future__ import annotations

from fractions import Fraction

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from runner.core.model import ModelError, RateQualityModel, Roi
from runner.core.scaling import as_full_image, output_size, select_scaling

FULL = Roi(0, 0, 1920, 1040)


def model(scaling: str = "0.125 0.25 0.5", b_min: str = "0 300 950", b_full: str = "6000") -> RateQualityModel:
    factors, bounds = (tuple(map(Fraction, numbers.split())) for numbers in (scaling, b_min))
    return RateQualityModel(factors, bounds, Fraction(b_full))


SIDE = model()

bitrates = st.fractions(0, 20_000, max_denominator=1000)
sides = st.integers(16, 4000)
rois = st.builds(Roi, st.just(0), st.just(0), sides, sides)
factors = st.fractions(Fraction(1, 100), 1, max_denominator=1000)


@pytest.mark.parametrize(
    "bitrate, factor",
    [
        ("0", "0.125"),
        ("299.999", "0.125"),
        ("300", "0.25"),  # a bound belongs to the upper range
        ("949.999", "0.25"),
        ("950", "0.5"),
        ("6000", "0.5"),
        ("99999", "0.5"),  # the last range has no upper end
    ],
)
def test_a_bound_belongs_to_the_upper_range(bitrate: str, factor: str) -> None:
    assert select_scaling(SIDE, Fraction(bitrate))[0] == Fraction(factor)


@given(bitrates, bitrates)
def test_more_bitrate_never_lowers_the_factor(a: Fraction, b: Fraction) -> None:
    assert select_scaling(SIDE, min(a, b))[0] <= select_scaling(SIDE, max(a, b))[0]


@given(bitrates)
def test_the_range_contains_the_bitrate(bitrate: Fraction) -> None:
    r = SIDE.scaling.index(select_scaling(SIDE, bitrate)[0])
    bounds = (*SIDE.b_min, Fraction(10**9))
    assert bounds[r] <= bitrate < bounds[r + 1]


def test_ranges_as_people_read_them() -> None:
    ranges = list(model(b_min="0 0.5 950").ranges)
    assert [text.partition(" -> ")[0] for text in ranges] == ["range [0, 0.5)", "range [0.5, 950)", "range [950, ...)"]


@given(bitrates, st.builds(Roi, st.just(0), st.just(0), st.integers(16, 1920), st.integers(16, 1040)))
def test_an_roi_is_compared_at_equal_bits_per_pixel(bitrate: Fraction, roi: Roi) -> None:
    same_density = bitrate * roi.pixels / FULL.pixels
    assert as_full_image(same_density, roi, FULL) == bitrate
    assert as_full_image(bitrate, roi, FULL) >= bitrate


@pytest.mark.parametrize(
    "width, height, factor, size",
    [
        (1920, 1040, "0.5", (960, 520)),
        (1920, 1040, "0.25", (480, 260)),
        (1920, 1040, "0.125", (240, 130)),
        (1920, 1200, "0.125", (240, 150)),
        (1280, 800, "0.375", (480, 300)),
        (1001, 999, "1", (1002, 1000)),  # ties go up
        (100, 100, "0.33", (34, 34)),  # 33 lies between 32 and 34
        (100, 100, "0.329", (32, 32)),
        (16, 16, "0.125", (16, 16)),  # never below 16
        (320, 16, "0.5", (320, 16)),  # both sides by the factor of the shorter one
        (1920, 64, "0.125", (480, 16)),
        (1920, 120, "0.125", (240, 16)),  # 15 rounds to 16, nothing to correct
        (17, 16, "1", (18, 16)),
    ],
)
def test_output_size(width: int, height: int, factor: str, size: tuple[int, int]) -> None:
    assert output_size(Roi(0, 0, width, height), Fraction(factor)) == size


@given(rois, factors)
def test_sizes_are_even_not_below_16_and_keep_the_aspect(roi: Roi, factor: Fraction) -> None:
    width, height = output_size(roi, factor)
    assert width % 2 == height % 2 == 0
    assert min(width, height) >= 16
    assume(factor * min(roi.width, roi.height) >= 15)
    assert abs(width - roi.width * factor) <= 1
    assert abs(height - roi.height * factor) <= 1


@given(rois, factors)
def test_both_sides_are_corrected_together(roi: Roi, factor: Fraction) -> None:
    assume(factor * min(roi.width, roi.height) < 15)
    width, height = output_size(roi, factor)
    assert min(width, height) == 16
    assert abs(max(width, height) - Fraction(16 * max(roi.width, roi.height), min(roi.width, roi.height))) <= 1


@pytest.mark.parametrize(
    "parts, message",
    [
        (("", "", "1"), "scaling: []: must have at least one factor"),
        (("0.5 1", "0", "1"), "b_min_kbps: [0]: must have 2 entries, one per scaling factor"),
        (("1", "0 10", "20"), "b_min_kbps: [0, 10]: must have 1 entries, one per scaling factor"),
        (("0.5 0.25", "0 10", "20"), "scaling: [0.5, 0.25]: must be strictly increasing"),
        (("0.5 0.5", "0 10", "20"), "scaling: [0.5, 0.5]: must be strictly increasing"),
        (("0 0.5", "0 10", "20"), "scaling: [0, 0.5]: must lie in ]0, 1]"),
        (("0.5 1.5", "0 10", "20"), "scaling: [0.5, 1.5]: must lie in ]0, 1]"),
        (("0.5 1", "1 10", "20"), "b_min_kbps: [1, 10]: must start at 0 and be strictly increasing"),
        (("0.5 1", "0 0", "20"), "b_min_kbps: [0, 0]: must start at 0 and be strictly increasing"),
        (("0.5 1", "0 10", "10"), "b_full_kbps: 10: must be above the last b_min, 10"),
    ],
)
def test_a_model_is_valid_once_built(parts: tuple[str, str, str], message: str) -> None:
    with pytest.raises(ModelError) as refused:
        model(*parts)
    assert str(refused.value) == message


@pytest.mark.parametrize(
    "bitrate, factor", [("299.9", "0.125"), ("300.5", "0.25"), ("950.24", "0.25"), ("950.25", "0.5")]
)
def test_bounds_need_not_be_whole(bitrate: str, factor: str) -> None:
    assert select_scaling(model(b_min="0 300.5 950.25"), Fraction(bitrate))[0] == Fraction(factor)
