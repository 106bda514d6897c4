"""Bags as other programs write them: each kind was reported in public, see docs/sources.md."""

from __future__ import annotations

import base64
import json

import numpy as np
import pytest

pytest.importorskip("rosbags")

from bags import BEGAN_NS, IMAGE, compressed, image, typestore, write_bag, write_mcap
from numbered import encoded
from test_bag_source import road, shown, units, video_bag

from runner.bag import Bag, check_topic
from runner.core.model import ModelError

pytestmark = [pytest.mark.gst, pytest.mark.soak, pytest.mark.sources]

STORE = typestore("mcap")
STEP_NS = 40_000_000


def files_of(frames, kind):
    import cv2

    return [cv2.imencode(f".{kind}", np.ascontiguousarray(frame))[1].tobytes() for frame in frames]


def compressed_bag(path, kind, files, form):
    store = typestore(kind)
    stamps = [BEGAN_NS + n * STEP_NS for n in range(len(files))]
    messages = [(ns, compressed(store, ns, data, form)) for ns, data in zip(stamps, files, strict=True)]
    return write_bag(path, kind, {"/a": messages})


def looks_like(pictures, wanted, most=4.0):
    for picture, rgb in zip(pictures, wanted, strict=True):
        assert np.abs(picture.astype(int) - rgb).mean() < most


# --- pictures ---------------------------------------------------------------------------------------------------------

TRANSPORTED = {  # by image_transport, whose format names the encodings before and in the file
    ("rgb8; jpeg compressed bgr8", "jpg"),
    ("bgr8; jpeg compressed bgr8", "jpg"),
    ("rgb8; png compressed bgr8", "png"),
    ("rgb8; jpeg compressed", "jpg"),
    ("rgb8", "jpg"),  # of drivers that name the encoding of their raw topic
    ("jpg", "png"),
    ("", "jpg"),
}


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
@pytest.mark.parametrize(("form", "suffix"), sorted(TRANSPORTED))
def test_the_bytes_say_what_a_compressed_picture_is(tmp_path, kind, form, suffix):
    frames = road(3)
    bag = compressed_bag(tmp_path / "b", kind, files_of(frames, suffix), form)
    pictures, times = shown(bag, "/a")
    assert times == [n * STEP_NS for n in range(3)]
    looks_like(pictures, [frame[..., ::-1] for frame in frames])


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_a_compressed_bayer_pattern_is_shown_in_colour(tmp_path, pattern, suffix):
    """Image_transport of ROS 1 compresses the pattern as grey; that of ROS 2 converts it to grey, and says so."""
    mosaics, wanted = zip(*(encoded(frame, f"bayer_{pattern}8") for frame in road(3)), strict=True)
    said = {"jpg": "jpeg", "png": "png"}[suffix]
    files = files_of(mosaics, suffix)
    bag = compressed_bag(tmp_path / "b", "ros1", files, f"bayer_{pattern}8; {said} compressed ")
    pictures, times = shown(bag, "/a")
    assert times == [n * STEP_NS for n in range(3)]
    looks_like(pictures, wanted, 6.0)
    grey = compressed_bag(tmp_path / "grey", "mcap", files, f"bayer_{pattern}8; {said} compressed mono8")
    looks_like(shown(grey, "/a")[0], [np.repeat(mosaic, 3, 2) for mosaic in mosaics])


@pytest.mark.parametrize("packing", ["BZ2", "LZ4"])
@pytest.mark.parametrize("encoding", ["bayer_grbg8", "8UC1", "bgra8", "16UC1"])
def test_raw_pictures_of_compressed_bags_of_ros_1(tmp_path, packing, encoding):
    """Rows padded, as drivers of some cameras align them."""
    from rosbags.rosbag1 import Writer

    store, frames = typestore("ros1"), road(4)
    data, wanted = zip(*(encoded(frame, encoding) for frame in frames), strict=True)
    writer = Writer(tmp_path / "b.bag")
    writer.set_compression(Writer.CompressionFormat[packing])
    with writer:
        connection = writer.add_connection("/a", IMAGE, typestore=store)
        for number, picture in enumerate(data):
            ns = BEGAN_NS + number * STEP_NS
            message = image(store, ns, picture, encoding, padding=32)
            writer.write(connection, ns, store.serialize_ros1(message, IMAGE))
    pictures, times = shown(tmp_path / "b.bag", "/a")
    assert times == [n * STEP_NS for n in range(4)]
    looks_like(pictures, wanted)


@pytest.mark.parametrize("form", ["16UC1; compressedDepth", "16UC1; compressedDepth png", "16UC1; png compressed "])
def test_compressed_distances_are_refused_by_name(tmp_path, form):
    """Not shown as the upper eight bits of millimetres, which are black."""
    depth = [np.full((54, 96), 1000 * (n + 1), np.uint16) for n in range(3)]
    header = bytes(12) if "compressedDepth" in form else b""
    bag = compressed_bag(tmp_path / "b", "mcap", [header + data for data in files_of(depth, "png")], form)
    rule = f"picture 1: compressed distances, '{form}', are not supported; expected the topic of the raw ones"
    with pytest.raises(ModelError) as raised:
        check_topic(bag, "/a")
    assert raised.value.rule == rule


# --- video ------------------------------------------------------------------------------------------------------------


def once_stated(coded):
    """Units of which only the first has parameter sets, as encoders write without `repeat headers`."""
    return [
        coded[0],
        *(b"\0\0\0\1".join(part for part in unit.split(b"\0\0\0\1") if not is_set(part)) for unit in coded[1:]),
    ]


def is_set(part):
    return bool(part) and part[0] & 31 in (7, 8)


def delimited(coded):
    return [unit if unit[4] & 31 == 9 else b"\0\0\0\1\x09\xf0" + unit for unit in coded]


@pytest.mark.parametrize("writer", ["CompressedImage", "foxglove", "json", "foxglove_msgs"])
@pytest.mark.parametrize("habit", ["parameter sets once", "access unit delimiters", "one key picture"])
def test_habits_of_encoders_in_each_type(tmp_path, writer, habit):
    if writer == "foxglove":
        pytest.importorskip("foxglove")
    frames = road(12)
    coded = units(frames, "h264", "key-int-max=500" if habit == "one key picture" else "key-int-max=5")
    coded = {"parameter sets once": once_stated, "access unit delimiters": delimited}.get(habit, list)(coded)
    bag = video_bag(tmp_path / "b", writer, coded, "h264")
    pictures, times = shown(bag, "/video")
    assert times == [n * STEP_NS for n in range(12)]
    looks_like(pictures, [frame[..., ::-1] for frame in frames], 6.0)


def test_json_without_format_is_refused_by_its_cause(tmp_path):
    """Schema and messages name no codec: only the channel's metadata does, as no convention has it."""
    lines = [
        {"timestamp": {"sec": n, "nsec": 0}, "frame_id": "a", "data": base64.b64encode(data).decode()}
        for n, data in enumerate(units(road(3), "h264"), 1)
    ]
    messages = [("/a", BEGAN_NS + n, json.dumps(line).encode()) for n, line in enumerate(lines)]
    schemas = {"/a": ("foxglove.CompressedVideo", "jsonschema", b'{"type": "object"}')}
    bag = write_mcap(tmp_path / "b.mcap", messages, schemas, encodings={"/a": "json"}, profile="")
    with pytest.raises(ModelError) as raised:
        check_topic(bag, "/a")
    assert raised.value.rule == "picture 1: format '' is not supported; expected h264 or h265"


# --- other libraries --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("packing", ["NONE", "LZ4", "ZSTD"])
def test_what_the_writer_for_ros_2_of_mcap_writes_is_read(tmp_path, packing):
    ros2 = pytest.importorskip("mcap_ros2.writer")
    from mcap.writer import CompressionType

    text = typestore("mcap").generate_msgdef(IMAGE, ros_version=2)[0]
    frames = road(4)
    with (tmp_path / "b.mcap").open("wb") as file:
        writer = ros2.Writer(file, compression=CompressionType[packing])
        schema = writer.register_msgdef("sensor_msgs/Image", text)
        for number, frame in enumerate(frames):
            ns = BEGAN_NS + number * STEP_NS
            message = {
                "header": {"stamp": dict(zip(("sec", "nanosec"), divmod(ns, 10**9), strict=True)), "frame_id": "a"},
                **{"height": 54, "width": 96, "encoding": "bgr8", "is_bigendian": 0, "step": 288},
                "data": frame.tobytes(),
            }
            writer.write_message("/a", schema, message, ns, ns, number)
        writer.finish()
    with Bag(tmp_path / "b.mcap") as opened:
        assert opened.topics == {"/a": IMAGE}
    pictures, times = shown(tmp_path / "b.mcap", "/a")
    assert times == [n * STEP_NS for n in range(4)]
    looks_like(pictures, [frame[..., ::-1] for frame in frames])
