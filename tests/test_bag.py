"""Bags without ROS: what is read from them, and messages about invalid ones."""

from __future__ import annotations

import re
import tracemalloc
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rosbags")

from bags import (
    BEGAN_NS,
    IMAGE,
    KINDS,
    camera_bag,
    compressed,
    definition,
    filmed,
    fix,
    image,
    packed,
    typestore,
    write_bag,
    write_mcap,
    write_metadata,
)
from shared_data import shared

from runner.bag import POSITIONS, Bag, PictureForm, check_topic, is_bag
from runner.bag.messages import decoder
from runner.bag.pictures import image_format, read_compressed, read_image
from runner.bag.storage import Channel
from runner.core.model import ModelError

ROAD = "video/forward_highway_day_540p25_A.mp4"
SIZE = (162, 90)  # rows of 486 bytes, which GStreamer pads
STORE = typestore("mcap")
PIXELS = np.zeros((2, 2, 1), np.uint8)
ROBOT = ("vehicle=delivery_robot", "source=bag")


@pytest.fixture(scope="module")
def frames():
    return filmed(shared(ROAD), 12, SIZE)


@pytest.fixture(scope="module", params=KINDS)
def bag(request, frames, tmp_path_factory):
    path = tmp_path_factory.mktemp(request.param) / "road"
    return camera_bag(path, request.param, {"/a/image_raw": frames, "/b/image_raw": frames[::-1]}, 25)


def rows(picture, pixel):
    """The pixels of a picture without the padding of its rows."""
    padded = np.frombuffer(picture.data, np.uint8).reshape(picture.height, -1)
    assert padded.shape[1] % 4 == 0
    return padded[:, : picture.width * pixel].reshape(picture.height, picture.width, pixel)


def test_pictures_come_as_they_were_written(bag, frames):
    assert is_bag(bag)
    with Bag(bag) as opened:
        assert list(opened.topics) == ["/a/image_raw", "/b/image_raw"]
        assert opened.form("/a/image_raw") == PictureForm("BGR", *SIZE, Fraction(25))
        for topic, order in (("/a/image_raw", frames), ("/b/image_raw", frames[::-1])):
            pictures = list(opened.pictures(topic))
            assert [p.ns for p in pictures] == [BEGAN_NS + 40_000_000 * n for n in range(12)]
            for picture, frame in zip(pictures, order, strict=True):
                assert (rows(picture, 3) == frame).all()


@pytest.mark.parametrize(("fps", "rate"), [(9.93, 10), (10.08, 10), (10.5, Fraction(21, 2)), (0.4, Fraction(2, 5))])
def test_a_rate_close_to_a_whole_number_is_rounded(tmp_path, fps, rate):
    made = camera_bag(tmp_path / "bag", "mcap", {"/image": [np.zeros((16, 16, 3), np.uint8)] * 11}, fps)
    with Bag(made) as opened:
        assert opened.form("/image").fps == rate


def test_a_bag_without_ends_of_file_is_reported(bag, tmp_path):
    files = [bag] if bag.is_file() else [file for file in bag.iterdir() if file.suffix != ".yaml"]
    (file,) = files
    cut = tmp_path / file.name
    cut.write_bytes(file.read_bytes()[:-5000])
    with pytest.raises(ModelError) as raised, Bag(cut) as opened:
        list(opened.pictures("/a/image_raw"))
    assert raised.value.key in ("bag", "topic")
    assert str(raised.value.found).startswith(str(cut))
    assert raised.value.rule.startswith("cannot be read, damaged or cut off: ")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("encoding", "form", "pixel"),
    [
        ("mono8", "GRAY8", 1),
        ("mono16", "GRAY16_LE", 2),
        ("rgb8", "RGB", 3),
        ("bgr8", "BGR", 3),
        ("rgba8", "RGBA", 4),
        ("bgra8", "BGRA", 4),
        ("yuv422", "UYVY", 2),
        ("uyvy", "UYVY", 2),
        ("yuv422_yuy2", "YUY2", 2),
        ("yuyv", "YUY2", 2),
    ],
)
@pytest.mark.parametrize("padding", [0, 10])
def test_rows_have_their_own_padding(encoding, form, pixel, padding):
    pixels = np.random.default_rng(7).integers(0, 256, (6, 10, pixel), np.uint8)
    picture = read_image(image(STORE, BEGAN_NS, pixels, encoding, padding))
    assert (picture.format, picture.width, picture.height, picture.ns) == (form, 10, 6, BEGAN_NS)
    assert (rows(picture, pixel) == pixels).all()


def test_the_byte_order_of_mono16_is_kept():
    pixels = np.zeros((2, 2, 2), np.uint8)
    assert read_image(image(STORE, 1, pixels, "mono16", big=True)).format == "GRAY16_BE"


def test_a_picture_without_stamp_has_the_time_of_its_recording(tmp_path):
    path = write_bag(tmp_path / "b", "mcap", {"/a": [(BEGAN_NS, image(STORE, 0, PIXELS, "mono8"))]})
    with Bag(path) as opened:
        (picture,) = opened.pictures("/a")
    assert (picture.ns, picture.stamped) == (BEGAN_NS, False)


@pytest.mark.parametrize(
    ("message", "rule"),
    [
        (image(STORE, 1, PIXELS, "64FC1"), "encoding '64FC1' is not supported; expected one of mono8, mono16, "),
        (compressed(STORE, 1, b"xyz", "tiff"), "format 'tiff' is not supported; expected JPEG or PNG"),
        (compressed(STORE, 1, b"\xff\xd8\xff\xd9", "jpeg"), "a JPEG picture without frame header"),
        (
            compressed(STORE, 1, b"\x89PNG\r\n\x1a\n" + bytes(8) + b"\0\0\xea\x60" * 2, "png"),
            "a picture of 60000x60000, must have at most 100000000 pixels",
        ),
        (image(STORE, 1, PIXELS[:, :1], "rgb8"), "a picture of 1x2 with rows of 1 bytes, must be at least 3"),
    ],
)
def test_pictures_that_cannot_be_shown_are_named(tmp_path, message, rule):
    path = write_bag(tmp_path / "b", "mcap", {"/a": [(BEGAN_NS, message)]})
    with pytest.raises(ModelError) as raised:
        check_topic(path, "/a")
    assert raised.value.found == f"{path}: /a"
    assert raised.value.rule.startswith(f"picture 1: {rule}")


def test_a_picture_that_lacks_bytes_is_refused():
    message = image(STORE, 1, np.zeros((4, 4, 3), np.uint8), "rgb8")
    message.data = message.data[:-1]
    with pytest.raises(ValueError, match=r"^a picture of 47 bytes, must have 48: 4 rows of 12$"):
        read_image(message)


def test_compressed_bayer_patterns_are_known_by_their_format(frames):
    """Image_transport of ROS 1 names no target and compresses the pattern; where a target follows, it converted."""
    import cv2

    grey = np.ascontiguousarray(frames[0][..., 0])
    jpeg, png = (cv2.imencode(f".{kind}", grey)[1].tobytes() for kind in ("jpg", "png"))
    for data, stated, form in (
        (jpeg, "bayer_rggb8; jpeg compressed ", "jpeg-rggb"),
        (png, "bayer_grbg8; png compressed ", "png-grbg"),
        (jpeg, "bayer_rggb8; jpeg compressed mono8", "jpeg"),
        (jpeg, "mono8; jpeg compressed ", "jpeg"),
    ):
        assert read_compressed(compressed(STORE, 1, data, stated)).format == form


@pytest.mark.parametrize("form", ["16UC1; compressedDepth", "32FC1; compressedDepth png", "16UC1; png compressed "])
def test_compressed_distances_are_refused(form):
    """The upper eight bits of millimetres are black."""
    rule = f"compressed distances, '{form}', are not supported; expected the topic of the raw ones"
    with pytest.raises(ValueError, match=f"^{re.escape(rule)}$"):
        read_compressed(compressed(STORE, 1, b"\x89PNG", form))


def test_sizes_of_compressed_pictures(tmp_path, frames):
    import cv2

    files = [(kind, cv2.imencode(f".{kind}", frames[0])[1].tobytes()) for kind in ("jpg", "png")]
    topics = {f"/{kind}": [(1, compressed(STORE, BEGAN_NS, data, kind))] for kind, data in files}
    with Bag(write_bag(tmp_path / "b", "sqlite3", topics)) as opened:
        for (kind, data), form in zip(files, ("jpeg", "png"), strict=True):
            (picture,) = opened.pictures(f"/{kind}")
            assert (picture.format, picture.width, picture.height, picture.data) == (form, *SIZE, data)


@pytest.mark.parametrize("kind", KINDS)
def test_positions_are_those_with_a_fix(tmp_path, kind):
    store = typestore(kind)
    fixes = [(48.1, 11.5, 0), (48.2, 11.6, -1), (float("nan"), 11.6, 0), (48.3, 11.7, 2), (0.0, 0.0, -2)]
    messages = [(BEGAN_NS + n, fix(store, BEGAN_NS + n, *one)) for n, one in enumerate(fixes)]
    with Bag(write_bag(tmp_path / "b", kind, {"/gps": messages})) as opened:
        topic = opened.find(POSITIONS, None, "positions")
        assert list(opened.positions(topic)) == [(BEGAN_NS, 48.1, 11.5), (BEGAN_NS + 3, 48.3, 11.7)]


# --- files of other writers -------------------------------------------------------------------------------------------

COUNT = 20
IDL = f"""{"=" * 80}
IDL: sensor_msgs/msg/Image
module sensor_msgs {{ module msg {{ struct Image {{
  std_msgs::msg::Header header; uint32 height; uint32 width; string encoding; uint8 is_bigendian; uint32 step;
  sequence<uint8> data; }}; }}; }};
{"=" * 80}
IDL: std_msgs/msg/Header
module std_msgs {{ module msg {{ struct Header {{ builtin_interfaces::msg::Time stamp; string frame_id; }}; }}; }};
{"=" * 80}
IDL: builtin_interfaces/msg/Time
module builtin_interfaces {{ module msg {{ struct Time {{ int32 sec; uint32 nanosec; }}; }}; }};
"""
QOS = "- history: 1\n  depth: 5\n  reliability: 1\n  durability: 2\n"


def recorded(count=COUNT):
    """Small pictures, 10 a second: topic, time and bytes; each shows its number."""
    times = [BEGAN_NS + n * 100_000_000 for n in range(count)]
    return [("/a", ns, packed(image(STORE, ns, PIXELS + n, "mono8"))) for n, ns in enumerate(times)]


def numbers(path, topic="/a"):
    """The numbers that the pictures of a topic show."""
    with Bag(path) as opened:
        assert topic in opened.topics
        return [picture.data[0] for picture in opened.pictures(topic)]


def mcap_options(name):
    from mcap.writer import CompressionType, IndexType

    return {
        "no message index": {"index_types": IndexType.CHUNK, "chunk_size": 200},
        "no index": {"index_types": IndexType.NONE, "chunk_size": 200},
        "no summary": {
            **{"index_types": IndexType.NONE, "repeat_channels": False, "repeat_schemas": False},
            **{"use_statistics": False, "use_summary_offsets": False, "chunk_size": 200},
        },
        "no statistics": {"use_statistics": False, "chunk_size": 200},
        "nothing repeated": {"repeat_channels": False, "repeat_schemas": False, "chunk_size": 200},
        "lz4": {"compression": CompressionType.LZ4},
        "no chunks": {"use_chunking": False},
        "another profile": {"profile": ""},
    }[name]


MCAP_KINDS = (
    *("no message index", "no index", "no summary", "no statistics", "nothing repeated", "lz4", "no chunks"),
    "another profile",
)


@pytest.mark.parametrize("name", MCAP_KINDS)
def test_an_mcap_of_any_writer_is_read_whole_and_in_order(tmp_path, name):
    messages = recorded()
    messages[3:5] = messages[4], messages[3]  # as recorders with several threads write
    messages[11:16] = reversed(messages[11:16])
    path = write_mcap(tmp_path / "b.mcap", messages, {"/a": definition(IMAGE)}, **mcap_options(name))
    assert numbers(path) == list(range(COUNT))


def test_messages_outside_chunks_are_read_beside_those_within(tmp_path):
    from mcap.writer import Writer

    path = tmp_path / "b.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "another program")
        channel = writer.register_channel("/a", "cdr", writer.register_schema(*definition(IMAGE)))
        for number, (_, ns, data) in enumerate(recorded()):
            if number == 12:
                writer._Writer__finalize_chunk()
                writer._Writer__chunk_builder, chunks = None, writer._Writer__chunk_builder
            if number == 13:
                writer._Writer__chunk_builder = chunks
            writer.add_message(channel, ns, data, ns)
        writer.finish()
    assert numbers(path) == list(range(COUNT))


@pytest.mark.parametrize("form", ["ros1msg", "ros2idl", "none"])
def test_definitions_of_each_kind_are_read(tmp_path, form):
    """Of ROS 1 in MCAP, of ROS 2 in IDL, and without one."""
    store = typestore("ros1" if form == "ros1msg" else "mcap")
    messages = [("/a", BEGAN_NS + n, image(store, BEGAN_NS + n, PIXELS + n, "mono8")) for n in range(3)]
    if form == "ros1msg":
        coded = [(topic, ns, bytes(store.serialize_ros1(m, IMAGE))) for topic, ns, m in messages]
        schema, encoding = definition(IMAGE, "ros1msg"), "ros1"
    else:
        coded = [(topic, ns, packed(m)) for topic, ns, m in messages]
        schema = (IMAGE, form, IDL.encode()) if form == "ros2idl" else (IMAGE, "", b"")
        encoding = "cdr"
    path = write_mcap(tmp_path / "b.mcap", coded, {"/a": schema}, encodings={"/a": encoding}, profile=form[:4])
    assert numbers(path) == [0, 1, 2]


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_types_of_foxglove_are_read(tmp_path, encoding):
    import base64
    import json

    pixels = bytes(range(6))
    at = {"sec": BEGAN_NS // 10**9, "nsec": BEGAN_NS % 10**9}
    if encoding == "protobuf":
        foxglove = pytest.importorskip("foxglove")
        from foxglove.channels import LocationFixChannel, RawImageChannel
        from foxglove.messages import LocationFix, RawImage, Timestamp

        path, context, stamp = tmp_path / "b.mcap", foxglove.Context(), Timestamp(**at)
        with foxglove.open_mcap(str(path), context=context):
            image_of = {"width": 2, "height": 1, "encoding": "rgb8", "step": 6, "data": pixels}
            RawImageChannel("/a", context=context).log(RawImage(timestamp=stamp, **image_of), log_time=BEGAN_NS)
            fix_of = {"latitude": 48.1, "longitude": 0.0}
            LocationFixChannel("/gps", context=context).log(LocationFix(timestamp=stamp, **fix_of), log_time=BEGAN_NS)
    else:
        image_of = {"width": 2, "height": 1, "encoding": "rgb8", "step": 6, "data": base64.b64encode(pixels).decode()}
        lines = [
            ("/a", {"timestamp": at, **image_of}),
            ("/a", {"timestamp": at, "width": "wide"}),
            ("/gps", {"timestamp": at, "latitude": 48.1, "longitude": 0}),
        ]
        messages = [(topic, BEGAN_NS + n, json.dumps(line).encode()) for n, (topic, line) in enumerate(lines)]
        schemas = {"/a": ("foxglove.RawImage", "jsonschema", b""), "/gps": ("foxglove.LocationFix", "jsonschema", b"")}
        path = write_mcap(tmp_path / "b.mcap", messages, schemas, encodings=dict.fromkeys(schemas, "json"))
    with Bag(path) as opened:
        picture, *bad = opened.pictures("/a")
        assert (picture.ns, picture.format, picture.size) == (BEGAN_NS, "RGB", "2x1")
        assert picture.data == pixels + bytes(2)
        assert [each.why[:20] for each in bad] == ([] if encoding == "protobuf" else ["a damaged message of"])
        assert list(opened.positions("/gps")) == [(BEGAN_NS, 48.1, 0.0)]


@pytest.mark.parametrize("other", ["jsonschema", "protobuf", "flatbuffer", "", None, "service"])
def test_other_messages_beside_pictures_do_not_matter(tmp_path, other):
    schemas = {"/a": definition(IMAGE), "/other": None if other is None else ("event", other, b"{}" if other else b"")}
    if other == "service":
        schemas["/other"] = ("example_interfaces/srv/AddTwoInts_Event", "ros2msg", b"a definition of no such form {")
    both = [each for pair in zip(recorded(), [("/other", BEGAN_NS, b"{}")] * COUNT, strict=True) for each in pair]
    path = write_mcap(tmp_path / "b.mcap", both, schemas, encodings={"/other": "json"})
    assert numbers(path) == list(range(COUNT))


@pytest.mark.parametrize("qos", ["", QOS])
@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_metadata_may_say_other_qos_and_list_files_in_any_order(tmp_path, qos, order):
    for n in range(3):
        part = recorded(21)[7 * n : 7 * n + 7]
        write_mcap(tmp_path / f"b_{n}.mcap", part, {"/a": definition(IMAGE)}, qos=qos)
    names = [f"b_{n}.mcap" for n in order]
    assert numbers(write_metadata(tmp_path, "/a", IMAGE, names, 21)) == list(range(21))
    (tmp_path / names[1]).unlink()
    with pytest.raises(ModelError, match=f"cannot be read: metadata.yaml names {names[1]}, which must be in the same"):
        Bag(tmp_path)


def test_metadata_that_knows_less_or_more_than_the_files_is_reported(tmp_path):
    """No file is left out without a word, and none is missing; one that ROS unpacked beside the packed one is known."""
    for n in range(2):
        write_mcap(tmp_path / f"b_{n}.mcap", recorded()[10 * n : 10 * n + 10], {"/a": definition(IMAGE)})
    write_metadata(tmp_path, "/a", IMAGE, ["b_0.mcap"], 20)
    with pytest.raises(ModelError, match=r"cannot be read: metadata.yaml does not name b_1.mcap: `ros2 bag reindex`"):
        Bag(tmp_path)
    (tmp_path / "b_1.mcap").rename(tmp_path / "b_0.mcap.zstd")
    with pytest.raises(ModelError, match=r"/a: cannot be read: metadata.yaml states 20 messages of this topic.* 10$"):
        numbers(tmp_path)
    assert numbers(write_metadata(tmp_path, "/a", IMAGE, ["b_0.mcap"], 10)) == list(range(10))


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
@pytest.mark.parametrize("mode", ["MESSAGE", "FILE"])
def test_a_compressed_bag_is_read_by_its_directory_and_by_its_file(tmp_path, kind, mode):
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    writer = Writer(tmp_path / "b", version=9, storage_plugin=plugin)
    writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/a", IMAGE, typestore=STORE)
        for _, ns, data in recorded():
            writer.write(connection, ns, data)
    (file,) = (path for path in (tmp_path / "b").iterdir() if path.suffix != ".yaml")
    alone = tmp_path / file.name
    alone.write_bytes(file.read_bytes())
    assert numbers(tmp_path / "b") == numbers(file) == numbers(alone) == list(range(COUNT))


def test_a_database_whose_recorder_was_killed_is_read_whole(tmp_path):
    import shutil
    import sqlite3

    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer

    recorder = sqlite3.connect(tmp_path / "b.db3", isolation_level=None)
    recorder.executescript(Sqlite3Writer.SQLITE_SCHEMA)
    recorder.execute(f"INSERT INTO topics VALUES(1, '/a', '{IMAGE}', 'cdr', '', '')")
    recorder.execute("PRAGMA journal_mode=WAL")
    recorder.execute("PRAGMA wal_autocheckpoint=0")
    for number, (_, ns, data) in enumerate(recorded(), 1):
        recorder.execute("INSERT INTO messages VALUES(?, 1, ?, ?)", (number, ns, data))
        if number == 8:
            recorder.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    (tmp_path / "killed").mkdir()
    for file in tmp_path.glob("b.db3*"):
        shutil.copy(file, tmp_path / "killed")
    recorder.close()
    assert numbers(tmp_path / "killed" / "b.db3") == list(range(COUNT))
    with pytest.raises(ModelError, match=r"has no metadata.yaml.*: name its file, b.db3$"):
        Bag(tmp_path / "killed")


def test_a_database_whose_recorder_was_killed_within_a_transaction_says_what_to_do(tmp_path):
    import shutil
    import sqlite3

    recorder = sqlite3.connect(tmp_path / "b.db3", isolation_level=None)
    recorder.executescript("PRAGMA cache_size=1; CREATE TABLE messages(data BLOB); BEGIN;")
    recorder.executemany("INSERT INTO messages VALUES(?)", [(bytes(4000),)] * 100)
    (tmp_path / "killed").mkdir()
    for file in tmp_path.glob("b.db3*"):
        shutil.copy(file, tmp_path / "killed")
    recorder.close()
    rule = "cannot be read: its recorder was killed while it wrote, and b.db3-journal holds .*: `sqlite3 b.db3 .tables`"
    with pytest.raises(ModelError, match=rule):
        Bag(tmp_path / "killed" / "b.db3")


def test_only_damaged_files_are_called_damaged(tmp_path):
    whole = write_mcap(tmp_path / "b.mcap", recorded(), {"/a": definition(IMAGE)})
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:-100])
    with pytest.raises(ModelError, match="cannot be read, damaged or cut off: it ends without the end of an MCAP file"):
        Bag(cut)
    schema = {"/a": ("sensor_msgs/msg/Image", "ros2msg", b"uint8[ data")}
    with (
        pytest.raises(ModelError, match="cannot be read: the definition of sensor_msgs/msg/Image cannot be read: "),
        Bag(write_mcap(tmp_path / "d.mcap", recorded(), schema)) as opened,
    ):
        list(opened.pictures("/a"))


def test_a_file_that_lacks_what_it_states_is_reported(tmp_path):
    """Its summary counts a message that no chunk has: no picture is missing without a word."""
    from mcap.writer import Writer

    class Forgetful(Writer):
        def finish(self):
            self._Writer__statistics.channel_message_counts[1] += 1
            self._Writer__statistics.message_count += 1
            super().finish()

    path = tmp_path / "b.mcap"
    with path.open("wb") as file:
        writer = Forgetful(file)
        writer.start("ros2", "another program")
        channel = writer.register_channel("/a", "cdr", writer.register_schema(*definition(IMAGE)))
        for _, ns, data in recorded():
            writer.add_message(channel, ns, data, ns)
        writer.finish()
    with pytest.raises(ModelError, match="it states 21 messages of this topic, and has 20"):
        numbers(path)


def test_pictures_that_cannot_be_shown_do_not_hide_the_others(tmp_path, frames):
    import cv2

    jpeg, png = (cv2.imencode(f".{kind}", frames[0])[1].tobytes() for kind in ("jpg", "png"))
    thumbnail = jpeg[:2] + b"\xff\xe1" + (len(jpeg) + 2).to_bytes(2) + jpeg + jpeg[2:]  # a JPEG in its EXIF
    pictures = {
        "whole": (jpeg, thumbnail, jpeg + bytes(50), png),
        "an empty picture": (b"",),
        "format 'jpeg' is not supported": (b"GIF89a", bytes(1000)),
        "a JPEG picture that is cut off or damaged": (
            *(jpeg[: len(jpeg) // 3], jpeg[:-2], thumbnail[:-30]),
            jpeg[:200] + bytes(300) + jpeg[500:],
        ),
        "a PNG picture that is cut off or damaged": (png[: len(png) // 2], png[:-5], png[:60] + b"\0" + png[61:]),
    }
    topics = [(data, why) for why, them in pictures.items() for data in them]
    messages = [(BEGAN_NS + n, compressed(STORE, BEGAN_NS + n, data, "jpeg")) for n, (data, _) in enumerate(topics)]
    with Bag(write_bag(tmp_path / "b", "mcap", {"/a": messages})) as opened:
        for picture, (data, why) in zip(opened.pictures("/a"), topics, strict=True):
            if why == "whole":
                assert (picture.data, picture.width, picture.height) == (data, *SIZE)
            else:
                assert picture.why.startswith(why)


def test_a_damaged_message_is_a_picture_that_cannot_be_shown(tmp_path):
    messages = recorded()
    messages[4] = ("/a", messages[4][1], messages[4][2][:30])
    with Bag(write_mcap(tmp_path / "b.mcap", messages, {"/a": definition(IMAGE)})) as opened:
        found = list(opened.pictures("/a"))
    assert [number for number, each in enumerate(found) if not hasattr(each, "data")] == [4]
    assert found[4].why.startswith("a damaged message of 30 bytes: ")


@pytest.mark.parametrize(
    ("encoding", "data"),
    [
        ("protobuf", b"\x08\x05"),  # a number as the time, as text and as bytes; bytes as seconds
        ("protobuf", b"\x22\x04rgb8\x20\x05"),
        ("protobuf", b"\x30\x05"),
        ("protobuf", b"\x0a\x03\x0a\x01x"),
        ("json", b'{"width": 1e400}'),
        ("json", b'{"timestamp": {"sec": 1e400}}'),
        ("json", b"[" * 2000),
    ],
    ids=["time", "text", "bytes", "seconds", "size", "infinite", "deep"],
)
def test_a_message_with_values_of_other_types_is_damaged(encoding, data):
    decode = decoder(Channel("/a", "foxglove.RawImage", encoding, ("", "")))
    with pytest.raises(ValueError, match=f"^a damaged message of {len(data)} bytes: "):
        decode(data)


@pytest.mark.parametrize("size", [(-2, 2), (2, -2), (-2, -2), (0, 2)])
def test_a_picture_has_a_size(size):
    form = SimpleNamespace(encoding="mono8", width=size[0], height=size[1], step=2)
    with pytest.raises(ValueError, match=f"^a picture of {size[0]}x{size[1]} with rows of 2 bytes, must be at least "):
        image_format(form, 100)


CHUNK = 1_000_000  # bytes


def test_chunks_are_held_only_while_they_are_read(tmp_path):
    """Although another topic makes all of them begin at once."""
    messages = [each for one in recorded(60) for each in (one, ("/other", 0, bytes(CHUNK)))]
    schemas = {"/a": definition(IMAGE), "/other": ("o", "jsonschema", b"{}")}
    path = write_mcap(tmp_path / "b.mcap", messages, schemas, encodings={"/other": "json"}, chunk_size=500)
    tracemalloc.start()
    try:
        assert numbers(path) == list(range(60))
        assert tracemalloc.get_traced_memory()[1] < 10 * CHUNK  # a chunk is held twice while it is decompressed
    finally:
        tracemalloc.stop()


# --- the command line -------------------------------------------------------------------------------------------------


def words(bag, **topics):
    return (*ROBOT, f"source.bag={bag}", *(f"cameras.{name}.topic={topic}" for name, topic in topics.items()))


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["print", "validate"])
def test_problems_of_a_bag_are_reported(tod, bag, verb, tmp_path):
    given = words(bag, front="/a/image_raw", rear="/a/image", mast="/b/image_raw")
    assert tod(verb, *given).problems == [
        f"command line: cameras.rear.topic: {bag}: /a/image: no such topic with pictures, did you mean /a/image_raw?"
    ]
    rule = f"{bag}: must be given, a topic with pictures: /a/image_raw, /b/image_raw"
    (problem,) = tod(verb, *words(bag, front="/a/image_raw", rear="/a/image_raw")).problems
    assert problem.startswith(f"conf/source/bag.yaml: topic: {rule}; see command line: source.bag=")
    assert tod(verb, *words(tmp_path / "none")).problems == [f"command line: source.bag: {tmp_path}/none: no such file"]


def test_print_shows_a_stand_in_and_says_so(tod, bag):
    result = tod("print", *words(bag, front="/a/image_raw", rear="/a/image_raw", mast="/b/image_raw"))
    assert "# videotestsrc stands in for the frames of front, rear, mast" in result.out.splitlines()
    assert "# server: ( appsrc name=source is-live=true " in result.out


def test_a_bag_must_be_named_to_print_but_not_to_validate(tod):
    rule = "conf/source/bag.yaml: bag: null: must be given: source.bag=, or bag of each mounted camera"
    assert tod("print", *ROBOT).problems == [rule]
    assert tod("validate", *ROBOT).status == 0


def test_other_files_are_no_bags(tod, tmp_path):
    kinds = "a file *.bag, *.mcap, *.db3, or the directory of a ROS 2 bag"
    (tmp_path / "b.mp4").touch()
    for path, rule in (
        ("b.mp4", f"must be a bag: {kinds}"),
        ("", "has no metadata.yaml, which makes a directory a ROS 2 bag"),
    ):
        assert tod("print", *words(tmp_path / path, front="/a")).problems == [
            f"command line: source.bag: {tmp_path / path!s}: {rule}"
        ]


def test_the_first_element_takes_the_pictures(tod, conf):
    elements = "elements:\n  - {name: source, element: videotestsrc}\n"
    conf.write("source/wrong.yaml", f"bag: null\n{elements}")
    assert tod("validate", conf.word).problems == [
        f"{conf.path}/source/wrong.yaml: elements[0].element: 'videotestsrc': must be appsrc: "
        "the pictures of a bag are pushed into the first element"
    ]
