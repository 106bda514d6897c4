"""A decoder starts with the grey picture, and shows the true one after two refresh periods."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest

from runner.h264.access_unit import RecentUnits, read_unit
from runner.h264.damage import Damage
from runner.h264.keyframe import grey_idr

pytestmark = pytest.mark.gst


def encoded(width, height, *options, size=None):
    """Two seconds of x264 with refresh waves of half a second, as access units."""
    source = f"testsrc2=size={width}x{height}:rate=20:duration=2"
    settings = "intra-refresh=1:keyint=10:bframes=0:ref=1:repeat-headers=1:aud=1"
    command = ["ffmpeg", "-v", "error", "-f", "lavfi", "-i", source, "-pix_fmt", "yuv420p", "-c:v", "libx264"]
    command += ["-tune", "zerolatency", "-x264-params", settings, *options, "-f", "h264", "-"]
    data = subprocess.run(command, capture_output=True, check=True).stdout
    aud = b"\0\0\0\1\x09"
    return [aud + unit for unit in data.split(aud)[1:]]


def decoded(units, width, height):
    command = ["ffmpeg", "-v", "error", "-threads", "1", "-f", "h264", "-i", "-", "-fps_mode", "passthrough"]
    done = subprocess.run(
        [*command, "-f", "rawvideo", "-pix_fmt", "yuv420p", "-"],
        input=b"".join(units),
        capture_output=True,
        check=False,
    )
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, height * 3 // 2, width), done.stderr.decode()


@pytest.mark.parametrize("profile", ["baseline", "main", "high"])
@pytest.mark.parametrize(("width", "height"), [(480, 260), (64, 48), pytest.param(1922, 1042, marks=pytest.mark.soak)])
def test_a_grey_picture_starts_a_decoder_and_waves_make_it_exact(width, height, profile):
    units = encoded(width, height, "-profile:v", profile)
    whole, _ = decoded(units, width, height)
    join = next(n for n in range(5, 40) if b"\0\0\1\x67" in units[n])
    grey = grey_idr(units[join])
    assert read_unit(grey, None, 0).key
    alone, errors = decoded([grey], width, height)
    assert errors == ""
    assert (alone == 128).all()
    late, _ = decoded([grey, *units[join:]], width, height)
    assert len(late) == 1 + len(units) - join
    assert (late[-10:] == whole[-10:]).all()


def test_the_burst_for_a_late_viewer_is_exact_although_shorter_than_two_periods():
    recent, whole = RecentUnits(refresh_s=0.5), encoded(480, 260)
    pictures, _ = decoded(whole, 480, 260)
    lengths = []
    for number, data in enumerate(whole):
        recent.add(read_unit(data, None, number / 20))
        burst = [unit.data for unit in recent.burst()]
        lengths.append(len(burst))
        if number % 7 == 0:
            late, _ = decoded(burst, 480, 260)
            assert (late[-1] == pictures[number]).all(), number
    assert max(lengths[20:]) <= 21
    assert sum(lengths[20:]) / 20 < 18


def test_data_without_a_parameter_set_makes_no_picture():
    assert grey_idr(b"") is None
    assert grey_idr(b"\0\0\0\1\x41\x9a") is None
    assert grey_idr(b"\0\0\0\1\x67") is None
    _, high444 = encoded(64, 48), encoded(64, 48, "-pix_fmt", "yuv444p")
    assert grey_idr(high444[0]) is None


@pytest.mark.parametrize("lost", [[13], [3, 17], [10, 11, 12]])
def test_a_picture_that_is_not_marked_as_damaged_is_exact(lost):
    """Whatever the error concealment of a decoder."""
    units = encoded(480, 260)
    whole, _ = decoded(units, 480, 260)
    came = [number for number in range(len(units)) if number not in lost]
    pictures, _ = decoded([units[number] for number in came], 480, 260)
    damage = Damage("h264")
    marked = {number: damage.add(number - 1 in lost, lambda n=number: units[n]) for number in came}
    after = [number for number in came if number > lost[-1]]
    exact = {n: bool((pictures[n - len(units)] == whole[n]).all()) for n in after}  # counted from the end
    assert not any(not exact[number] and not marked[number] for number in after)
    assert not exact[after[0]]
    assert not marked[after[-1]]
    assert sum(marked[number] for number in after) <= 20  # two waves
