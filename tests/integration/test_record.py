"""Lossless recordings: every bit, complete files or none, and messages about losses."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from rig import CHECKOUT, CLIPS, process, run, until
from runner.configuration.config import configuration
from runner.errors import RunError
from runner.graph import launch
from runner.plans import compile_plans
from runner.rate_quality import recordings

pytestmark = pytest.mark.gst

ONE = ("vehicle=delivery_robot", "~cameras.front", "~cameras.mast")  # the robot's rear camera alone: 848x480
LIVE = "{name: source, element: videotestsrc, properties: {is-live: true, pattern: ball}}"
RAW = '{name: raw, element: capsfilter, properties: {caps: "{raw_caps}"}}'


@pytest.fixture
def conf(tmp_path: Path) -> Path:
    """The user's own sources, one that ends and one that fails; and an encoder that needs 0.2 s per frame."""
    directory = tmp_path / "conf"
    (directory / "source").mkdir(parents=True)
    sources = {
        "short": [LIVE.replace("ball", "ball, num-buffers: 20"), RAW],
        "failing": [LIVE, RAW, "{name: fault, element: identity, properties: {error-after: 20}}"],
    }
    for name, elements in sources.items():
        text = "elements:\n" + "".join(f"  - {element}\n" for element in elements)
        (directory / "source" / f"{name}.yaml").write_text(text)
    (directory / "recording").mkdir()
    text = (CHECKOUT / "conf" / "recording" / "x264.yaml").read_text()
    slow = "elements:\n  - {name: slow, element: identity, properties: {sleep-time: 200000}}\n"
    (directory / "recording" / "slow.yaml").write_text(text.replace("elements:\n", slow))
    return directory


def frames(line: str, limit: int = 10_000) -> list[tuple[int, str]]:
    """Time in ns and digest of each frame that a pipeline produces."""
    from runner.gst import Gst

    pipeline = Gst.parse_launch(f"{line} ! appsink name=frames sync=false max-buffers=4")
    sink, seen = pipeline.get_by_name("frames"), []
    pipeline.set_state(Gst.State.PLAYING)
    try:
        while len(seen) < limit and (sample := sink.emit("try-pull-sample", 10 * Gst.SECOND)):
            buffer = sample.get_buffer()
            data = buffer.extract_dup(0, buffer.get_size())
            seen.append((buffer.pts, hashlib.md5(data).hexdigest()))
    finally:
        pipeline.set_state(Gst.State.NULL)
    return seen


def recorded(path: Path) -> list[tuple[int, str]]:
    return frames(f'filesrc location="{path}" ! matroskademux ! decodebin ! video/x-raw,format=I420')


def digests(found: list[tuple[int, str]]) -> list[str]:
    return [digest for _, digest in found]


def source_line(*overrides: str) -> str:
    """The source of the one camera, as in every pipeline, but without the element that paces it."""
    (plan,) = compile_plans(configuration([*ONE, *overrides]).setup())
    return launch(element for element in plan.source if element.name != "pace")


def index(directory: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((directory / "recording.json").read_text())
    return document


# --- contents of the files --------------------------------------------------------------------------------------------


RECORDED = [
    *(path for path in CLIPS if "720p25" in path.name),
    *(pytest.param(path, marks=pytest.mark.soak) for path in CLIPS if "fisheye" in path.name),
]


@pytest.mark.parametrize("clip", RECORDED, ids=str)
def test_a_clip_is_recorded_bit_by_bit(tmp_path, clip):
    words = ("source=file", f'source.clip="{clip}"')
    done = run("record", *ONE, *words, f"output={tmp_path}", "duration_s=1.5")
    assert done.returncode == 0, done.stderr
    found, wanted = recorded(tmp_path / "rear.mkv"), frames(source_line(*words), 45)
    assert digests(found) == digests(wanted)
    assert len(set(digests(found))) > 20  # it moves
    assert "WARNING" not in done.stderr


@pytest.mark.parametrize("recording", ["x264", "ffv1"])
def test_every_encoder_is_lossless_and_keeps_the_times(tmp_path, conf, recording):
    words = ("source=short", f"conf={conf}")
    done = run("record", *ONE, *words, f"recording={recording}", f"output={tmp_path}")
    assert done.returncode == 0, done.stderr
    found = recorded(tmp_path / "rear.mkv")
    wanted = frames(f"videotestsrc num-buffers=20 pattern=ball ! {source_caps()}")
    assert digests(found) == digests(wanted)
    assert len(set(digests(found))) == 20
    steps = [(later - earlier) / 1e9 for (earlier, _), (later, _) in pairwise(found)]
    assert steps == pytest.approx([1 / 30] * 19, abs=3e-6)
    about = index(tmp_path)["cameras"]["rear"]
    assert (about["width_px"], about["height_px"], about["fps"], about["frames"]) == (848, 480, 30, 20)
    assert about["missing_frames"] == about["overruns"] == 0
    assert about["seconds"] == pytest.approx(20 / 30, abs=1e-4)
    assert abs(time.time() - about["began"]) < 60


def source_caps() -> str:
    return "video/x-raw,format=I420,width=848,height=480,framerate=30/1,pixel-aspect-ratio=1/1,colorimetry=bt709"


def test_the_length_is_kept_to_the_frame_and_described(tmp_path):
    output = tmp_path / "new ü" / "rec"
    done = run("record", "vehicle=delivery_robot", "source=test", f"output={output}", "duration_s=1.2")
    assert done.returncode == 0, done.stderr
    about = index(output)
    assert {name: camera["frames"] for name, camera in about["cameras"].items()} == {
        "front": 36,
        "rear": 36,
        "mast": 18,
    }
    assert about["configuration"]["source"]["elements"][0]["element"] == "videotestsrc"
    assert sorted(path.name for path in output.iterdir()) == ["front.mkv", "mast.mkv", "rear.mkv", "recording.json"]
    assert [line.partition(":")[0] for line in done.stdout.splitlines()] == ["front", "rear", "mast"]
    assert len(recorded(output / "mast.mkv")) == 18
    assert "mast: 100%" in done.stderr


# --- how it ends ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "status", "words"),
    [
        (signal.SIGINT, 130, ()),
        (signal.SIGTERM, 0, ()),
        pytest.param(signal.SIGHUP, 0, (), marks=pytest.mark.soak),
        pytest.param(signal.SIGINT, 130, ("duration_s=60",), marks=pytest.mark.soak),
    ],
)
def test_a_signal_ends_with_complete_files(tmp_path, number, status, words):
    with process("record", *ONE, "source=test", f"output={tmp_path}", *words) as child:
        part = tmp_path / ".rear.mkv.part"
        until(lambda: part.exists() and part.stat().st_size > 100_000)
        assert not (tmp_path / "rear.mkv").exists()
        child.send_signal(number)
        output, _ = child.communicate(timeout=30)
        assert child.returncode == status, output
    assert not part.exists()
    found = recorded(tmp_path / "rear.mkv")
    assert len(found) == index(tmp_path)["cameras"]["rear"]["frames"] > 5
    assert f"rear: {tmp_path / 'rear.mkv'}: 848x480 at 30 Hz, {len(found)} frames" in output


def test_the_others_continue_if_a_source_fails(tmp_path, conf):
    output = tmp_path / "rec"
    words = ("vehicle=delivery_robot", "source=test", f"conf={conf}", f"output={output}", "duration_s=2")
    mounted = (
        "+source@cameras.rear.source=failing",
        "+source@cameras.mast.source=v4l2",
        "cameras.mast.device=/dev/none",
    )
    done = run("record", *words, *mounted)
    assert done.returncode == 1
    part = output / ".rear.mkv.part"
    assert f"rear: Failed after iterations as requested.; what was recorded until then is in {part}" in done.stderr
    assert "mast: Cannot identify device '/dev/none'.\n" in done.stderr
    assert sorted(path.name for path in output.iterdir()) == [part.name, "front.mkv", "recording.json"]
    assert len(recorded(output / "front.mkv")) == 60
    assert 0 < len(recorded(part)) <= 20
    about = index(output)["cameras"]
    assert (about["rear"]["file"], about["rear"]["failed"]) == (part.name, "Failed after iterations as requested.")
    assert "file" not in about["mast"]


def test_a_source_that_ends_early_is_reported(tmp_path, conf):
    done = run("record", *ONE, "source=short", f"conf={conf}", f"output={tmp_path / 'rec'}", "duration_s=5")
    assert done.returncode == 1
    assert "rear: its source ended after 0.7 of 5 s" in done.stderr
    assert len(recorded(tmp_path / "rec" / "rear.mkv")) == 20


def test_lost_frames_are_counted_and_reported(tmp_path, conf):
    words = ("source=test", "recording=slow", f"conf={conf}", f"output={tmp_path / 'rec'}")
    huge = ("cameras.rear.width_px=3840", "cameras.rear.height_px=2160", "cameras.rear.fps=30")  # the queue fits ten
    done = run("record", *ONE, *words, *huge, "duration_s=2")
    assert done.returncode == 0, done.stderr
    about = index(tmp_path / "rec")["cameras"]["rear"]
    assert about["missing_frames"] > 0
    assert about["frames"] == len(recorded(tmp_path / "rec" / "rear.mkv"))
    of = about["frames"] + about["missing_frames"]
    expected = f"rear: WARNING: {about['missing_frames']} of {of} frames are missing"
    assert expected in done.stderr


# --- the disk ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """300 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=300m", "tmpfs", str(disk)]
    if os.geteuid() or subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("mounting needs root")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def test_a_disk_that_fills_up_ends_the_recording_with_complete_files(small_disk):
    words = (*ONE, "source=test", "fps_max=5", f"output={small_disk}")
    with process("record", *words) as child:
        part = small_disk / ".rear.mkv.part"
        until(lambda: part.exists() and part.stat().st_size)
        with (small_disk / "other").open("wb") as other:
            os.posix_fallocate(other.fileno(), 0, shutil.disk_usage(small_disk).free - 60_000_000)
        output, _ = child.communicate(timeout=30)
    assert child.returncode == 1, output
    assert "0.06 GB left, 0.07 GB are kept free: the recording ends early" in output
    assert len(recorded(small_disk / "rear.mkv")) == index(small_disk)["cameras"]["rear"]["frames"] > 0


def test_a_disk_without_room_is_refused_before_the_start(small_disk):
    done = run("record", *ONE, "source=test", f"output={small_disk}")  # 60 s at 30 Hz
    assert (done.returncode, list(small_disk.iterdir())) == (1, [])
    expected = "free, a recording needs 0.87 GB: 0.7 of 1.10 GB raw in 60 s, and 0.10 GB kept free"
    assert expected in done.stderr


@pytest.mark.parametrize(("free", "fits"), [(86_000_000, False), (87_000_000, True)])
def test_the_room_that_is_needed(tmp_path, monkeypatch, free, fits):
    """10 frames of 848x480: 6.1 MB raw; kept free are 64 MB and two seconds of 6.1 MB."""
    setup = configuration([*ONE, "source=test", "fps_max=10", "recording.of_raw=1.7"]).setup()
    usage = shutil._ntuple_diskusage(10**9, 10**9 - free, free)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    check = (tmp_path, setup.vehicle.cameras.values(), setup.recording, 1)
    if fits:
        recordings.check_space(*check)
    else:
        with pytest.raises(RunError, match=r"0\.09 GB free, a recording needs 0\.09 GB"):
            recordings.check_space(*check)


# --- refused input ----------------------------------------------------------------------------------------------------


def test_nothing_is_overwritten(tod, tmp_path):
    names = ["front.mkv", ".rear.mkv.part"]
    for name in names:
        (tmp_path / name).write_text("mine")
    done = tod("record", "vehicle=delivery_robot", "source=test", f"output={tmp_path}", "duration_s=1")
    rule = "front.mkv, .rear.mkv.part already exist; choose another directory"
    assert (done.status, done.err) == (2, f"command line: output: '{tmp_path}': {rule}\n")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)
    assert all((tmp_path / name).read_text() == "mine" for name in names)


def test_a_name_taken_during_the_recording_is_not_overwritten(tmp_path):
    recordings.claim_files(tmp_path, ["rear"])["rear"].write_text("new")
    (tmp_path / "rear.mkv").write_text("old")
    with pytest.raises(RunError, match=r"rear.mkv was created in the meantime; the recording is .*/\.rear\.mkv\.part"):
        recordings.keep(tmp_path, "rear")
    assert (tmp_path / "rear.mkv").read_text() == "old"


@pytest.mark.parametrize(
    ("words", "status", "expected"),
    [
        (["duration_s=1"], 2, "command line: output: missing: must be given: output=DIR, a directory for the files"),
        (["output=/tmp/x", "duration_s=0"], 2, "command line: duration_s: '0': must be above 0"),
        (["output=/proc/nowhere"], 2, "command line: output: '/proc/nowhere': no such file or directory"),
        (["output=/dev/null"], 2, "command line: output: '/dev/null': must be a directory"),
        (["output=/tmp/x", "recording=x26"], 2, "command line: recording: x26: no such file in conf/recording/, did"),
        (["output=/tmp/x", "recording.codek=a"], 2, "command line: recording.codek: unknown key, did you mean codec?"),
        (
            ["output=/tmp/x", "source=appsrc"],
            2,
            "command line: source: rear: its frames must be pushed by a Python program",
        ),
    ],
)
def test_bad_input_is_reported(tod, words, status, expected):
    done = tod("record", *ONE, *(["source=test"] if "source=appsrc" not in words else []), *words)
    assert (done.status, done.out) == (status, "")
    assert done.err.startswith(expected)


def test_an_encoder_that_is_not_installed_names_its_package(tmp_path, capsys):
    from runner.__main__ import main

    words = ["source=test", "recording.elements=[{name: encoder, element: lostenc}]", f"output={tmp_path}"]
    words.append("+recording.needs={lostenc: gstreamer1.0-lost}")
    assert main(["record", *ONE, *words]) == 1
    expected = "the GStreamer element lostenc is not installed; on Debian: apt-get install gstreamer1.0-lost\n"
    assert capsys.readouterr().err == expected
    assert list(tmp_path.iterdir()) == []


def test_passwords_of_cameras_stay_out_of_the_description(tmp_path):
    recordings.write_index(tmp_path, {"address": "rtsp://me:secret@10.0.0.1/video"})
    assert (tmp_path / "recording.json").read_text() == '{\n  "address": "rtsp://10.0.0.1/video"\n}\n'
