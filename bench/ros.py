"""A clip as ROS image topics, through both sides, to a subscriber: pictures delivered, sizes, latency.

  python bench/ros.py CLIP.mp4
  python bench/ros.py CLIP.mp4 --cameras 2 --fps 2 --seconds 20
  python bench/ros.py CLIP.mp4 --version 1
  python bench/ros.py CLIP.mp4 --bag                        from a bag, without ROS

Starts a node that publishes the clip as topics of 480x270 (simultaneously, in ROS 2 reliable), the demo with source=ros
and ros.pictures=true, and a node that subscribes to the decoded pictures. Mode A for the first half, then mode C
with a fifth of the bitrate and smaller pictures. Needs `make ros2`, or `make ros1` for version 1. With --bag the same
topics are in a bag (MCAP), and the demo's own table shows what arrived.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from bags import BEGAN_NS, image, typestore, write_bag
from ros_domain import MISSING, Ros, running

from rig import CHECKOUT, free_port
from runner.configuration.config import configuration
from runner.ros.inputs import ros_name

WIDTH, HEIGHT = 480, 270
PICTURES = 100  # of the clip, which repeat
KBPS = 500  # for each camera in mode A
END_S = 20.0
NODE = "/tod_runner_operator"


class Row(NamedTuple):
    """A camera: pictures published and delivered with a stamp, between the first and the last of these.

    sizes       before and after the change of mode, px
    latency_ms  from stamp to subscriber
    """

    camera: str
    published: int
    delivered: int
    sizes: tuple[str, str]
    latency_ms: list[float]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", type=Path)
    for name, default in (("cameras", 8), ("fps", 10), ("seconds", 30)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--version", type=int, choices=(2, 1), default=2, help="of ROS")
    parser.add_argument("--bag", action="store_true", help="from a bag, without ROS")
    options = parser.parse_args()
    cameras = list(configuration([]).vehicle().cameras)[: options.cameras]
    topics = {name: f"/{ros_name(name)}/image_raw" for name in cameras}
    try:
        pictures = pictures_of(options.clip, WIDTH, HEIGHT, PICTURES)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 1
    if options.bag:
        return from_bag(pictures, topics, options.fps, options.seconds)
    if MISSING[options.version]:
        print(MISSING[options.version], file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory() as directory, running(options.version, Path(directory)) as ros:
        decoded = {name: f"{NODE}/camera/{ros_name(name)}/image" for name in cameras}
        with (
            publishing(ros, pictures, options.fps, Path(directory), *topics.values()) as publisher,
            node(ros, "subscribe", *decoded.values()) as subscriber,
        ):
            words = ["source=ros", *ros.words, "ros.pictures=true"]
            status = subprocess.run(
                demo(words, topics, above(options.fps), options.seconds), check=False, cwd=CHECKOUT
            ).returncode
            delivered, published = results(subscriber), results(publisher)
    if status == 0:
        show([row(name, published[topics[name]], delivered[decoded[name]]) for name in cameras])
    return status


def pictures_of(clip: Path, width: int, height: int, most: int) -> list[np.ndarray]:
    """The first pictures of a clip, as BGR of this size.

    raises  ValueError if there are none
    """
    video, pictures = cv2.VideoCapture(str(clip)), []
    while len(pictures) < most and (read := video.read())[0]:
        pictures.append(cv2.resize(read[1], (width, height), interpolation=cv2.INTER_AREA))
    if not pictures:
        raise ValueError(f"{clip}: no pictures can be read")
    return pictures


@contextmanager
def publishing(
    ros: Ros, pictures: Sequence[np.ndarray], fps: int, directory: Path, *topics: str
) -> Iterator[subprocess.Popen[str]]:
    """A node that publishes the pictures on all topics; the directory holds them meanwhile."""
    file, (height, width, _) = directory / "clip.bgr", pictures[0].shape
    file.write_bytes(b"".join(picture.tobytes() for picture in pictures))
    with node(ros, "publish", *map(str, (file, width, height, fps)), *topics) as process:
        yield process


def above(fps: float) -> float:
    """Slightly above the rate of the pictures: those beyond fps_max are dropped, and clocks are not exact."""
    return 1.2 * fps


def bag_of(
    pictures: Sequence[np.ndarray], fps: int, path: Path, topics: Iterable[str], message: Callable[..., Any]
) -> Path:
    """A bag (MCAP) with the pictures on all topics.

    message  of a type store, a stamp in ns, and a picture
    """
    store = typestore("mcap")
    stamped = [(BEGAN_NS + number * 10**9 // fps, picture) for number, picture in enumerate(pictures)]
    messages = [(ns, message(store, ns, picture)) for ns, picture in stamped]
    return write_bag(path, "mcap", dict.fromkeys(topics, messages))


def raw(store: Any, ns: int, picture: np.ndarray) -> Any:
    return image(store, ns, picture, "bgr8")


def from_bag(pictures: Sequence[np.ndarray], topics: Mapping[str, str], fps: int, seconds: int) -> int:
    """The same topics from a bag; returns the demo's exit status."""
    with tempfile.TemporaryDirectory() as directory:
        words = ["source=bag", f"source.bag={bag_of(pictures, fps, Path(directory, 'clip'), topics.values(), raw)}"]
        return subprocess.run(demo(words, topics, fps, seconds), check=False, cwd=CHECKOUT).returncode


def demo(words: Sequence[str], topics: Mapping[str, str], fps: float, seconds: int) -> list[str]:
    left_out = [f"~cameras.{name}" for name in configuration([]).vehicle().cameras if name not in topics]
    mounted = [f"cameras.{name}.topic={topic}" for name, topic in topics.items()]
    size = [f"cameras.{name}.{key}" for name in topics for key in (f"width_px={WIDTH}", f"height_px={HEIGHT}")]
    total = KBPS * len(topics)
    change = f"{{at_s: {seconds // 2}, request: {{event: mode_selected, mode: collective}}}}"
    less = f"{{at_s: {seconds // 2}, request: {{event: total_set, kbps: {total // 5}}}}}"
    own = [*words, "modes=paper", f"fps_max={fps:g}", "page.serve=false"]
    own += ["pqos=constant", f"pqos.kbps={total}", f"+experiment.requests=[{change}, {less}]"]
    own += ["+experiment.about='Image topics of ROS'", f"+experiment.duration_s={seconds}"]
    own += [f"media.port={free_port()}", f"control.port={free_port()}", f"duration_s={seconds}"]
    return [sys.executable, "-m", "runner", "demo", *left_out, *mounted, *size, *own]


@contextmanager
def node(ros: Ros, *words: str) -> Iterator[subprocess.Popen[str]]:
    with ros.start(Path(__file__).with_name("ros_node.py"), *words) as process:
        try:
            yield process
        finally:
            process.kill()


def results(process: subprocess.Popen[str]) -> dict[str, list[Any]]:
    """What a node has seen, by topic."""
    seen: dict[str, list[Any]] = json.loads(process.communicate(timeout=END_S)[0])
    return seen


def row(camera: str, published: Sequence[float], delivered: Sequence[Sequence[float]]) -> Row:
    stamped = [one for one in delivered if one[0]]  # a picture whose capture time is unknown has a stamp of 0
    if not stamped:
        return Row(camera, len(published), len(delivered), ("-", "-"), [])
    first, last = stamped[0][0] - 0.01, stamped[-1][0] + 0.01  # stamps change a little on their way
    sizes = [f"{width}x{height}" for _, width, height, _ in stamped]
    sent = sum(first <= stamp <= last for stamp in published)
    return Row(camera, sent, len(stamped), (sizes[len(sizes) // 4], sizes[-1]), [1e3 * one[3] for one in stamped])


def show(rows: Sequence[Row]) -> None:
    every = [ms for one in rows for ms in one.latency_ms]
    total = Row("all", sum(one.published for one in rows), sum(one.delivered for one in rows), ("", ""), every)
    heads = ("published", "delivered", "", "mode A", "mode C", "p50 ms", "p95 ms")
    print(f"{'camera':14}" + "".join(f"{head:>10}" for head in heads))
    for one in (*rows, total):
        latency = [f"{np.percentile(one.latency_ms, share):.1f}" if one.latency_ms else "-" for share in (50, 95)]
        delivered = f"{100 * one.delivered / one.published:.1f} %" if one.published else "-"
        cells = (one.published, one.delivered, delivered, *one.sizes, *latency)
        print(f"{one.camera:14}" + "".join(f"{cell:>10}" for cell in cells))


if __name__ == "__main__":
    sys.exit(main())
