"""Decodes messages of bags into objects with the fields of their types."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

from runner.bag.storage import Channel, UnreadableError

Decoder = Callable[[bytes], Any]

# Fields of Foxglove's schemas by number (https://docs.foxglove.dev/docs/sdk/schemas), with the value of an absent one.
PROTOBUF: Mapping[str, Mapping[int, tuple[str, Any]]] = {
    "foxglove.CompressedVideo": {1: ("timestamp", b""), 3: ("data", b""), 4: ("format", "")},
    "foxglove.CompressedImage": {1: ("timestamp", b""), 2: ("data", b""), 3: ("format", "")},
    "foxglove.RawImage": {
        **{1: ("timestamp", b""), 2: ("width", 0), 3: ("height", 0), 4: ("encoding", ""), 5: ("step", 0)},
        6: ("data", b""),
    },
    "foxglove.LocationFix": {1: ("latitude", 0.0), 2: ("longitude", 0.0), 6: ("timestamp", b"")},
}
# Types of ROS that older bags, which contain no definitions, may use besides those of a distribution.
OTHERS = {
    "foxglove_msgs/msg/CompressedVideo": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format"
    ),
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": (
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
        "bool is_bigendian\nuint8[] data"
    ),
}
VARINT, EIGHT_BYTES, COUNTED, FOUR_BYTES = 0, 1, 2, 5  # wire types of protobuf


def decoder(channel: Channel) -> Decoder:
    """What decodes the messages of a channel. The decoder raises ValueError for a damaged message.

    raises  UnreadableError if its encoding is not known
    """
    match channel.encoding:
        case "cdr" | "ros1":
            return _ros_decoder(channel)
        case "protobuf" if channel.kind in PROTOBUF:
            fields = PROTOBUF[channel.kind]
            return lambda data: _from_protobuf(data, fields)
        case "json" if channel.kind in PROTOBUF:
            likes = dict(PROTOBUF[channel.kind].values())
            return lambda data: _from_json(data, likes)
    what = f"its messages of type {channel.kind} are encoded as {channel.encoding!r}"
    raise UnreadableError(f"{what}; known are types of ROS in cdr and ros1, and Foxglove's in protobuf and json")


def _ros_decoder(channel: Channel) -> Decoder:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    form, text = channel.definition
    store = get_typestore(Stores.EMPTY if text else Stores.LATEST)
    try:
        if not text:
            for kind, other in OTHERS.items():
                store.register(get_types_from_msg(other, kind))
        elif form == "ros2idl":
            _register_idl(store, text)
        else:
            store.register(get_types_from_msg(text, channel.kind))
    except Exception as error:  # of a parser of the library
        raise UnreadableError(f"the definition of {channel.kind} cannot be read: {error}") from None
    decode = store.deserialize_ros1 if channel.encoding == "ros1" else store.deserialize_cdr

    def decoded(data: bytes) -> Any:
        try:
            return decode(data, channel.kind)
        except Exception as error:  # the library's generated code raises many kinds
            raise ValueError(f"a damaged message of {len(data)} bytes: {error or type(error).__name__}") from None

    return decoded


def _register_idl(store: Any, text: str) -> None:
    """Register definitions in IDL, several of which are separated by lines of `=` and each named in its first line."""
    from rosbags.typesys import get_types_from_idl

    separator = "=" * 80 + "\n"
    parts = text.split(separator)[1:] if text.startswith(separator) else [f"\n{text}"]
    for part in parts:
        store.register(get_types_from_idl(part.partition("\n")[2]))


def _from_json(data: bytes, likes: Mapping[str, Any]) -> Any:
    """likes: the fields, each with a value of its type; one that is missing has that value"""
    try:
        given = json.loads(data)
        at = given.get("timestamp", {})
        message = SimpleNamespace(timestamp=SimpleNamespace(**{part: int(at.get(part, 0)) for part in ("sec", "nsec")}))
        for name, like in likes.items():
            if name != "timestamp":
                value = given.get(name, like)
                setattr(message, name, base64.b64decode(value) if isinstance(like, bytes) else type(like)(value))
    except (ValueError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        raise ValueError(f"a damaged message of {len(data)} bytes: {error}") from None
    return message


def _from_protobuf(data: bytes, fields: Mapping[int, tuple[str, Any]]) -> Any:
    try:
        found = _protobuf_fields(data)
        message = SimpleNamespace(**{name: _typed(found.get(n, like), like) for n, (name, like) in fields.items()})
        at = _protobuf_fields(message.timestamp)
        message.timestamp = SimpleNamespace(**{part: _typed(at.get(n, 0), 0) for n, part in ((1, "sec"), (2, "nsec"))})
    except (IndexError, ValueError, struct.error) as error:
        raise ValueError(f"a damaged message of {len(data)} bytes: {error}") from None
    return message


def _typed(value: Any, like: Any) -> Any:
    """A value of the wire as the type of the field.

    raises  ValueError or struct.error if it is of another type
    """
    if isinstance(value, bytes) and not isinstance(like, bytes):
        if isinstance(like, str):
            return value.decode()
        return struct.unpack("<d" if isinstance(like, float) else "<I", value)[0]
    if type(value) is not type(like):
        raise ValueError(f"{value!r} in a field of type {type(like).__name__}")
    return value


def _protobuf_fields(data: bytes) -> dict[int, Any]:
    """Fields of a message by number: numbers, and bytes of all others; the last one of each."""
    found: dict[int, Any] = {}
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        number, wire = divmod(key, 8)
        if wire == VARINT:
            found[number], at = _varint(data, at)
            continue
        size = {EIGHT_BYTES: 8, FOUR_BYTES: 4}.get(wire, 0)
        if wire == COUNTED:
            size, at = _varint(data, at)
        elif not size:
            raise ValueError(f"wire type {wire}")
        if at + size > len(data):
            raise ValueError("it is cut off")
        found[number], at = data[at : at + size], at + size
    return found


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A number, and the offset after it."""
    value = shift = 0
    while data[at] >= 128:
        value |= (data[at] & 127) << shift
        shift, at = shift + 7, at + 1
    return value | data[at] << shift, at + 1
