"""A drive as a ROS 2 bag: positions, video by access unit, and lines of the logs as text."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from runner.drive.captures import ReadVideo
from runner.drive.exported import NOTE_TOPIC, POSITION_TOPIC, SOUND_TOPIC, VIDEO_TOPICS, cameras_of, write_all
from runner.drive.read import Drive
from runner.errors import RunError, os_errors_as
from runner.records import Json
from runner.records.lines import Note, line_to_json
from runner.records.vehicle import Position
from runner.system.clocks import SECOND_NS

if TYPE_CHECKING:
    from rosbags.rosbag2 import Writer

    from runner.apply import Unit

TEXT, FIX, VIDEO = "std_msgs/msg/String", "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/CompressedImage"
AUDIO_DATA, AUDIO = "audio_common_msgs/msg/AudioData", "audio_common_msgs/msg/AudioDataStamped"
AUDIO_DEFINITIONS = {AUDIO_DATA: "uint8[] data", AUDIO: "std_msgs/Header header\naudio_common_msgs/AudioData audio"}
GPS = 1  # SERVICE_GPS of sensor_msgs/NavSatStatus
FRAME = "gps"
LATEST_S = 2**31 - 1  # builtin_interfaces/Time counts in 32 bits


def write_rosbag2(
    drive: Drive,
    path: Path,
    read_video: ReadVideo,
    on_warning: Callable[[str], None],
    on_progress: Callable[[float], None] = lambda done: None,
) -> int:
    """Write all of a drive in time order, into MCAP in the directory of a bag.

    path        of the directory, which does not exist yet
    read_video  yields the pictures of a file
    on_warning  called with a line about each omission
    on_progress called every few hundred messages with the share done
    returns     number of messages
    raises      RunError if the bag cannot be written
    """
    from rosbags.rosbag2 import StoragePlugin, Writer

    _check_names(cameras_of(drive))
    with (
        os_errors_as(lambda why: RunError(f"the bag cannot be written: {why}")),
        # Older ROS 2 distributions reject newer versions of the metadata.
        Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        for name, side in drive.sides.items():
            writer.set_custom_data(f"{name} began", json.dumps(line_to_json(side.first), ensure_ascii=False))
        return write_all(drive, _Topics(writer), read_video, on_warning, on_progress)


class _Topics:
    """The topics, each created with its first message."""

    def __init__(self, writer: Writer) -> None:
        from rosbags.typesys import Stores, get_typestore

        self._writer = writer
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._made: dict[str, Any] = {}

    def write_line(self, topic: str, _schema: str, _definition: str, line: Json, ns: int) -> None:
        self._write(ros_name(topic), TEXT, ns, data=json.dumps(line, ensure_ascii=False))

    def note(self, _side: str, line: Note, ns: int) -> None:
        self._write(NOTE_TOPIC, TEXT, ns, data=json.dumps(line_to_json(line), ensure_ascii=False))

    def write_position(self, position: Position, ns: int) -> None:
        types: Any = self._store.types
        self._write(
            POSITION_TOPIC,
            FIX,
            ns,
            header=self._header(ns, FRAME),
            status=types["sensor_msgs/msg/NavSatStatus"](status=0, service=GPS),
            latitude=position.lat,
            longitude=position.lon,
            altitude=float("nan"),  # unknown, as the message defines it
            position_covariance=np.zeros(9),
            position_covariance_type=0,
        )

    def picture(self, topic: str, camera: str, unit: Unit, ns: int) -> None:
        data = np.frombuffer(unit.data, np.uint8)
        self._write(ros_name(topic), VIDEO, ns, header=self._header(ns, camera), format=unit.codec, data=data)

    def sound(self, packet: bytes, ns: int) -> None:
        from rosbags.typesys import get_types_from_msg

        types: Any = self._store.types
        if AUDIO not in types:
            for kind, definition in AUDIO_DEFINITIONS.items():
                self._store.register(get_types_from_msg(definition, kind))
        data = types[AUDIO_DATA](data=np.frombuffer(packet, np.uint8))
        self._write(SOUND_TOPIC, AUDIO, ns, header=self._header(ns, "sound"), audio=data)

    def _header(self, ns: int, frame: str) -> Any:
        sec, nanosec = divmod(ns, SECOND_NS)
        if sec > LATEST_S:
            raise RunError("the bag cannot be written: times of ROS 2 end in January 2038, this drive's are later")
        types: Any = self._store.types
        stamp = types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)

    def _write(self, topic: str, kind: str, ns: int, **fields: Any) -> None:
        if topic not in self._made:
            self._made[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        types: Any = self._store.types
        self._writer.write(self._made[topic], ns, self._store.serialize_cdr(types[kind](**fields), kind))


def ros_name(topic: str) -> str:
    """A topic with the characters that ROS 2 allows: letters, digits and _, no digit first."""
    return re.sub(r"/(?=\d)", "/_", topic.replace("-", "_"))


def _check_names(cameras: list[str]) -> None:
    """Check that no two cameras would have the same topic."""
    taken: dict[str, str] = {}
    for camera in cameras:
        name = ros_name(VIDEO_TOPICS["vehicle"].format(camera=camera))
        if name in taken:
            raise RunError(f"cameras {taken[name]} and {camera} would have the same topic {name} in ROS")
        taken[name] = camera
