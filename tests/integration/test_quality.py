"""Quality of delivered pictures: measured on a real drive, and lower if pictures were late."""

from __future__ import annotations

import json
import shutil

import pytest
from helpers import shared_cache
from shared_data import shared

from rig import free_port, run

SIZE = [f"cameras.front_center.{key}" for key in ("width_px=480", "height_px=260")]
OTHERS = [f"~cameras.{name}" for name in ("front_left", "front_right", "rear_center")]
OTHERS += [f"~cameras.top_{side}" for side in ("front", "left", "right", "rear")]


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """One camera with a clip that repeats, at a more than sufficient bitrate."""
    path = tmp_path_factory.mktemp("quality") / "drive"
    ports = (f"media.port={free_port()}", f"control.port={free_port()}")
    words = (*OTHERS, *SIZE, "source.render.seconds=4", "fps_max=10", "page.serve=false", "modes=open_loop")
    rate = ("pqos=constant", "pqos.kbps=5000", "log.video=true", "duration_s=5")
    cache = {"XDG_CACHE_HOME": str(shared_cache(tmp_path_factory))}  # as in the tests
    done = run("demo", *words, *rate, *ports, f"log={path}", env=cache)
    assert done.returncode == 0, done.stderr
    return changed(path, path.with_name("prompt"), in_time)


def in_time(camera):
    """As if each picture had arrived after 30 ms: on a busy machine some are late."""
    camera["arrivals"] = [[t - ms / 1000 + 0.03, 30] for t, ms in camera["arrivals"] if ms is not None]


def measured(tod, path):
    result = tod("quality", str(path))
    assert result.status == 0, result.err
    assert "front_center" in result.out
    return json.loads((path / "quality.json").read_text())


def changed(path, to, change):
    """A copy of a drive whose samples of the operator's log are changed."""
    shutil.copytree(path, to)
    lines = [json.loads(line) for line in (to / "operator.jsonl").read_text().splitlines()]
    for line in lines:
        if line.get("log") == "sample":
            change(line["cameras"]["front_center"])
    (to / "operator.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return to


def test_pictures_in_time_are_as_good_as_their_encoding(tod, drive):
    found = measured(tod, drive)
    camera = found["cameras"]["front_center"]
    assert camera["clip"] is True
    assert len(camera["mssim"]) >= 4
    assert 0.9 < found["mean"] < 1
    assert found["worst"] == "front_center"


def test_pictures_a_second_late_show_an_old_scene(tod, drive, tmp_path):
    def late(camera):
        camera["arrivals"] = [[t + 1, ms and ms + 1000] for t, ms in camera["arrivals"]]

    before = measured(tod, drive)
    after = measured(tod, changed(drive, tmp_path / "late", late))
    assert after["cameras"]["front_center"]["stale"] == 1
    assert after["mean"] < before["mean"] - 0.1


def test_without_its_clip_the_stream_as_sent_is_the_reference(tod, drive, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "no clips"))
    camera = measured(tod, drive)["cameras"]["front_center"]
    assert camera["clip"] is False
    assert sum(camera["mssim"]) / len(camera["mssim"]) > 0.99


def test_the_scene_of_a_recorded_clip_is_its_picture(tod, tmp_path, monkeypatch):
    """The clip is cropped and scaled as its source does it; a long one is decoded again where it is needed."""
    clip = shared("video/forward_highway_day_540p25_A.mp4")
    path, ports = tmp_path / "recorded", (f"media.port={free_port()}", f"control.port={free_port()}")
    words = (*OTHERS, *SIZE, "fps_max=5", "page.serve=false", "modes=open_loop", "source=file", f"source.clip={clip}")
    rate = ("pqos=constant", "pqos.kbps=5000", "log.video=true", "duration_s=4", *ports)
    done = run("demo", *words, *rate, f"log={path}")
    assert done.returncode == 0, done.stderr
    found = measured(tod, changed(path, tmp_path / "prompt", in_time))
    assert found["cameras"]["front_center"]["clip"] is True
    assert 0.9 < found["mean"] < 0.9999
    monkeypatch.setattr("runner.drive.scenes.KEPT_BYTES", 0)
    assert measured(tod, tmp_path / "prompt")["cameras"] == found["cameras"]


def test_a_drive_without_video_is_refused(tod, drive, tmp_path):
    shutil.copytree(drive, tmp_path / "blind")
    for name in ("drive", "operator"):
        file = tmp_path / "blind" / f"{name}.jsonl"
        file.write_text("".join(f"{line}\n" for line in file.read_text().splitlines() if '"log": "video"' not in line))
    result = tod("quality", str(tmp_path / "blind"))
    assert (result.status, result.err) == (
        2,
        f"{tmp_path / 'blind'}: no camera's video was kept on both sides: drive with log.video=true\n",
    )
    (tmp_path / "blind" / "operator.jsonl").unlink()
    rule = "no log of the operator: both sides are needed"
    assert tod("quality", str(tmp_path / "blind")).err == f"{tmp_path / 'blind'}: {rule}\n"


def test_a_camera_whose_file_cannot_be_read_is_left_out(tod, drive, tmp_path):
    shutil.copytree(drive, tmp_path / "torn")
    (tmp_path / "torn" / "video" / "front_center.operator.0.ts").write_bytes(b"")
    result = tod("quality", str(tmp_path / "torn"))
    assert result.status == 2
    assert "front_center is left out: " in result.err


@pytest.mark.parametrize(
    ("side", "said"),
    [
        ("operator", "front_center: the operator's video lacks pictures that arrived, from "),
        ("vehicle", "front_center: the vehicle's video ends at "),
    ],
)
def test_a_file_that_is_cut_off_is_scored_up_to_its_end(tod, drive, tmp_path, side, said):
    """What came later is not counted as an older picture, and the torn last picture is not compared."""
    path = tmp_path / side
    shutil.copytree(drive, path)
    file = path / "video" / f"front_center.{side}.0.ts"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    whole = measured(tod, drive)["cameras"]["front_center"]
    result = tod("quality", str(path))
    assert said in result.err
    cut_off = json.loads((path / "quality.json").read_text())["cameras"]["front_center"]
    assert 2 <= len(cut_off["mssim"]) < len(whole["mssim"])
    assert cut_off["mssim"] == pytest.approx(whole["mssim"][: len(cut_off["mssim"])], abs=1e-6)
    assert cut_off["stale"] == 0


def test_a_camera_of_which_nothing_was_received_is_reported(tod, drive, tmp_path):
    path = tmp_path / "blind"
    shutil.copytree(drive, path)
    began = json.loads((path / "drive.jsonl").read_text().partition("\n")[0])
    began["config"]["cameras"]["mast"] = {
        **began["config"]["cameras"]["front_center"],
        "place": {"row": 5, "column": 5},
    }
    lines = [json.loads(line) for line in (path / "drive.jsonl").read_text().splitlines()[1:]]
    sent = [{**line, "camera": "mast"} for line in lines if line.get("log") == "video"]
    (path / "drive.jsonl").write_text("".join(json.dumps(line) + "\n" for line in (began, *sent, *lines)))
    result = tod("quality", str(path))
    assert result.status == 0, result.err
    assert "mast is left out: no picture of it was received, so mean and worst are too high" in result.err


def test_without_capture_times_nothing_is_compared(tod, drive, tmp_path):
    def timeless(camera):
        camera["arrivals"] = [[t, None] for t, _ in camera["arrivals"]]

    path = changed(drive, tmp_path / "timeless", timeless)
    rule = "nothing can be compared: no capture times were logged, or the videos lack their pictures"
    assert tod("quality", str(path)).err.endswith(f"{path}: {rule}\n")


def test_pictures_that_stop_count_until_the_operators_end(tod, drive, tmp_path):
    def stops(camera):
        camera["arrivals"] = [[t, ms] for t, ms in camera["arrivals"] if t < 2.5]

    before = measured(tod, drive)["cameras"]["front_center"]
    after = measured(tod, changed(drive, tmp_path / "stops", stops))["cameras"]["front_center"]
    assert len(after["mssim"]) >= len(before["mssim"]) - 1
    assert after["stale"] > before["stale"]
    assert sum(after["mssim"]) < sum(before["mssim"])
