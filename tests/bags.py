"""Bags for tests, written by the library's own writers."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

KINDS = ("ros1", "sqlite3", "mcap")
BEGAN_NS = 1_700_000_000_250_000_000  # stamp of the first picture
IMAGE, COMPRESSED, FIX = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "NavSatFix"))
TIME = "builtin_interfaces/msg/Time"


def typestore(kind: str) -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)


def header(store: Any, ns: int, frame: str = "camera") -> Any:
    stamp = store.types[TIME](*divmod(ns, 10**9))
    make = store.types["std_msgs/msg/Header"]
    return make(0, stamp, frame) if "seq" in make.__dataclass_fields__ else make(stamp, frame)


def image(store: Any, ns: int, picture: np.ndarray, encoding: str, padding: int = 0, big: bool = False) -> Any:
    """A message of type Image.

    picture  height x width x bytes of a pixel; of NV12 and NV21 half as many more rows
    padding  bytes after each row
    """
    height, width, _ = picture.shape
    rows = picture.reshape(height, -1).view(np.uint8)
    height = height * 2 // 3 if encoding.startswith("nv") else height
    data = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    return store.types[IMAGE](header(store, ns), height, width, encoding, int(big), data.shape[1], data.ravel())


def compressed(store: Any, ns: int, data: bytes, form: str) -> Any:
    return store.types[COMPRESSED](header(store, ns), form, np.frombuffer(data, np.uint8))


def fix(store: Any, ns: int, lat: float, lon: float, status: int = 0) -> Any:
    state = store.types["sensor_msgs/msg/NavSatStatus"](status, 1)
    return store.types[FIX](header(store, ns, "gps"), state, lat, lon, 500.0, np.zeros(9), 0)


def write_bag(path: Path, kind: str, topics: Mapping[str, Sequence[tuple[int, Any]]]) -> Path:
    """A bag with the messages of some topics, each with its time of recording, in ns.

    path     without suffix
    returns  its path
    """
    store = typestore(kind)
    logged = sorted(((ns, topic, m) for topic, messages in topics.items() for ns, m in messages), key=lambda x: x[0])
    if kind == "ros1":
        from rosbags.rosbag1 import Writer

        path = path.with_suffix(".bag")
        with Writer(path) as writer:
            connections = {
                topic: writer.add_connection(topic, messages[0][1].__msgtype__, typestore=store)
                for topic, messages in topics.items()
            }
            for ns, topic, message in logged:
                writer.write(connections[topic], ns, store.serialize_ros1(message, message.__msgtype__))
        return path
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        connections = {
            topic: writer.add_connection(topic, messages[0][1].__msgtype__, typestore=store)
            for topic, messages in topics.items()
        }
        for ns, topic, message in logged:
            writer.write(connections[topic], ns, store.serialize_cdr(message, message.__msgtype__))
    return path


def definition(kind: str, form: str = "ros2msg") -> tuple[str, str, bytes]:
    """Name, format and text of the definition of a type, for `write_mcap`."""
    version = 1 if form == "ros1msg" else 2
    store = typestore("ros1" if version == 1 else "mcap")
    name = kind.replace("/msg/", "/") if version == 1 else kind
    return name, form, store.generate_msgdef(kind, ros_version=version)[0].encode()


def packed(message: Any) -> bytes:
    """A message in CDR."""
    return bytes(typestore("mcap").serialize_cdr(message, message.__msgtype__))


def write_mcap(
    path: Path,
    messages: Iterable[tuple[str, int, bytes]],
    schemas: Mapping[str, tuple[str, str, bytes] | None],
    *,
    encodings: Mapping[str, str] = {},
    qos: str = "",
    profile: str = "ros2",
    **options: Any,
) -> Path:
    """An MCAP by the format's own writer, as other programs write it.

    messages   topic, time of recording and bytes, in the order of the file
    schemas    by topic: name, format and text of the definition; None: without
    encodings  of the messages, by topic; otherwise cdr
    """
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile, "another program")
        channels = {}
        for topic, schema in schemas.items():
            number = writer.register_schema(*schema) if schema else 0
            metadata = {"offered_qos_profiles": qos} if qos else {}
            channels[topic] = writer.register_channel(topic, encodings.get(topic, "cdr"), number, metadata)
        for topic, ns, data in messages:
            writer.add_message(channels[topic], ns, data, ns)
        writer.finish()
    return path


def write_metadata(directory: Path, topic: str, kind: str, files: Sequence[str], count: int) -> Path:
    """metadata.yaml as rosbag2 writes it, for files that lie in the directory."""
    document = {
        "version": 5,
        "storage_identifier": "",  # as `ros2 bag reindex` left it
        "duration": {"nanoseconds": 10**9},
        "starting_time": {"nanoseconds_since_epoch": BEGAN_NS},
        "message_count": count,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": kind,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": "",
                },
                "message_count": count,
            }
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": list(files),
    }
    (directory / "metadata.yaml").write_text(json.dumps({"rosbag2_bagfile_information": document}))  # JSON is YAML
    return directory


def filmed(clip: Path, count: int, size: tuple[int, int]) -> list[np.ndarray]:
    """The first frames of a clip, as BGR of a size."""
    import cv2

    video = cv2.VideoCapture(str(clip))

    def frames() -> Iterator[np.ndarray]:
        while (read := video.read())[0]:
            yield cv2.resize(read[1], size, interpolation=cv2.INTER_AREA)

    found = list(islice(frames(), count))
    assert len(found) == count
    return found


def camera_bag(
    path: Path, kind: str, frames: Mapping[str, Iterable[np.ndarray]], fps: float, encoding: str = "bgr8"
) -> Path:
    """A bag of pictures by topic, `fps` a second, recorded 5 ms after their stamps."""
    store = typestore(kind)

    def at(number: int) -> int:
        return BEGAN_NS + round(number * 1e9 / fps)

    return write_bag(
        path,
        kind,
        {
            topic: [
                (at(number) + 5_000_000, image(store, at(number), picture, encoding))
                for number, picture in enumerate(pictures)
            ]
            for topic, pictures in frames.items()
        },
    )
