"""Glass-to-glass latency, read by the page from the picture of a counter, agrees with the reported latency."""

import re
import signal
from pathlib import Path

import pytest
from helpers import Command

from browser import measure, opened
from rig import ROBOT, answers, free_port, needs_browser, process, until
from runner.page.counter import CounterReading, counter_reading, glass_to_glass

pytestmark = [pytest.mark.gst, needs_browser]
RESULT = re.compile(
    r"rear: counter read in (\d+) of (\d+) pictures\n"
    r"  glass to glass +(\d+) ms median, \d+ ms p95\n"
    r"  capture to drawing +(\d+) ± (\d+) ms, as the page states it\n"
    r"  camera and screen +(-?\d+) ± \d+ ms, the difference; no camera or screen in between\n"
)


@pytest.mark.parametrize("graph", ["h264_rtsp", pytest.param("h264_srt", marks=pytest.mark.soak)])
def test_the_reported_latency_matches_a_counter_in_the_picture(chromium, tmp_path: Path, graph: str) -> None:
    port = free_port()
    transport = (f"graph={graph}", f"media.port={free_port()}", f"graph.first_port={free_port(3)}")
    words = (*ROBOT, f"page.port={port}", *transport)
    output, own = tmp_path / "output", ("camera=rear", "loop=true", "duration_s=5", f"control.port={free_port()}")
    with output.open("w") as file, process("latency", *own, *words, stdout=file.fileno()) as measuring:
        until(lambda: answers(port))
        assert measuring.poll() is None, output.read_text()
        with opened(chromium, f"http://127.0.0.1:{port}/#counter=rear"):
            assert measuring.wait(timeout=60) == 0, output.read_text()
    found = RESULT.search(output.read_text())
    assert found, output.read_text()
    read, pictures, light, stated, bound, camera_and_screen = map(int, found.groups())
    assert read > 0.8 * pictures > 8
    assert abs(light - stated - camera_and_screen) <= 1
    assert abs(camera_and_screen) <= bound + 10, "nothing is between the counter and its capture"


def test_a_counter_that_is_not_in_the_picture_is_an_error(chromium) -> None:
    port, control = free_port(), free_port()
    words = (*ROBOT, f"page.port={port}", f"media.port={free_port()}")
    with process(
        "latency", "camera=front", "loop=true", *words, f"control.port={control}", "cameras.front.width_px=64"
    ) as measuring:
        until(lambda: answers(port))
        with opened(chromium, f"http://127.0.0.1:{port}/#counter=front") as page:
            until(lambda: measure(page)["front"]["drawn"] > 5)
        measuring.send_signal(signal.SIGINT)
        assert measuring.wait(timeout=30) in (1, 130)  # 130 if a busy machine is slow to end it
        assert "must be sharp, upright, whole, and at least 130 px wide in the picture" in measuring.stdout.read()


@pytest.mark.parametrize(
    ("words", "error"),
    [
        ([], "camera: must be given: one of front, rear, mast"),
        (["camera=raer"], "camera: 'raer': unknown camera, did you mean rear?"),
        (["camera=rear", "loop=yes"], "loop: 'yes': must be one of false, true"),
    ],
)
def test_mistakes_are_explained(tod: Command, words: list[str], error: str) -> None:
    result = tod("latency", "vehicle=delivery_robot", *words)
    assert (result.status, result.err) == (2, f"command line: {error}\n")


def readings(elapsed: list[float | None], age: float | None = 40.0) -> list[CounterReading]:
    return [CounterReading("rear", ms, age, None if age is None else 2.0) for ms in elapsed]


def test_the_fixed_part_is_the_difference_to_the_reported_latency() -> None:
    """Camera and screen add 50 ms to the 40 of which the page knows; the vehicle knows of 25 of those."""
    found = glass_to_glass(readings([*[90.0] * 18, 130.0, None]), [25.0, 20.0, 30.0])
    assert found
    assert (found.pictures, found.read, found.median, found.stated, found.bound) == (20, 19, 90.0, 40.0, 2.0)
    assert (found.camera_and_screen, found.fixed) == (50.0, 65.0)
    assert 90 <= found.p95 <= 130


def test_few_readings_say_nothing_and_misread_ones_do_not_count() -> None:
    assert glass_to_glass(readings([90.0] * 9 + [200_000.0]), []) is None
    found = glass_to_glass(readings([90.0] * 10, age=None), [])
    assert found
    assert (found.stated, found.bound, found.camera_and_screen, found.fixed) == (None, None, None, None)


@pytest.mark.parametrize(
    "message",
    [
        {},
        {"camera": 1, "elapsed_ms": 1, "age_ms": 1, "bound_ms": 1},
        {"camera": "rear", "elapsed_ms": "1", "age_ms": 1, "bound_ms": 1},
        {"camera": "rear", "elapsed_ms": True, "age_ms": 1, "bound_ms": 1},
    ],
)
def test_messages_that_are_not_a_reading(message: dict[str, object]) -> None:
    assert counter_reading(message) is None
