"""The cameras of this machine and the picture topics of its ROS: what each offers, and the YAML that mounts it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from fractions import Fraction

from runner.core.capture import Capture
from runner.errors import RunError, UserError
from runner.ros.topics import Topic, picture_topics
from runner.settings import Setup
from runner.system.v4l2 import Connected, Format, Size, Span, connected, preferred
from runner.verbs.own_camera import as_yaml, kind_of, mount_of, stated
from runner.verbs.screen import command_name

NOTHING = """\
no V4L2 device captures pictures here: plug in a camera, or load its driver (`ls /dev/video*`, `dmesg`)
other sources, such as IP cameras, clips and bags: docs/sources.md"""
GENERAL = re.compile(r"/(image(_raw|_color|_rect)*|compressed)\b")  # parts of a topic's name that name no camera
HOW_TO = """\
# Paste the parts into the files of a vehicle of your own:
# `tod-runner init NAME cameras=front` makes one"""


def list_cameras(setup: Setup) -> bool:
    """Print what is found; returns whether there is a camera."""
    devices = list(connected())
    topics, note = _topics(setup)
    blocks = [*map(_device, devices), *map(_topic, topics)]
    print("\n\n\n".join("\n".join(block) for block in ([HOW_TO], *blocks)) if blocks else NOTHING)
    if note:
        print(f"\nno ROS topics: {note}" if blocks else f"no ROS topics: {note}")
    return bool(blocks)


def _topics(setup: Setup) -> tuple[list[Topic], str]:
    """The picture topics, and why there are none."""
    try:
        found = picture_topics(setup.ros, setup.insecure)
    except (RunError, UserError) as error:
        return [], str(error)
    return found, "" if found else "no node publishes sensor_msgs/Image or CompressedImage"


def _device(device: Connected) -> Iterator[str]:
    yield f"{device.node}  {device.card}".rstrip()
    if device.problem:
        yield f"  {device.problem}"
    yield from _offers(device.formats)
    if device.card:
        capture = preferred(device.formats)
        mount = {"device": str(device.path), **mount_of(capture)}
        yield from _yaml(str(device.node), device.node.name, _word(device.card), capture, "v4l2", mount)


def _topic(topic: Topic) -> Iterator[str]:
    yield f"{topic.name}  {topic.kind}"
    if topic.encoding:
        size = f" {topic.width}x{topic.height}" if topic.width else ", whose messages state no size,"
        yield f"  {topic.encoding}{size} at {topic.hz:.1f} Hz"
    name = _word(GENERAL.sub("", topic.name))
    seen = Capture(None, topic.width, topic.height, Fraction(round(topic.hz)) if topic.hz >= 1 else None)
    yield from _yaml(f"ros:{topic.name}", name, f"{name}_camera", seen, "ros", {"topic": topic.name})


def _yaml(camera: str, name: str, kind: str, capture: Capture, source: str, mount: dict[str, object]) -> Iterator[str]:
    yield f"  {command_name()} demo camera={camera}"
    yield ""
    yield f"# cameras/{kind}.yaml; measure the rate-quality model: `tod-runner model`"
    yield from as_yaml(kind_of(capture))
    yield ""
    yield "# vehicle/NAME.yaml, in defaults:"
    yield f"  - /cameras@cameras.{name}: {kind}"
    yield f"  - /source@cameras.{name}.source: {source}"
    yield "# vehicle/NAME.yaml, in cameras:"
    yield f"  {name}:"
    yield from (f"    {line}" for line in as_yaml(mount))


def _offers(formats: Iterable[Format]) -> Iterator[str]:
    """A line for each format and size."""
    formats = list(formats)
    name_width = max((len(each.name) for each in formats), default=0)
    for each in formats:
        names = (each.name, *[""] * len(each.sizes))
        sizes = sorted(each.sizes, key=lambda size: (-size.width.most * size.height.most, size.width.most))
        yield from (f"  {name:{name_width}}  {_offered(size)}" for name, size in zip(names, sizes, strict=False))


def _offered(size: Size) -> str:
    """1280x720 at 30, 15 Hz; a range as 16x16 to 1920x1080 at 1 to 60 Hz."""
    least = f"{size.width.least}x{size.height.least}"
    ranges = "" if least == str(size) else f"{least} to "
    rates = ", ".join(map(_rate, size.rates))
    return f"{ranges}{size} at {rates} Hz" if rates else f"{ranges}{size}"


def _rate(span: Span) -> str:
    least, most = (f"{stated(rate):g}" for rate in (span.least, span.most))
    return most if least == most else f"{least} to {most}"


def _word(text: str) -> str:
    """A name as files and keys may have it. Drivers repeat themselves after a colon."""
    return re.sub(r"[^a-z0-9]+", "_", text.partition(":")[0].lower()).strip("_") or "camera"
