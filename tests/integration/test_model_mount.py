"""Models of a drive's cameras, and models written where a vehicle uses them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import yaml
from helpers import shared_cache

from rig import free_port, run
from runner.configuration.config import configuration
from runner.errors import UserError
from runner.verbs.model_mount import with_model

pytestmark = pytest.mark.gst
pytest.importorskip("cv2")
pytest.importorskip("numba")

SMALL = ("scalings=[0.5,1.0]", "bitrates_kbps=[60,200]", "screens=[]", "metric_every=10")
KIND = """\
# A camera of ours.
width_px: 160
height_px: 96
fps: 10
rate_quality:              # a guess
  scaling:    [0.5, 1.0]

  b_min_kbps: [0, 777]     # a guess, too
  b_full_kbps: 900
always: {x: 0, y: 0, width: 160, height: 96}
"""
VEHICLE = """\
# @package _global_
defaults:
  - /cameras@cameras.front: tiny
  - /cameras@cameras.rear: tiny
  - override /source: synthetic
  - _self_
name: twin
source: {render: {seconds: 4}}
cameras:
  front: {place: {row: 0, column: 0}, pose: {x_m: 2.0, y_m: 0.0, z_m: 1.5, yaw_deg: 0}}
  rear: {place: {row: 0, column: 1}, pose: {x_m: -1.0, y_m: 0.0, z_m: 1.5, yaw_deg: 180}}
"""


@pytest.fixture
def conf(tmp_path):
    """A vehicle with two cameras of one kind, in a directory of the user's."""
    for name, text in {"cameras/tiny.yaml": KIND, "vehicle/twin.yaml": VEHICLE}.items():
        path = tmp_path / "own" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path / "own"


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    path = str(shared_cache(tmp_path_factory))
    monkeypatch.setenv("XDG_CACHE_HOME", path)
    monkeypatch.setattr("runner.rate_quality.plots.plot", lambda *_: None)
    return path


def bounds(conf):
    cameras = configuration(["vehicle=twin"], conf, runnable=False).vehicle().cameras
    return {name: [float(b) for b in camera.rate_quality.b_min] for name, camera in cameras.items()}


def test_the_vehicle_drives_with_a_model_that_was_mounted(tod, conf):
    assert bounds(conf)["front"] == [0, 777]
    result = tod("model", "vehicle=twin", f"mount={conf}", *SMALL)
    assert result.status == 0, result.err
    path = conf / "cameras" / "tiny.yaml"
    found = yaml.safe_load(path.read_text())
    model = json.loads((conf / "cameras" / "tiny.model.json").read_text())
    assert set(model["sequences"]) == {"front", "rear"}, "cameras of one kind are measured together"
    assert found["rate_quality"]["b_full_kbps"] == model["b_full_kbps"]
    assert found["rate_quality"]["model"] == "tiny.model.json"
    assert found["rate_quality"]["quality"]
    assert found["always"] == yaml.safe_load(KIND)["always"], "everything else stays"
    assert path.read_text().startswith("# A camera of ours.")
    assert (conf / "cameras" / "tiny.yaml.before").read_text() == KIND
    assert bounds(conf)["rear"] != [0, 777]
    assert "kbit/s and size, before and after" in result.out
    assert "160x96" in result.out
    again = tod("model", "vehicle=twin", f"mount={conf}", *SMALL)
    assert again.status == 0, again.err
    assert yaml.safe_load(path.read_text()) == found
    assert not (conf / "cameras" / "tiny.yaml.before1").exists(), "what was measured is replaced"


def test_a_packaged_kind_is_shadowed(tod, tmp_path):
    mount = tmp_path / "new"
    words = ("vehicle=tum_q7", "camera=front_center", "cameras.front_center.width_px=480", f"mount={mount}")
    result = tod("model", *words, *SMALL)
    assert result.status == 2
    rule = "states 1920x1040 px: a model of another size does not belong there"
    assert "command line: cameras.front_center: 480x1040 px: " in result.err
    assert rule in result.err
    assert not mount.exists()
    pooled = tod("model", "vehicle=tum_q7", f"mount={mount}", "pool={a:[front_left]}")
    assert "cameras of one kind are measured together" in pooled.err


def test_a_model_that_cannot_be_replaced_is_refused():
    measured = "# Measured by `tod-runner model` on a.mkv.\nrate_quality:\n  scaling:    [0.5]\n  b_min_kbps: [0]\n"
    found = with_model("width_px: 160\nrate_quality: {scaling: [1.0]}\nfps: 10\n", measured, "k.yaml")
    assert yaml.safe_load(found) == {"width_px": 160, "rate_quality": {"scaling": [0.5], "b_min_kbps": [0]}, "fps": 10}
    assert yaml.safe_load(with_model("fps: 10", measured, "k.yaml"))["fps"] == 10
    for text in ("rate_quality: {scaling:\n[1.0]}\n", "{rate_quality: {scaling: [1.0]}}\n"):
        with pytest.raises(UserError, match=r"k.yaml: rate_quality: cannot be replaced where it stands"):
            with_model(text, measured, "k.yaml")


@pytest.fixture
def drive(conf, cache, tmp_path):
    """Of the front camera everything is sent at its full size, of the rear one at half of it."""
    path = tmp_path / "drive"
    ports = (f"media.port={free_port()}", f"control.port={free_port()}")
    words = ("vehicle=twin", f"conf={conf}", "page.serve=false", "modes=open_loop", "pqos=constant", "pqos.kbps=3000")
    small = ("cameras.rear.rate_quality.scaling=[0.5]", "cameras.rear.rate_quality.b_min_kbps=[0]")
    done = run(
        "demo", *words, *small, *ports, "log.video=true", "duration_s=5", f"log={path}", env={"XDG_CACHE_HOME": cache}
    )
    assert done.returncode == 0, done.stderr
    return path


def test_cameras_are_measured_on_what_a_drive_has_of_their_images(tod, drive, conf, tmp_path, monkeypatch):
    played = tod("model", str(drive), f"output={tmp_path / 'played'}", "camera=front", *SMALL)
    assert played.status == 0, played.err
    assert "front: measured on what its source played" in played.err
    document = json.loads((tmp_path / "played" / "front.model.json").read_text())
    clip = document["sequences"]["front"]["file"]

    shutil.copy(cached(clip), drive / "front.mkv")
    (drive / "recording.json").write_text('{"cameras": {"front": {"file": "front.mkv"}}}')
    recorded = tod("model", str(drive), f"output={tmp_path / 'recorded'}", "camera=front", *SMALL)
    assert "front: measured on front.mkv, recorded without loss" in recorded.err
    (drive / "recording.json").unlink()

    monkeypatch.setattr(
        "runner.verbs.model_footage._existing", lambda footage: None
    )  # as with cameras that play nothing
    sent = tod("model", str(drive), f"mount={conf}", *SMALL)
    assert sent.status == 0, sent.err
    second = "as sent: second best, since it is already compressed"
    assert f"front: measured on front.vehicle.0.ts, {second}" in sent.err
    left_out = "rear: was sent at 80x48 px at times, its image has 160x96: left out"
    assert left_out in sent.err
    assert "is already compressed with loss" in (conf / "cameras" / "tiny.yaml").read_text()
    assert bounds(conf)["front"] != [0, 777]


def cached(clip):
    import os

    (found,) = Path(os.environ["XDG_CACHE_HOME"]).rglob(clip)
    return found
