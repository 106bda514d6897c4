"""Quality of what the driver saw: measured on a real drive of which only what a view shows was sent."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import shared_cache

from rig import free_port
from runner.core.model import Roi
from runner.drive.seen_file import read_seen
from runner.mqtt.broker import private_broker
from runner.settings import FROZEN_INTERVALS, Endpoint

pytestmark = pytest.mark.gst
pytest.importorskip("cv2")

CAMERAS = ("front_center", "rear_center")
OTHERS = ["front_left", "front_right", *(f"top_{side}" for side in ("front", "left", "right", "rear"))]
SIZE = {"width_px": 480, "height_px": 260}
WORDS = [f"~cameras.{name}" for name in OTHERS]
WORDS += [f"cameras.{name}.{key}={value}" for name in CAMERAS for key, value in SIZE.items()]
WORDS += ["source=synthetic", "source.render.seconds=4", "fps_max=10", "page.serve=false", "pqos=constant"]
WORDS += ["pqos.kbps=2000", "modes=seen", "mode=automatic", "log.video=true"]
SHOWN = Roi(120, 64, 240, 132)  # of the front camera; the rear one is not on the screen

DRIVER = """
import json, sys, time
from pathlib import Path
from runner.core.events import Attention
from runner.live import live_operator, live_vehicle
from runner.model import NOWHERE, Seen

log, words = Path(sys.argv[1]), sys.argv[2:]
with live_vehicle(words, log=log, say=lambda line: None) as vehicle:
    vehicle.start()
    with live_operator(words, log=log) as operator:
        operator.station.attention = Attention.WATCHING
        arrived = []
        operator.start(lambda camera, unit: arrived.append((camera, unit.region)))

        def until(condition):
            end = time.monotonic() + 120
            while not condition() and time.monotonic() < end:
                time.sleep(0.1)
            assert condition()

        front = Seen(120, 64, 240, 132, 240, 132)
        until(lambda: {"front_center", "rear_center"} <= {camera for camera, _ in arrived})
        time.sleep(1.5)
        operator.see({"front_center": front, "rear_center": NOWHERE})
        until(lambda: any(camera == "front_center" and region for camera, region in arrived))
        time.sleep(4)
"""


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """The whole images are sent at first, then only what is seen, and what is always sent."""
    path = tmp_path_factory.mktemp("seen") / "drive"
    endpoint = Endpoint("127.0.0.1", free_port())
    words = [*WORDS, f"control.port={endpoint.port}", f"media.port={free_port()}"]
    with private_broker(endpoint), pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(shared_cache(tmp_path_factory)))
        command = [sys.executable, "-c", DRIVER, str(path), *words]
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return path


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def changed(drive, to, change):
    """A copy of a drive whose samples of the operator's log are changed."""
    shutil.copytree(drive, to)
    logged = lines(to / "operator.jsonl")
    for line in logged:
        if line.get("log") == "sample":
            change(line["cameras"]["front_center"])
    (to / "operator.jsonl").write_text("".join(json.dumps(line) + "\n" for line in logged))
    return to


def measured(tod, drive, view=None):
    result = tod("quality", str(drive), f"view={view or drive}")
    assert result.status == 0, result.err
    return read_seen(drive), result


def test_only_what_was_on_the_screen_is_scored(tod, drive):
    found, result = measured(tod, drive)
    front, rear = (found.cameras[name] for name in CAMERAS)
    assert len(front.t) >= 4
    assert set(front.px) == {240 * 132}
    assert front.scene
    assert 0.8 < front.summary("mssim").mean < 1
    whole = found.summary("mssim").mean
    assert whole == pytest.approx(front.summary("mssim").mean), "the rear camera was not on the screen"
    assert rear.t == ()
    assert rear.age is None
    assert front.age.mean_ms > 0
    assert "front_center" in result.out
    assert "screen" in result.out
    if "vmaf" in found.metrics:
        assert all(score is not None and 20 < score <= 100 for score in front.scores["vmaf"])


def test_what_was_not_sent_is_black(tod, drive, tmp_path):
    """With the view of a window that shows the whole image, of which only a part was sent in the end."""
    part, _ = measured(tod, drive)
    log = tmp_path / "view.jsonl"
    seen = {"x": 0, "y": 0, "width": 480, "height": 260, "screen_width": 480, "screen_height": 260}
    log.write_text(json.dumps({"t": 0.0, "event": "view_reported", "view": {"front_center": seen}}) + "\n")
    whole, _ = measured(tod, shutil.copytree(drive, tmp_path / "drive"), log)
    t, scores = whole.cameras["front_center"].t, whole.cameras["front_center"].scores["mssim"]
    before = [score for at, score in zip(t, scores, strict=True) if at < part.cameras["front_center"].t[0] - 1]
    assert before
    assert min(before) > 0.8
    assert scores[-1] < min(before) - 0.2
    rear = whole.cameras["rear_center"]
    assert set(rear.px) == {480 * 260}, "a camera that the view does not name is shown in full"


def test_a_late_picture_is_old_and_not_worse(tod, drive, tmp_path):
    def late(camera):
        camera["arrivals"] = [[t + 1, ms and ms + 1000] for t, ms in camera["arrivals"]]

    before, _ = measured(tod, drive)
    after, _ = measured(tod, changed(drive, tmp_path / "late", late))
    one, other = (each.cameras["front_center"] for each in (before, after))
    assert other.age.mean_ms > one.age.mean_ms + 900
    assert other.age.late > 0.5
    assert other.summary("mssim").mean == pytest.approx(one.summary("mssim").mean, abs=0.03)


def test_pictures_that_stop_are_frozen(tod, drive, tmp_path):
    first = measured(tod, drive)[0].cameras["front_center"].t[0]
    began = {side: lines(drive / name)[0]["time"] for side, name in (("v", "drive.jsonl"), ("o", "operator.jsonl"))}
    stop = first + 1 - (began["o"] - began["v"])

    def stops(camera):
        camera["arrivals"] = [[t, ms] for t, ms in camera["arrivals"] if t < stop]

    after, _ = measured(tod, changed(drive, tmp_path / "stops", stops))
    assert after.cameras["front_center"].age.frozen > 0.4
    assert after.cameras["front_center"].age.p95_ms > 1500


def test_without_a_view_cropped_pictures_are_refused(tod, drive, tmp_path):
    result = tod("quality", str(drive))
    assert result.status == 0, result.err
    cropped = "pictures cropped to what the driver saw are left out (front_center, rear_center)"
    assert f"{drive}: {cropped}: view={drive} scores what was seen" in result.err
    scores = json.loads((drive / "quality.json").read_text())["cameras"]["front_center"]["mssim"]
    assert min(scores) > 0.8, "only pictures of the whole image are compared"

    def cropped_only(camera):
        camera["arrivals"] = [[t, ms] for t, ms in camera["arrivals"] if t > cropped_s]

    cropped_s = max(line["t"] for line in lines(drive / "operator.jsonl") if line.get("log") == "sample") - 2
    path = tmp_path / "cropped"
    shutil.copytree(drive, path)
    logged = lines(path / "operator.jsonl")
    for line in logged:
        for camera in line["cameras"].values() if line.get("log") == "sample" else ():
            cropped_only(camera)
    (path / "operator.jsonl").write_text("".join(json.dumps(line) + "\n" for line in logged))
    refused = tod("quality", str(path))
    rule = "only what the driver saw was sent of front_center, rear_center, and whole pictures are needed"
    assert refused.status == 2
    assert refused.err.endswith(f"\n{path}: {rule}: view={path} scores what was seen\n")


def test_a_model_is_not_measured_on_cropped_pictures(tod, drive, tmp_path):
    clips = sorted(
        (drive / "video").glob("front_center.vehicle.*.ts"), key=lambda path: path.stat().st_size, reverse=True
    )
    result = tod("model", "camera=front_center", f"sequence={clips[0]}", f"output={tmp_path / 'models'}")
    rule = "shows only what a driver saw at times: whole pictures are needed, as `tod-runner record` keeps them"
    assert (result.status, result.err) == (2, f"command line: sequence: '{clips[0]}': {rule}\n")


def test_the_log_states_the_region_of_each_picture(drive):
    samples = [line for line in lines(drive / "operator.jsonl") if line.get("log") == "sample"]
    found = [each for line in samples for each in line["cameras"]["front_center"].get("regions", ())]
    assert found
    times, regions = zip(*found, strict=True)
    assert list(times) == sorted(times)
    shown = Roi(**regions[-1])
    assert (shown.x, shown.y) <= (SHOWN.x, SHOWN.y)
    assert shown.width >= SHOWN.width
    assert shown.width < SIZE["width_px"]


def test_a_log_that_states_no_view_is_refused(tod, drive, tmp_path):
    log = tmp_path / "log.jsonl"
    log.write_text('{"t": 0.0, "event": "clock_advanced"}\n')
    result = tod("quality", str(drive), f"view={log}")
    rule = "states no view (no event view_reported): the page states it to the vehicle while its driver watches"
    assert (result.status, result.err) == (2, f"{log}: {rule}\n")
    seen = {"x": 400, "y": 0, "width": 200, "height": 100, "screen_width": 200, "screen_height": 100}
    log.write_text(json.dumps({"t": 0.0, "event": "view_reported", "view": {"front_center": seen}}) + "\n")
    result = tod("quality", str(drive), f"view={log}")
    rule = "must lie inside the camera's image of 480x260 px"
    assert f"{log}: view.front_center: 200x100 px at 400, 0: {rule}" in result.err


def test_the_page_judges_by_the_same_limit():
    script = Path(__file__).parents[2] / "runner" / "page" / "static" / "status.js"
    assert re.search(r"INTERVALS = ([\d.]+);", script.read_text())[1] == str(FROZEN_INTERVALS)
