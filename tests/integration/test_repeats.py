"""A source that repeats its last picture as new is recognised by its content."""

import time
from itertools import count

import numpy as np

from rig import SMALL_ROBOT, faults, streaming, until, watching

SHAPE = (240 * 3 // 2, 424)  # I420
WORDS = (*SMALL_ROBOT, "source=appsrc", "+source.repeated_s=1")
FAULT = "source: repeats the same picture"


def play(side, picture, done, seconds=20):
    """Push pictures at 20 Hz, and look at the source as often as a vehicle does, until something has happened."""
    numbers = count()

    def next_picture():
        number = next(numbers)
        side.push("rear", picture(number))
        if number % 4 == 0:
            side.stages()
        return done()

    until(next_picture, seconds, every_s=0.05)


def passed(seconds):
    end = time.monotonic() + seconds
    return lambda: time.monotonic() > end


def dark(number):
    """What a sensor delivers in a dark garage: nothing but noise."""
    return np.random.default_rng(number).integers(16, 18, SHAPE, dtype=np.uint8)


def test_a_source_that_repeats_a_picture_is_at_fault_until_its_pictures_change():
    with streaming(*WORDS, cameras=("rear",)) as (side, _, (plan,), reported), watching(plan) as client:
        play(side, dark, lambda: len(client.sizes) > 5)
        play(side, dark, passed(2))
        assert side.read()["rear"].fault is None
        still = dark(1)
        began = time.monotonic()
        play(side, lambda number: still, lambda: side.read()["rear"].fault)
        assert side.read()["rear"].fault == FAULT
        assert time.monotonic() - began >= 1
        play(side, dark, lambda: side.read()["rear"].fault is None)
    _, works, *_ = faults(reported[reported.index(f"rear: {FAULT}") :])
    assert works.startswith("rear: works again after ")


def test_a_rare_picture_is_not_mistaken_for_a_repeated_one():
    """Until it has been seen several times."""
    with streaming(*WORDS, cameras=("rear",)) as (side, _, (plan,), _reported), watching(plan) as client:
        play(side, dark, lambda: len(client.sizes) > 5)
        still = dark(1)
        for _ in range(3):
            side.push("rear", still)
            side.stages()
            time.sleep(0.6)
        assert side.read()["rear"].fault is None


def test_pictures_are_not_compared_where_a_still_scene_gives_identical_ones():
    """Of decoded or generated pictures, by default: a scene that stands still is not a camera that hangs."""
    words = (*SMALL_ROBOT, "source=appsrc")
    with streaming(*words, cameras=("rear",)) as (side, _, (plan,), _reported), watching(plan) as client:
        still = dark(1)
        play(side, lambda number: still, lambda: len(client.sizes) > 5)
        play(side, lambda number: still, passed(2))
        assert side.read()["rear"].fault is None
