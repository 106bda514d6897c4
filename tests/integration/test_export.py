"""Drives as MCAP, read back with the reader of the format's authors; the video decoded again."""

from __future__ import annotations

import json
import math
import shutil
import struct
import subprocess
from itertools import pairwise
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

from rig import free_port, over_tcp, run, until
from runner.apply import OperatorSide, VehicleSide, VideoFiles, check_plan
from runner.configuration.config import configuration
from runner.core.commands import Command
from runner.drive.log import FORMAT
from runner.plans import compile_plans

pytest.importorskip("foxglove")
reader = pytest.importorskip("mcap.reader")

CAMERAS = ("front", "rear")
BEGAN = 1_700_000_000.25


def position(t, lat):
    return {"t": t, "event": "position_reported", "lat": lat, "lon": 11.66, "speed_mps": 8.0, "heading_deg": 90}


VEHICLE = [
    {"t": 0.0, "event": "clock_advanced"},
    position(0.5, 48.26),
    {"t": 0.6, "event": "bitrate_predicted", "kbps": 3000},
    {
        "t": 0.6,
        "log": "telemetry",
        "predicted_kbps": 3000,
        "position": None,
        "cameras": {"front": {"applied": {}, "frames": 3, "bytes": 900}},
        "refused": 0,
    },
    {"t": 0.7, "log": "note", "text": "front: pipeline built"},
    position(1.5, 48.27),
]
SAMPLE = {
    "t": 0.25,
    "log": "sample",
    "predicted_kbps": None,
    "allocated_kbps": 0,
    "actual_kbps": 0,
    "position": {"lat": 48.5, "lon": 11.5},
    "refused": 0,
    "cameras": {},
}
ENDED = {"t": 2.0, "log": "ended"}


def began(side, time=BEGAN):
    config = {"name": "delivery_robot", "cameras": {name: {} for name in CAMERAS}}
    versions = {"tod-runner": "1", "Python": "3"}
    return {
        "t": 0.0,
        "log": "began",
        "side": side,
        "format": FORMAT,
        "time": time,
        "versions": versions,
        "config": config,
    }


def write(directory, file, *lines, end="\n"):
    directory.mkdir(exist_ok=True)
    (directory / file).write_text("\n".join(map(json.dumps, lines)) + end)


def messages(path):
    """By topic: schema, channel and messages; checksums are verified."""
    topics = {}
    with path.open("rb") as file:
        for schema, channel, message in reader.make_reader(file, validate_crcs=True).iter_messages():
            topics.setdefault(channel.topic, (schema, channel, []))[2].append(message)
    return topics


def fields(data):
    """Fields of a protobuf message by number; the last of each."""
    found, at = {}, 0

    def varint():
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    while at < len(data):
        number, kind = divmod(varint(), 8)
        if kind == 0:
            found[number] = varint()
        else:
            size = {1: 8, 5: 4}.get(kind) or varint()
            found[number] = data[at : at + size]
            at += size
    return found


def number(data):
    return struct.unpack("<d", data)[0]


def stamp(field):
    parts = fields(field)
    return parts.get(1, 0) * 10**9 + parts.get(2, 0)


# --- a real drive -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """Two cameras, really streamed and received, in a drive of both sides; the first frame of each file."""
    drive, first_frames, shifts, arrived = tmp_path_factory.mktemp("filmed"), [], [], []
    words = ["vehicle=delivery_robot", "source=test", f"media.port={free_port()}"]
    setup = configuration(words, check=check_plan).setup()
    setup = setup.with_cameras({name: setup.vehicle.cameras[name] for name in CAMERAS})
    plans = [over_tcp(plan) for plan in compile_plans(setup)]  # a busy machine loses packets of UDP
    files = VideoFiles(drive, lambda *first: first_frames.append(first), lambda *shift: shifts.append(shift))
    reported = []
    sending = VehicleSide(plans, setup.media, lambda camera, what: reported.append(what), files)
    try:
        sending.turn(Command(name, "size", (320, 180)) for name in CAMERAS)
        for _ in range(2):
            receiving = OperatorSide(plans, lambda camera, what: None, lambda *unit: arrived.append(unit), video=files)
            try:
                until(lambda r=receiving: all(c.decoded > 20 for c in r.sample({}).values()))
                sending.turn(Command(name, "size", (160, 90)) for name in CAMERAS)
                until(lambda r=receiving: all(c.width == 160 for c in r.sample({}).values()))
            finally:
                receiving.stop()
            until(lambda: reported.count("pipeline stopped") == reported.count("pipeline built"))
    finally:
        sending.stop()
    for side, name in (("vehicle", "drive.jsonl"), ("operator", "operator.jsonl")):
        start = first_frames[0][2] - 1
        lines = [
            {"t": max(0.0, captured - start), "log": "video", "camera": camera, "file": file, "captured": captured}
            for camera, file, captured in sorted(first_frames, key=lambda first: first[2])
            if f".{side}." in file
        ]
        assert len(lines) == 4
        lines += [
            {
                "t": captured - start,
                "log": "video_shift",
                "camera": camera,
                "file": file,
                "after_s": after_s,
                "captured": captured,
            }
            for camera, file, after_s, captured in shifts
            if f".{side}." in file
        ]
        if side == "operator":
            lines.append({**SAMPLE, "t": 90.0, "position": None, "cameras": _camera_samples(arrived, start)})
        write(drive, name, began(side, start), *lines)
    return drive, first_frames


def _camera_samples(units, start):
    """The cameras of a sample with the arrivals of access units."""
    arrivals = {name: [] for name in CAMERAS}
    for camera, unit in units:
        arrivals[camera].append((round(unit.arrived - start, 4), round(1000 * (unit.arrived - unit.captured), 2)))
    zeros = dict.fromkeys(("fps", "kbps", "allocated_kbps", "demand_kbps", "width", "height"), 0)
    zeros |= dict.fromkeys(("lost", "rebuilt", "frames", "bytes", "damaged"), 0)
    zeros |= {"scaling": None, "latency_ms": None, "stages_ms": {}}
    return {name: {**zeros, "arrivals": arrivals[name]} for name in CAMERAS}


def counted(path):
    """Access units of a file, and pictures that ffmpeg decodes from them."""
    what = ["-count_frames", "-count_packets", "-select_streams", "v", "-show_entries"]
    what += ["stream=nb_read_frames,nb_read_packets", "-of", "default=noprint_wrappers=1"]
    shown = subprocess.run(["ffprobe", "-v", "error", *what, path], capture_output=True, text=True, check=True)
    found = dict(line.split("=") for line in shown.stdout.split())
    return int(found["nb_read_packets"]), int(found["nb_read_frames"])


def test_every_picture_is_in_the_export_and_can_be_decoded(filmed, tmp_path):
    drive, first_frames = filmed
    output = tmp_path / "out.mcap"
    done = run("export", str(drive), f"output={output}")
    assert done.returncode == 0, done.stderr
    topics = messages(output)
    for name in CAMERAS:
        for side, topic in (("vehicle", f"/{name}/video"), ("operator", f"/{name}/video_received")):
            schema, _, pictures = topics[topic]
            assert (schema.name, schema.encoding) == ("foxglove.CompressedVideo", "protobuf")
            units = [fields(picture.data) for picture in pictures]
            assert {(unit[2], unit[4]) for unit in units} == {(name.encode(), b"h264")}
            assert [stamp(unit[1]) for unit in units] == [picture.log_time for picture in pictures]
            times = [picture.log_time for picture in pictures]
            assert all(a < b for a, b in pairwise(times))
            firsts = sorted(
                captured for camera, file, captured in first_frames if camera == name and f".{side}." in file
            )
            assert abs(times[0] / 1e9 - firsts[0]) < 2e-4
            assert any(abs(time / 1e9 - firsts[1]) < 2e-4 for time in times)
            written = tmp_path / f"{name}.{side}.h264"
            written.write_bytes(b"".join(unit[3] for unit in units))
            kept = [counted(drive / f"video/{name}.{side}.{n}.ts") for n in range(2)]
            assert len(units) == kept[0][0] + kept[1][0] > 40
            # On a busy machine packets get lost on loopback, too; what was sent is complete.
            if side == "vehicle" or all(units == pictures for units, pictures in kept):
                assert counted(written) == (len(units), len(units))


@pytest.mark.alone
def test_received_pictures_get_the_times_at_which_they_were_sent(tod, filmed, tmp_path):
    drive, _ = filmed
    tod("export", str(drive), f"output={tmp_path / 'out.mcap'}")
    topics = messages(tmp_path / "out.mcap")
    for name in CAMERAS:
        sent, received = (
            {fields(picture.data)[3][-40:]: picture.log_time for picture in topics[topic][2]}
            for topic in (f"/{name}/video", f"/{name}/video_received")
        )
        same = sent.keys() & received.keys()
        assert len(same) > 30
        assert max(abs(sent[end] - received[end]) for end in same) < 1_000_000  # 1 ms: clocks are read, numbers rounded


def test_each_message_is_one_picture_and_keyframes_bring_their_parameters(tod, filmed, tmp_path):
    drive, _ = filmed
    tod("export", str(drive), f"output={tmp_path / 'out.mcap'}")
    _, _, pictures = messages(tmp_path / "out.mcap")["/front/video"]
    for picture in pictures:
        data = fields(picture.data)[3]
        assert data.startswith((b"\0\0\0\1", b"\0\0\1"))
        kinds = [part[0] & 31 for part in data.split(b"\0\0\1")[1:]]
        assert sum(kind in (1, 5) for kind in kinds) == 1  # the encoder makes one slice per picture
        assert 5 not in kinds or {7, 8} <= set(kinds)
    assert 5 in [part[0] & 31 for part in fields(pictures[0].data)[3].split(b"\0\0\1")[1:]]


def keys_of(units):
    """Which access units are key frames."""
    return [5 in [part[0] & 31 for part in unit.split(b"\0\0\1")[1:]] for unit in units]


def test_video_is_encoded_again_with_key_frames(tod, filmed, tmp_path):
    """Each picture at its own time; over the change of size within a file."""
    drive, _ = filmed
    plain, again = tmp_path / "plain.mcap", tmp_path / "again.mcap"
    assert tod("export", str(drive), f"output={plain}").status == 0
    done = tod("export", str(drive), f"output={again}", "key_interval_s=0.5")
    assert done.status == 0, done.err
    said = "video is encoded again, with a key frame every 0.5 s: it is not what was sent"
    assert said in done.err.splitlines()
    for topic, (_, _, pictures) in messages(plain).items():
        if not topic.endswith("/video"):
            continue
        _, _, encoded = messages(again)[topic]
        times = [picture.log_time for picture in pictures]
        assert [picture.log_time for picture in encoded] == pytest.approx(times, abs=20_000)
        units = [fields(picture.data)[3] for picture in encoded]
        keys = [at for at, key in zip(times, keys_of(units), strict=True) if key]
        gaps = [later - earlier for earlier, later in pairwise([*keys, times[-1]])]
        frame_ns = max(later - earlier for earlier, later in pairwise(times))
        assert max(gaps) < 500_000_000 + frame_ns
        assert len(keys) > sum(keys_of(fields(picture.data)[3] for picture in pictures))
        written = tmp_path / "again.h264"
        written.write_bytes(b"".join(units))
        assert counted(written) == (len(units), len(units))


@pytest.mark.parametrize("form", ["mcap", "rosbag2"])
def test_an_export_is_a_source(tod, filmed, tmp_path, form):
    """Its video in either format, played as recorded: all pictures, and the position."""
    from runner.bag import POSITIONS, Bag, PictureForm

    drive, _ = filmed
    output = tmp_path / ("out.mcap" if form == "mcap" else "out")
    assert tod("export", str(drive), f"output={output}", f"format={form}").status == 0
    with Bag(output) as bag:
        pictures = list(bag.pictures("/front/video"))
        found = bag.form("/front/video")
        assert isinstance(found, PictureForm)
        assert (found.format, found.width, found.height) == ("h264", 320, 180)
        assert bag.of(POSITIONS) == []
    kept = sum(counted(drive / f"video/front.vehicle.{n}.ts")[0] for n in range(2))
    assert len(pictures) == kept
    words = ["vehicle=delivery_robot", "source=bag", "~cameras.rear", "~cameras.mast", f"source.bag={output}"]
    done = run("record", *words, "cameras.front.topic=/front/video", f"output={tmp_path}/rec", timeout=60)
    assert done.returncode == 0, done.stderr
    recorded = json.loads((tmp_path / "rec" / "recording.json").read_text())["cameras"]["front"]
    assert recorded["frames"] + recorded["left_out_frames"] == kept  # those beyond the camera's rate are left out


def test_a_video_that_is_missing_or_damaged_is_reported_and_the_rest_exported(tod, filmed, tmp_path):
    drive = tmp_path / "drive"
    shutil.copytree(filmed[0], drive)
    (drive / "video/front.vehicle.0.ts").unlink()
    (drive / "video/rear.vehicle.0.ts").write_bytes(b"no video" * 9999)
    (drive / "video/rear.vehicle.1.ts").write_bytes(b"")
    cut = drive / "video/front.operator.1.ts"
    cut.write_bytes(cut.read_bytes()[:20_000])
    done = tod("export", str(drive))
    assert done.status == 0
    warnings = sorted(line for line in done.err.splitlines() if "video/" in line)
    assert warnings == [
        f"{drive}/video/front.vehicle.0.ts: no such file; the export continues without it",
        f"{drive}/video/rear.vehicle.0.ts: contains no readable video; the export continues without it",
        f"{drive}/video/rear.vehicle.1.ts: contains no readable video; the export continues without it",
    ]
    topics = messages(drive / "drive.mcap")
    assert "/rear/video" not in topics
    assert len(topics["/front/video"][2]) == counted(drive / "video/front.vehicle.1.ts")[0]
    whole = counted(drive / "video/front.operator.0.ts")[0]
    assert whole < len(topics["/front/video_received"][2]) < whole + 60


# --- lines ------------------------------------------------------------------------------------------------------------


def test_lines_become_messages_with_their_schemas_on_one_clock(tod, tmp_path):
    drive = tmp_path / "drive"
    write(drive, "drive.jsonl", began("vehicle"), *VEHICLE, ENDED)
    write(drive, "operator.jsonl", began("operator", BEGAN + 1), SAMPLE, {"t": 0.5, "log": "note", "text": "hm"}, ENDED)
    link = {"t": 0.1, "log": "link", "kbps": 3000, "queue_ms": 4.5, "bytes": 1, "packets": 1, "dropped": 0}
    write(drive, "link.jsonl", began("link"), link, link | {"lane": "b"}, ENDED)
    done = tod("export", str(drive))
    assert (done.status, done.err) == (0, "")
    topics = messages(drive / "drive.mcap")
    assert done.out.startswith(f"{drive}/drive.mcap: {sum(len(found) for *_, found in topics.values())} messages, ")
    assert set(topics) == {
        "/position",
        "/notes",
        "/events/clock_advanced",
        "/events/position_reported",
        "/events/bitrate_predicted",
        "/telemetry",
        "/operator/sample",
        "/link",
        "/link/b",
    }
    for topic, (schema, channel, found) in topics.items():
        if channel.message_encoding != "json":
            continue
        assert schema.encoding == "jsonschema"
        document = json.loads(schema.data)
        assert document["type"] == "object"
        assert "$ref" not in schema.data.decode()
        for message in found:
            line = json.loads(message.data)
            Draft202012Validator(document).validate(line)
            start = BEGAN + 1 if "operator" in topic else BEGAN
            assert message.log_time == round(start * 1e9) + round(line["t"] * 1e9)
    telemetry = json.loads(topics["/telemetry"][0].data)["properties"]["cameras"]
    assert list(telemetry["properties"]) == list(CAMERAS)
    notes = [fields(note.data) for note in topics["/notes"][2]]
    assert [(note[4], note[3]) for note in notes] == [(b"vehicle", b"front: pipeline built"), (b"operator", b"hm")]


def test_positions_are_location_fixes(tod, tmp_path):
    drive = tmp_path / "drive"
    write(drive, "drive.jsonl", began("vehicle"), *VEHICLE, ENDED)
    write(drive, "operator.jsonl", began("operator"), SAMPLE, ENDED)
    tod("export", str(drive))
    schema, _, fixes = messages(drive / "drive.mcap")["/position"]
    assert schema.name == "foxglove.LocationFix"
    found = [fields(fix.data) for fix in fixes]
    assert [(number(fix[1]), number(fix[2])) for fix in found] == [(48.26, 11.66), (48.27, 11.66)]
    times = [round(BEGAN * 1e9) + round(t * 1e9) for t in (0.5, 1.5)]
    assert [fix.log_time for fix in fixes] == times == [stamp(fix[6]) for fix in found]
    with (drive / "drive.mcap").open("rb") as file:
        began_with = {m.name: m.metadata for m in reader.make_reader(file, validate_crcs=True).iter_metadata()}
    assert json.loads(began_with["vehicle began"]["config"])["name"] == "delivery_robot"
    assert math.isclose(json.loads(began_with["operator began"]["time"]), BEGAN)


def test_an_operator_alone_knows_the_position_too(tod, tmp_path):
    drive = tmp_path / "drive"
    write(drive, "operator.jsonl", began("operator"), SAMPLE, {**SAMPLE, "t": 0.5, "position": None}, ENDED)
    tod("export", str(drive))
    (fix,) = messages(drive / "drive.mcap")["/position"][2]
    assert number(fields(fix.data)[1]) == 48.5


def test_the_chunks_are_compressed_and_in_the_order_of_time(tod, tmp_path):
    drive = tmp_path / "drive"
    ticks = [{"t": n / 10, "event": "clock_advanced"} for n in range(30_000)]
    write(drive, "drive.jsonl", began("vehicle"), *ticks, ENDED)
    write(drive, "operator.jsonl", began("operator"), *({**SAMPLE, "t": n / 4} for n in range(2000)), ENDED)
    assert tod("export", str(drive)).status == 0
    with (drive / "drive.mcap").open("rb") as file:
        summary = reader.make_reader(file, validate_crcs=True).get_summary()
        file.seek(0)
        times = [m.log_time for *_, m in reader.make_reader(file).iter_messages(log_time_order=False)]
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
    assert len(summary.chunk_indexes) > 1
    assert times == sorted(times)
    assert len(times) == summary.statistics.message_count == 32_000


# --- errors -----------------------------------------------------------------------------------------------------------


def test_a_truncated_drive_is_reported_and_exported(tod, tmp_path):
    drive = tmp_path / "drive"
    write(drive, "drive.jsonl", began("vehicle"), *VEHICLE, end='\n{"t": 1.6, "ev')
    done = tod("export", str(drive))
    assert done.status == 0
    assert "line 8 is truncated" in done.err
    assert len(messages(drive / "drive.mcap")["/position"][2]) == 2


@pytest.mark.parametrize(
    "lines, expected",
    [
        (["{"], "drive.jsonl: line 1: not JSON: "),
        ([json.dumps(began("vehicle")), "garbage", "{}"], "drive.jsonl: line 2: not JSON: "),
        ([json.dumps({"t": 0, "event": "clock_advanced"})], "drive.jsonl: line 1: not the first line of a drive log"),
        ([json.dumps(began("vehicle") | {"format": 9})], "drive.jsonl: line 1: format: 9: "),
        ([], "drive.jsonl: is empty"),
    ],
)
def test_an_invalid_drive_is_reported_in_one_line(tod, tmp_path, lines, expected):
    (tmp_path / "drive.jsonl").write_text("".join(f"{line}\n" for line in lines))
    done = tod("export", str(tmp_path))
    assert (done.status, done.out, done.err.count("\n")) == (2, "", 1)
    assert done.err.startswith(f"{tmp_path}/{expected}")
    assert [path.name for path in tmp_path.iterdir()] == ["drive.jsonl"]


def test_invalid_exports(tod, tmp_path):
    drive = tmp_path / "drive"
    write(drive, "drive.jsonl", began("vehicle"), *VEHICLE, ENDED)
    (tmp_path / "empty").mkdir()
    (tmp_path / "there.mcap").write_text("precious")
    there = "already exists; remove it, or choose another path with output="
    name = "must name one drive: a directory that log= wrote"
    for words, expected in (
        ([], "command line: DRIVE: must be given: a directory that log= wrote"),
        ([str(drive), str(drive)], f"command line: {drive} {drive}: {name}"),
        ([f"{tmp_path}/none"], f"{tmp_path}/none: no such directory"),
        ([f"{tmp_path}/empty"], f"{tmp_path}/empty: contains no drive log: neither drive.jsonl nor operator.jsonl"),
        (
            [str(drive), "mode=single"],
            "command line: mode=single: unknown argument; expected one of output, format, key_interval_s, conf",
        ),
        (
            [str(drive), f"output={tmp_path}/there.mcap"],
            f"command line: output: '{tmp_path}/there.mcap': {there}",
        ),
        (
            [str(drive), f"output={tmp_path}/none/x.mcap"],
            f"command line: output: '{tmp_path}/none/x.mcap': no such file or directory",
        ),
    ):
        done = tod("export", *words)
        assert (done.status, done.out, done.err) == (2, "", f"{expected}\n")
    assert (tmp_path / "there.mcap").read_text() == "precious"
    assert [path.name for path in drive.iterdir()] == ["drive.jsonl"]


def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path, monkeypatch, capfd):
    """The output goes to a device without space."""
    from runner.__main__ import main

    drive = tmp_path / "drive"
    write(drive, "drive.jsonl", began("vehicle"), *VEHICLE, ENDED)
    original = Path.open

    def full(path, mode="r", *args, **kwargs):
        if mode != "xb":
            return original(path, mode, *args, **kwargs)
        path.symlink_to("/dev/full")
        return original(path, "wb", *args, **kwargs)

    monkeypatch.setattr(Path, "open", full)
    assert main(["export", str(drive)]) == 1
    assert capfd.readouterr().err.splitlines() == [f"{drive}/drive.mcap: no space left on device"]
    assert [path.name for path in drive.iterdir()] == ["drive.jsonl"]


# --- a ROS 2 bag ------------------------------------------------------------------------------------------------------


def bag_messages(path):
    """By topic: type, and time and content of its messages, as an independent program reads them."""
    from rosbags.highlevel import AnyReader

    topics = {}
    with AnyReader([path]) as opened:
        for connection, ns, data in opened.messages():
            known = topics.setdefault(connection.topic, (connection.msgtype, []))[1]
            known.append((ns, opened.deserialize(data, connection.msgtype)))
    return topics


def stamped(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def test_a_ros_2_bag_has_the_same_content_as_the_mcap_file(tod, filmed, tmp_path):
    pytest.importorskip("rosbags")
    drive = tmp_path / "drive"
    shutil.copytree(filmed[0], drive)
    log = drive / "drive.jsonl"
    first, *rest = log.read_text().splitlines()
    more = sorted([*VEHICLE, *map(json.loads, rest)], key=lambda line: line["t"])
    log.write_text("\n".join([first, *map(json.dumps, more)]) + "\n")
    mcap, ros = tod("export", str(drive)), tod("export", str(drive), "format=rosbag2")
    assert (mcap.status, ros.status) == (0, 0), ros.err
    topics, same = bag_messages(drive / "rosbag2"), messages(drive / "drive.mcap")
    assert topics.keys() == same.keys()
    for topic, (kind, found) in topics.items():
        assert [ns for ns, _ in found] == [message.log_time for message in same[topic][2]]
        if topic == "/position":
            assert kind == "sensor_msgs/msg/NavSatFix"
            assert [(m.latitude, m.longitude, m.status.status) for _, m in found] == [
                (48.26, 11.66, 0),
                (48.27, 11.66, 0),
            ]
            assert [stamped(m) for _, m in found] == [ns for ns, _ in found]
        elif topic.startswith(("/front", "/rear")):
            assert kind == "sensor_msgs/msg/CompressedImage"
            assert [stamped(m) for _, m in found] == [ns for ns, _ in found]
            assert {(m.format, m.header.frame_id) for _, m in found} == {("h264", topic.split("/")[1])}
            assert [m.data.tobytes() for _, m in found] == [fields(message.data)[3] for message in same[topic][2]]
        elif topic == "/notes":
            assert [json.loads(m.data) for _, m in found] == [VEHICLE[4]]
        else:
            assert kind == "std_msgs/msg/String"
            assert [m.data.encode() for _, m in found] == [message.data for message in same[topic][2]]
    assert ros.out.startswith(f"{drive}/rosbag2: {sum(len(found) for _, found in topics.values())} messages, ")
    again = tod("export", str(drive), "format=rosbag2")
    rule = "already exists; remove it, or choose another path with output="
    assert (again.status, again.err) == (2, f"command line: output: '{drive}/rosbag2': {rule}\n")
    assert sorted(path.name for path in drive.iterdir() if path.name.startswith(".")) == []


def test_a_bag_that_cannot_be_written_is_reported(tod, tmp_path):
    pytest.importorskip("rosbags")
    write(tmp_path / "drive", "drive.jsonl", began("vehicle"), *VEHICLE, ENDED)
    done = tod("export", str(tmp_path / "drive"), "format=rosbag2", f"output={tmp_path}/none/bag")
    assert (done.status, done.err) == (
        2,
        f"command line: output: '{tmp_path}/none/bag': no such file or directory\n",
    )


def test_a_time_that_ros_2_cannot_express_is_reported(tod, tmp_path):
    pytest.importorskip("rosbags")
    write(tmp_path / "drive", "drive.jsonl", began("vehicle") | {"time": 4e9}, *VEHICLE, ENDED)
    done = tod("export", str(tmp_path / "drive"), "format=rosbag2")
    rule = "the bag cannot be written: times of ROS 2 end in January 2038, this drive's are later\n"
    assert (done.status, done.err) == (1, rule)
