"""Bags played by a real vehicle: pixels, pace, capture times and order; causes that end or interrupt a bag."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("rosbags")

from bags import BEGAN_NS, KINDS, camera_bag, compressed, filmed, header, image, typestore, write_bag, write_mcap
from numbered import HEIGHT, WIDTH, encoded, number_of, numbered
from shared_data import shared

from rig import free_port, process, run, streaming, until, watching
from runner.bag import Bag
from runner.bag.compressed import compressed_form
from runner.bag.pictures import ENCODINGS
from runner.core.commands import Command
from runner.core.model import BagTopic
from runner.operator.frames import live_frames

pytestmark = pytest.mark.gst

STORE = typestore("mcap")
RATE = 15
TOLERANCES = {"yuv422": 4, "uyvy": 4, "yuv422_yuy2": 4, "yuyv": 4, "nv12": 4, "nv21": 4}  # of what is not RGB


def road(count):
    return filmed(shared("video/forward_highway_day_540p25_A.mp4"), count, (96, 54))


# --- pixels -----------------------------------------------------------------------------------------------------------


def shown(bag, topic, form="RGB"):
    """The pictures that come out of GStreamer, and their times in ns."""
    from runner.gst import Gst
    from runner.gst.bag_feed import read_bag
    from runner.gst.caps import structure

    sink = "appsink name=sink sync=false"
    line = f"appsrc name=bag format=time max-buffers=2 ! decodebin ! videoconvert ! video/x-raw,format={form} ! {sink}"
    pipeline = Gst.parse_launch(line)
    read_bag(pipeline.get_by_name("bag"), BagTopic(str(bag), topic), Fraction(25))
    pipeline.set_state(Gst.State.PLAYING)
    pictures, times = [], []
    try:
        while sample := pipeline.get_by_name("sink").emit("try-pull-sample", 20 * Gst.SECOND):
            caps, buffer = structure(sample.get_caps()), sample.get_buffer()
            width, height = caps.get_int("width")[1], caps.get_int("height")[1]
            data = np.frombuffer(buffer.extract_dup(0, buffer.get_size()), np.uint8).reshape(height, -1)
            pictures.append(data[:, : 3 * width].reshape(height, width, 3))
            times.append(buffer.pts)
        message = pipeline.get_bus().pop_filtered(Gst.MessageType.ERROR)
        assert message is None, message.parse_error()[0].message
    finally:
        pipeline.set_state(Gst.State.NULL)
    return pictures, times


@pytest.mark.parametrize("kind", KINDS)
def test_pixels_of_each_encoding(tmp_path, kind):
    store, frames = typestore(kind), road(2)
    topics = {
        f"/{encoding}": [
            (
                BEGAN_NS + n,
                image(store, BEGAN_NS + n * 40_000_000, encoded(frame, encoding)[0], encoding, padding=n * 6),
            )
            for n, frame in enumerate(frames)
        ]
        for encoding in ENCODINGS
    }
    swapped = encoded(frames[0], "mono16")[0].reshape(54, 96, 2)[..., ::-1]
    topics["/big"] = [(BEGAN_NS, image(store, BEGAN_NS, np.ascontiguousarray(swapped), "mono16", big=True))]
    bag = write_bag(tmp_path / "b", kind, topics)
    for encoding in ENCODINGS:
        pictures, times = shown(bag, f"/{encoding}")
        assert times == [0, 40_000_000]
        for picture, frame in zip(pictures, frames, strict=True):
            wanted = encoded(frame, encoding)[1]
            assert np.abs(picture.astype(int) - wanted).max() <= TOLERANCES.get(encoding, 2), encoding
    ((picture,), _) = shown(bag, "/big")
    assert np.abs(picture.astype(int) - encoded(frames[0], "mono16")[1]).max() <= 2


@pytest.mark.parametrize("padding", [0, 6])
def test_a_topic_of_ros_is_converted_as_in_a_bag(padding):
    """Without ROS: what its node passes on, pushed from shared memory."""
    from runner.configuration.config import configuration
    from runner.gst import Gst
    from runner.gst.shared import push_shared
    from runner.ros.cameras import CameraStream

    (frame,) = road(1)
    words = [
        "vehicle=delivery_robot",
        "source=ros",
        *(f"cameras.{name}.topic=/a" for name in ("front", "rear", "mast")),
    ]
    camera = configuration(words).vehicle().cameras["front"]
    for encoding in ENCODINGS:
        data, wanted = encoded(frame, encoding)
        message = image(STORE, BEGAN_NS, data, encoding, padding)
        memory = os.memfd_create("picture")
        os.write(memory, message.data.tobytes())
        form = {key: getattr(message, key) for key in ("encoding", "width", "height", "step")}
        reported = []
        stream = CameraStream(camera, lambda *what: reported.append(what))  # noqa: B023
        picture = stream.add({"at": 1, "age": 0, "size": len(message.data), "big": False, **form}, memory)
        assert picture, reported
        pipeline = Gst.parse_launch(
            "appsrc name=in format=time is-live=true ! decodebin ! videoconvert ! video/x-raw,format=RGB"
            " ! appsink name=out sync=false"
        )
        pipeline.set_state(Gst.State.PLAYING)
        assert push_shared(pipeline.get_by_name("in"), replace(picture, captured=time.monotonic_ns()), Fraction(25))
        sample = pipeline.get_by_name("out").emit("try-pull-sample", 20 * Gst.SECOND)
        buffer = sample.get_buffer()
        rows = np.frombuffer(buffer.extract_dup(0, buffer.get_size()), np.uint8).reshape(54, -1)
        found = rows[:, : 96 * 3].reshape(54, 96, 3)  # RGB passes with the padding of its rows
        pipeline.set_state(Gst.State.NULL)
        assert np.abs(found.astype(int) - wanted).max() <= TOLERANCES.get(encoding, 2), encoding


def test_a_compressed_bayer_pattern_is_shown_in_colour_live_and_from_a_bag(tmp_path):
    import cv2

    from runner.gst import Gst
    from runner.gst.shared import push_shared
    from runner.ros.cameras import PictureType, SharedPicture

    mosaic, wanted = encoded(road(1)[0], "bayer_grbg8")
    data = cv2.imencode(".jpg", mosaic)[1].tobytes()
    message = compressed(typestore("ros1"), BEGAN_NS, data, "bayer_grbg8; jpeg compressed ")
    ((picture,), _) = shown(write_bag(tmp_path / "b", "ros1", {"/a": [(BEGAN_NS, message)]}), "/a")
    assert np.abs(picture.astype(int) - wanted).mean() < 6

    memory = os.memfd_create("picture")
    os.write(memory, data)
    sink = "videoconvert ! video/x-raw,format=RGB ! appsink name=out sync=false"
    pipeline = Gst.parse_launch(f"appsrc name=in format=time is-live=true ! decodebin ! {sink}")
    pipeline.set_state(Gst.State.PLAYING)
    kind = PictureType(*compressed_form(data, message.format))
    shared_picture = SharedPicture(memory, len(data), kind, 0, time.monotonic_ns(), False)
    assert push_shared(pipeline.get_by_name("in"), shared_picture, Fraction(25))
    buffer = pipeline.get_by_name("out").emit("try-pull-sample", 20 * Gst.SECOND).get_buffer()
    rows = np.frombuffer(buffer.extract_dup(0, buffer.get_size()), np.uint8).reshape(54, -1)
    pipeline.set_state(Gst.State.NULL)
    assert np.abs(rows[:, : 96 * 3].reshape(54, 96, 3).astype(int) - wanted).mean() < 6


def test_compressed_pictures_are_decoded(tmp_path):
    import cv2

    (frame,) = road(1)
    files = {kind: cv2.imencode(f".{kind}", frame)[1].tobytes() for kind in ("png", "jpg")}
    topics = {f"/{k}": [(BEGAN_NS, compressed(STORE, BEGAN_NS, data, k))] for k, data in files.items()}
    bag = write_bag(tmp_path / "b", "mcap", topics)
    ((png,), _), ((jpeg,), _) = shown(bag, "/png"), shown(bag, "/jpg")
    assert (png == frame[..., ::-1]).all()
    reference = cv2.imdecode(np.frombuffer(files["jpg"], np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(jpeg.astype(int) - reference).mean() < 3


# --- video ------------------------------------------------------------------------------------------------------------


def units(frames, codec, keys="key-int-max=5"):
    """Access units of frames, without pictures that come later than they are shown."""
    from runner.gst import Gst

    height, width, _ = frames[0].shape
    encode = f"{codec.replace('h', 'x')}enc tune=zerolatency speed-preset=superfast bitrate=2000 {keys}"
    pipeline = Gst.parse_launch(
        f"appsrc name=in format=time caps=video/x-raw,format=BGR,width={width},height={height},framerate=25/1"
        f" ! videoconvert ! video/x-raw,format=I420 ! {encode} ! {codec}parse config-interval=-1"
        f" ! video/x-{codec},stream-format=byte-stream,alignment=au ! appsink name=out sync=false"
    )
    pipeline.set_state(Gst.State.PLAYING)
    for number, frame in enumerate(frames):
        buffer = Gst.Buffer.new_wrapped(frame.tobytes())
        buffer.pts = number * 40_000_000
        pipeline.get_by_name("in").emit("push-buffer", buffer)
    pipeline.get_by_name("in").emit("end-of-stream")
    found = []
    while sample := pipeline.get_by_name("out").emit("try-pull-sample", 20 * Gst.SECOND):
        found.append(sample.get_buffer().extract_dup(0, sample.get_buffer().get_size()))
    pipeline.set_state(Gst.State.NULL)
    assert len(found) == len(frames)
    return found


def video_bag(path, writer, coded, codec):
    """A bag with these units on /video, as different programs write them."""
    import base64
    import json

    from rosbags.typesys import get_types_from_msg

    stamps = [BEGAN_NS + n * 40_000_000 for n in range(len(coded))]
    if writer == "CompressedImage":
        messages = [(ns, compressed(STORE, ns, data, codec)) for ns, data in zip(stamps, coded, strict=True)]
        return write_bag(path, "mcap", {"/video": messages})
    if writer == "foxglove":
        import foxglove
        from foxglove.channels import CompressedVideoChannel
        from foxglove.messages import CompressedVideo, Timestamp

        context, path = foxglove.Context(), path.with_suffix(".mcap")
        with foxglove.open_mcap(str(path), context=context):
            channel = CompressedVideoChannel("/video", context=context)
            for ns, data in zip(stamps, coded, strict=True):
                at = Timestamp(*divmod(ns, 10**9))
                channel.log(CompressedVideo(timestamp=at, frame_id="a", data=data, format=codec), log_time=ns)
        return path
    if writer == "json":
        lines = [
            {
                "timestamp": dict(zip(("sec", "nsec"), divmod(ns, 10**9), strict=True)),
                "data": base64.b64encode(data).decode(),
                "format": codec,
            }
            for ns, data in zip(stamps, coded, strict=True)
        ]
        messages = [("/video", ns, json.dumps(line).encode()) for ns, line in zip(stamps, lines, strict=True)]
        schema = ("foxglove.CompressedVideo", "jsonschema", b"{}")
        options = {"encodings": {"/video": "json"}, "profile": ""}
        return write_mcap(path.with_suffix(".mcap"), messages, {"/video": schema}, **options)
    kind, text, name = {
        "FFMPEGPacket": (
            "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
            "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
            "bool is_bigendian\nuint8[] data",
            {"h264": "libx264", "h265": "hevc"}[codec],
        ),
        "foxglove_msgs": (
            "foxglove_msgs/msg/CompressedVideo",
            "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format",
            codec,
        ),
    }[writer]
    store = typestore("mcap")
    store.register(get_types_from_msg(text, kind))
    make, messages = store.types[kind], []
    for ns, data in zip(stamps, coded, strict=True):
        bytes_ = np.frombuffer(data, np.uint8)
        if writer == "FFMPEGPacket":
            message = make(header(store, ns), 96, 54, name, 0, 0, False, bytes_)
        else:
            message = make(store.types["builtin_interfaces/msg/Time"](*divmod(ns, 10**9)), "a", bytes_, name)
        messages.append(("/video", ns, bytes(store.serialize_cdr(message, kind))))
    schema = (kind, "ros2msg", store.generate_msgdef(kind, ros_version=2)[0].encode())
    return write_mcap(path.with_suffix(".mcap"), messages, {"/video": schema})


VIDEO_WRITERS = ("CompressedImage", "foxglove", "json", "FFMPEGPacket", "foxglove_msgs")


@pytest.mark.parametrize(
    ("writer", "codec"),
    [
        pytest.param(writer, codec, marks=() if codec == "h264" else (pytest.mark.soak, pytest.mark.sources))
        for codec in ("h264", "h265")
        for writer in VIDEO_WRITERS
    ],
)
def test_video_of_each_type_is_a_source(tmp_path, writer, codec):
    if writer == "foxglove":
        pytest.importorskip("foxglove")
    frames = road(12)
    bag = video_bag(tmp_path / "b", writer, units(frames, codec), codec)
    with Bag(bag) as opened:
        form = opened.form("/video")
        assert (form.format, form.width, form.height, form.fps) == (codec, 96, 54, 25)
    pictures, times = shown(bag, "/video")
    assert times == [n * 40_000_000 for n in range(12)]
    for picture, frame in zip(pictures, frames, strict=True):
        assert np.abs(picture.astype(int) - frame[..., ::-1]).mean() < 6


def test_video_that_begins_without_a_key_picture_says_so(tmp_path):
    coded = units(road(12), "h264")
    bag = video_bag(tmp_path / "b", "CompressedImage", coded[2:], "h264")
    times, reported = played(bag, "/video")
    assert times == [n * 40_000_000 for n in range(7)]  # from the next key picture, the sixth, on
    assert reported == [
        f"{bag}: /video: picture 1: a picture of h264 before the first key picture: such pictures are skipped",
        f"{bag}: /video: 3 of 10 pictures were skipped",
    ]


# --- pictures that cannot be shown ------------------------------------------------------------------------------------


def played(bag, topic):
    """Capture times of the pictures that a live source releases, ns since the first one, and what it reports."""
    from runner.gst import Gst
    from runner.gst.bag_feed import BagFeed

    pipeline = Gst.parse_launch("appsrc name=bag format=time is-live=true ! decodebin ! appsink name=sink sync=false")
    reported, times = [], []
    BagFeed(pipeline.get_by_name("bag"), BagTopic(str(bag), topic), Fraction(25), False, reported.append)
    pipeline.set_state(Gst.State.PLAYING)
    try:
        while sample := pipeline.get_by_name("sink").emit("try-pull-sample", 20 * Gst.SECOND):
            times.append(sample.get_buffer().pts)
        assert pipeline.get_bus().pop_filtered(Gst.MessageType.ERROR) is None
    finally:
        pipeline.set_state(Gst.State.NULL)
    return [at - times[0] for at in times], reported


def failure(bag, topic):
    """Why a bag is not read, as `record` and `model` read it."""
    from runner.gst import Gst
    from runner.gst.bag_feed import read_bag

    pipeline = Gst.parse_launch("appsrc name=bag format=time max-buffers=2 ! decodebin ! fakesink")
    read_bag(pipeline.get_by_name("bag"), BagTopic(str(bag), topic), Fraction(25))
    pipeline.set_state(Gst.State.PLAYING)
    try:
        message = pipeline.get_bus().timed_pop_filtered(20 * Gst.SECOND, Gst.MessageType.ERROR | Gst.MessageType.EOS)
        return message.parse_error()[0].message
    finally:
        pipeline.set_state(Gst.State.NULL)


def test_bad_pictures_are_skipped_counted_and_reported_once(tmp_path):
    import cv2

    frames = [cv2.imencode(".jpg", frame)[1].tobytes() for frame in road(20)]
    small = cv2.imencode(".jpg", road(1)[0][:32, :32])[1].tobytes()
    wrong = {0: b"", 4: frames[4][: len(frames[4]) // 2], 5: bytes(500), 9: small, 12: b"", 19: frames[19][:30]}
    stamped = [(BEGAN_NS + n * 20_000_000, wrong.get(n, data)) for n, data in enumerate(frames)]
    topics = {"/a": [(ns, compressed(STORE, ns, data, "jpeg")) for ns, data in stamped]}
    bag = write_bag(tmp_path / "b", "mcap", topics)
    times, reported = played(bag, "/a")
    assert times == [(n - 1) * 20_000_000 for n in range(20) if n not in wrong]
    assert reported == [
        f"{bag}: /a: picture 1: an empty picture: such pictures are skipped",
        f"{bag}: /a: 6 of 20 pictures were skipped",
    ]
    assert failure(bag, "/a") == f"{bag}: /a: picture 1: an empty picture"


def damaged(data, random):
    """A picture that lost its end, or some of whose bytes changed."""
    at = random.randrange(len(data))
    if random.random() < 0.3:
        return data[:at]
    return data[:at] + random.randbytes(random.randrange(1, 40)) + data[at + random.randrange(40) :]


@pytest.mark.soak
@pytest.mark.sources
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["jpg", "png", "h264", "h265"])
def test_no_damaged_picture_ends_a_camera(tmp_path, kind, seed):
    """Whole ones between them are shown; a decoder may leave out what is damaged."""
    import random

    import cv2

    draw = random.Random(seed)
    frames = road(30) * 4
    if kind in ("h264", "h265"):
        whole = units(frames, kind)
    else:
        whole = [cv2.imencode(f".{kind}", frame)[1].tobytes() for frame in frames]
    wrong = {n: damaged(data, draw) for n, data in enumerate(whole) if draw.random() < 0.25}
    messages = [
        (BEGAN_NS + n, compressed(STORE, BEGAN_NS + n * 10_000_000, wrong.get(n, data), kind))
        for n, data in enumerate(whole)
    ]
    times, reported = played(write_bag(tmp_path / "b", "mcap", {"/a": messages}), "/a")
    assert len(reported) <= 2
    assert len(times) <= len(whole)
    if kind in ("jpg", "png"):
        assert len(times) >= len(whole) - len(wrong)
    else:
        assert len(times) > len(whole) / 2


# --- a vehicle --------------------------------------------------------------------------------------------------------


def robot(bag, *words, topics=("front", "rear")):
    return (
        *("vehicle=delivery_robot", "source=bag", f"source.bag={bag}", "~cameras.mast", f"fps_max={RATE}"),
        *(f"cameras.{name}.topic=/{name}/image" for name in topics),
        *("cameras.front.width_px=384", "cameras.front.height_px=216", "~cameras.front.native"),
        *("cameras.rear.width_px=384", "cameras.rear.height_px=216"),
        *words,
    )


def send(side, *names):
    knobs = (("sending", True), ("size", (WIDTH, HEIGHT)), ("bitrate", 3000))
    side.turn([Command(name, *knob) for name in names for knob in knobs])


def test_two_cameras_arrive_in_order_with_the_times_of_the_bag(tmp_path):
    """30 pictures each and again after the end; one camera has them from the last to the first."""
    count, order = 30, {"front": list(range(30)), "rear": list(range(29, -1, -1))}
    bag, other = (
        camera_bag(tmp_path / name, kind, {f"/{name}/image": map(numbered, order[name])}, RATE)
        for name, kind in (("front", "ros1"), ("rear", "mcap"))
    )
    words = robot(bag, f"cameras.rear.bag={other}")
    with streaming(*words, cameras=()) as (side, setup, _, reported):
        send(side, "front", "rear")
        seen = {name: [] for name in order}
        with live_frames([*words, f"media.port={setup.media.port}"]) as received:
            until(lambda: take(received, seen) and min(map(len, seen.values())) > 2 * count)
    for name, pictures in seen.items():
        numbers = [order[name].index(number) for number, _, _ in pictures]
        starts = [at for at in range(1, len(numbers)) if numbers[at] < numbers[at - 1]]
        assert starts, "the bag did not begin again"
        places = [number + count * sum(start <= at for start in starts) for at, number in enumerate(numbers)]
        assert places == sorted(set(places))  # in order, none twice
        # The capture times have the pace of the bag; a machine that stalls loses time as with a clip.
        captured = [at for _, at, _ in pictures]
        steps = [(b - a) / (n - m) for (a, b), (m, n) in zip(pairwise(captured), pairwise(places), strict=True)]
        assert np.median(steps) == pytest.approx(1 / RATE, abs=0.0005)
        latencies = [seen_at - at for _, at, seen_at in pictures]
        assert 0 < min(latencies) < 1
        assert np.median(latencies) < 2
    assert {line.partition(": ")[2] for line in reported} == {"pipeline built", "pipeline stopped"}


def take(received, seen):
    if (frame := received.next(1)) and frame.captured and (number := number_of(frame.image)) is not None:
        seen[frame.camera].append((number, frame.captured, time.time()))
    return True


def test_pictures_of_another_size_are_left_out_and_others_continue(tmp_path):
    pictures = [numbered(n) if n % 10 < 8 else numbered(n)[::2, ::2] for n in range(60)]
    frames = {"/front/image": pictures, "/rear/image": map(numbered, range(60))}
    bag = camera_bag(tmp_path / "drive", "mcap", frames, RATE)
    with streaming(*robot(bag), cameras=()) as (side, _, plans, reported):
        send(side, "front", "rear")
        with watching(plans[0]) as front, watching(plans[1]) as rear:
            until(lambda: len(front.sizes) > 30 and len(rear.sizes) > 30)
    what = f"front: {bag}: /front/image: picture 9 is 192x108, the first one 384x216: such pictures are skipped"
    assert [line for line in reported if "pipeline" not in line and "were skipped" not in line] == [what]


@pytest.mark.soak
@pytest.mark.sources
@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_after_a_gap_in_a_bag_its_pictures_pass_at_the_camera_s_rate(tmp_path, kind):
    """30 Hz, shown at 5; three seconds are missing."""
    store = typestore(kind)
    stamps = [BEGAN_NS + round(n / 30 * 1e9) for n in (*range(30), *range(120, 210))]
    pictures = [(ns, image(store, ns, numbered(n), "bgr8")) for n, ns in enumerate(stamps)]
    bag = write_bag(tmp_path / "drive", kind, {"/front/image": pictures})
    words = robot(bag, "~cameras.rear", "cameras.front.fps=5", topics=["front"])
    with streaming(*words, cameras=("front",)) as (side, _, plans, _):
        send(side, "front")
        with watching(plans[0]) as front:
            until(lambda: any(after - before > 2 for before, after in pairwise(front.times)))
            again, count = front.times[-1], len(front.times)
            until(lambda: time.monotonic() > again + 2)
            assert 9 <= len(front.times) - count <= 12


def test_a_bag_damaged_further_on_ends_only_its_camera(tmp_path):
    whole = camera_bag(tmp_path / "drive", "ros1", {"/front/image": map(numbered, range(40))}, RATE)
    data = bytearray(whole.read_bytes())
    at = data.rindex(b"op=\x02")  # of the last message
    data[at : at + 4] = b"op=\x09"
    bag = tmp_path / "damaged.bag"
    bag.write_bytes(data)
    other = camera_bag(tmp_path / "other", "mcap", {"/rear/image": map(numbered, range(40))}, RATE)
    words = robot(bag, f"cameras.rear.bag={other}")
    with streaming(*words, cameras=()) as (side, _, plans, reported):
        send(side, "front", "rear")
        with watching(plans[0]), watching(plans[1]) as rear:
            until(lambda: any("damaged" in line for line in reported))
            received = len(rear.sizes)
            until(lambda: len(rear.sizes) > received + 10)
    (line,) = {line for line in reported if "damaged" in line}
    assert line.startswith(f"front: {bag}: /front/image: cannot be read, damaged or cut off: ")


def test_a_strict_vehicle_whose_bag_lacks_a_topic_does_not_start(tmp_path):
    bag = camera_bag(tmp_path / "drive", "mcap", {"/front/image": map(numbered, range(3))}, RATE)
    with process("vehicle", *robot(bag), "strict=true", f"media.port={free_port()}") as vehicle:
        output, _ = vehicle.communicate(timeout=60)
    assert vehicle.returncode == 2
    rule = "no such topic with pictures, did you mean /front/image?"
    assert output.splitlines() == [
        f"command line: cameras.rear.topic: {bag}: /rear/image: {rule}",
        "1 problem, nothing was started",
    ]


# --- as fast as possible ----------------------------------------------------------------------------------------------


def test_a_bag_is_recorded_picture_by_picture_faster_than_it_plays(tmp_path):
    bag = camera_bag(tmp_path / "drive", "sqlite3", {"/front/image": map(numbered, range(60))}, 0.25)
    words = [*robot(bag, topics=["front"]), "~cameras.rear", "fps_max=0.25"]
    done = run("record", *words, f"output={tmp_path}/rec", timeout=120)  # half of the bag's length
    assert (done.returncode, done.stderr.count("WARNING")) == (0, 0)
    line = f"front: {tmp_path}/rec/front.mkv: 384x216 at 0.25 Hz, 60 frames in 240.00 s, "
    assert done.stdout.startswith(line)
    import cv2

    video = cv2.VideoCapture(str(tmp_path / "rec" / "front.mkv"))
    assert [number_of(video.read()[1]) for _ in range(60)] == list(range(60))
    with Bag(bag) as opened:
        first = next(opened.pictures("/front/image"))
    assert f'"began": {first.ns / 1e9:.2f}' in (tmp_path / "rec" / "recording.json").read_text()


def test_a_short_recording_of_a_bag_ends_at_the_right_picture(tmp_path):
    """Its pictures are read within a few milliseconds, but the recorder looks only ten times a second."""
    bag = camera_bag(tmp_path / "bag", "mcap", {"/front/image": [np.zeros((96, 96, 3), np.uint8)] * 200}, RATE)
    words = (*robot(bag, topics=["front"]), "~cameras.rear")
    done = run("record", *words, f"output={tmp_path}/rec", "duration_s=0.4")
    assert done.returncode == 0, done.stderr
    assert ", 6 frames in 0.40 s" in done.stdout


def test_a_recording_fails_where_a_picture_would_be_left_out(tmp_path):
    pictures = [numbered(n) if n < 8 else numbered(n)[::2, ::2] for n in range(20)]
    bag = camera_bag(tmp_path / "drive", "mcap", {"/front/image": pictures}, RATE)
    done = run("record", *robot(bag, topics=["front"]), "~cameras.rear", f"output={tmp_path}/rec")
    assert done.returncode == 1
    why = f"front: {bag}: /front/image: picture 9 is 192x108, the first one 384x216"
    assert any(why in line for line in done.stderr.splitlines())


@pytest.mark.soak
def test_a_model_is_measured_on_a_topic(tmp_path):
    import json

    frames = filmed(shared("video/forward_highway_day_540p25_A.mp4"), 30, (320, 180))
    bag = camera_bag(tmp_path / "drive", "mcap", {"/front/image": frames, "/rear/image": frames}, 25)
    words = ["vehicle=delivery_robot", "scalings=[0.5]", "bitrates_kbps=[300,900]", f"output={tmp_path}/models"]
    done = run("model", *words, "camera=front", f"sequence={bag}", env={"XDG_CACHE_HOME": str(tmp_path)})
    assert done.returncode == 2
    topics = "/front/image, /rear/image"
    assert done.stderr.splitlines()[0] == f"command line: cameras.front.topic: {bag}: must be given: one of {topics}"
    words += ["camera=front", f"sequence={bag}", "cameras.front.topic=/front/image"]
    done = run("model", *words, env={"XDG_CACHE_HOME": str(tmp_path)})
    assert done.returncode == 0, done.stderr
    (sequence,) = json.loads((tmp_path / "models" / "front.model.json").read_text())["sequences"].values()
    assert (sequence["topic"], sequence["frames"], sequence["fps"]) == ("/front/image", 30, 25)
    assert (sequence["width"], sequence["height"], sequence["lossless"]) == (320, 180, True)


def test_a_missing_converter_of_bayer_patterns_is_reported_once():
    from runner.gst import Gst
    from runner.gst.bag_feed import accept_bayer

    registry, converter = Gst.Registry.get(), Gst.ElementFactory.find("bayer2rgb")
    if converter:
        registry.remove_feature(converter)
    pipeline = Gst.parse_launch("appsrc name=in ! decodebin")
    try:
        assert [accept_bayer(pipeline.get_by_name("in"), "rggb") for _ in range(3)] == [False] * 3
    finally:
        if converter:
            registry.add_feature(converter)
    bus = pipeline.get_bus()
    errors = [bus.pop_filtered(Gst.MessageType.ERROR) for _ in range(2)]
    assert "bayer2rgb" in errors[0].parse_error()[0].message
    assert errors[1] is None
