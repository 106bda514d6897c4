"""A source's rate is held, and no burst passes after a gap in the times of its pictures."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from fractions import Fraction

import pytest

pytestmark = pytest.mark.gst

LOOK_S = 0.02
CAPS = "video/x-raw,format=I420,width=16,height=16,framerate={}"


def passed(pictures: Iterable[tuple[float, float]], fps: str = "10/1", above: str = "videoscale") -> list[float]:
    """When pictures pass a videorate that holds a rate, looked at 50 times a second.

    pictures  when each arrives, and its own time, s
    above     the element in front of it
    """
    from runner.gst import Gst
    from runner.gst.rate_limit import RateLimits

    caps = CAPS.format("40/1")
    line = (
        f"( appsrc name=source format=time caps={caps} ! {above} ! videorate drop-only=true skip-to-first=true"
        f" ! {CAPS.format(fps)} ! appsink name=sink sync=false )"
    )
    pipeline = Gst.parse_launch(line)
    source, sink = map(pipeline.get_by_name, ("source", "sink"))
    rate = next(each for each in pipeline.children if each.get_factory().get_name() == "videorate")
    limits = RateLimits(float(Fraction(fps)))
    limits.follow(pipeline)
    pipeline.set_state(Gst.State.PLAYING)
    came, looked, count = [], 0.0, 0
    for number, (arrives, time) in enumerate(pictures, 1):
        while looked + LOOK_S <= arrives:
            looked += LOOK_S
            limits.look(looked)
        buffer = Gst.Buffer.new_wrapped(bytes(16 * 16 * 3 // 2))
        buffer.pts = round((100 + time) * Gst.SECOND)
        source.emit("push-buffer", buffer)
        _wait(lambda number=number: rate.get_property("in") == number)
        if rate.get_property("out") > count:
            count += 1
            came.append(arrives)
    assert rate.get_property("out") == count
    pipeline.set_state(Gst.State.NULL)
    assert sink
    return came


def _wait(done: Callable[[], bool]) -> None:
    from time import monotonic, sleep

    end = monotonic() + 5
    while not done():
        assert monotonic() < end
        sleep(0.0002)


def camera(seconds: float, hz: float = 40.0, begins: float = 0.0, shift: float = 0.0) -> list[tuple[float, float]]:
    """Pictures of a camera: when they arrive, and their times, by `shift` ahead."""
    return [(begins + n / hz, begins + n / hz + shift) for n in range(int(seconds * hz))]


GAPS = {
    "nothing comes": [*camera(1), *camera(2, begins=4)],
    "its clock jumps ahead": [*camera(1), *camera(2, begins=1, shift=30)],
    "its clock goes back": [*camera(1), *camera(2, begins=1, shift=-30)],
    "it was slower before": [*camera(6, 5), *camera(2, begins=6)],
}


@pytest.mark.parametrize("above", ["videoscale", "decodebin"])  # the latter is linked once it has a pad
@pytest.mark.parametrize("pictures", GAPS.values(), ids=GAPS)
def test_after_a_gap_no_second_has_more_pictures_than_the_rate(pictures, above):
    came = passed(pictures, above=above)
    busiest = max(sum(begin <= at < begin + 1 for at in came) for begin in came)
    assert busiest <= 12, came
    last = pictures[-1][0]
    assert sum(last - 1 < at for at in came) in (9, 10), came  # and it goes on at its rate


def test_a_camera_at_its_rate_loses_nothing_although_its_pictures_come_unevenly():
    chance = random.Random(1)
    times = [n / 40 for n in range(400)]
    pictures = [(time + chance.uniform(0, 0.015), time + chance.uniform(-0.004, 0.004)) for time in times]
    assert len(passed(pictures, "40/1")) >= 398
