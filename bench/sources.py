"""What a camera of 1920x1040 costs the vehicle, by source: processor time, and cameras per two cores.

  python bench/sources.py CLIP.mp4
  python bench/sources.py CLIP.mp4 --fps 15 --only file bag ros2

Each way delivers the same pictures of the clip, and the camera is sent at factor 0.5 with its whole bitrate. Processor
time includes that of the side's child processes, such as the node of ROS; not that of publisher, IP camera and client.
ROS needs `make ros2` and `make ros1`; the row of a version that is missing says so.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from bags import compressed
from cost import WAIT_S, Frame, child_of, read_frames, write_line
from ros import above, bag_of, pictures_of, publishing, raw
from ros_domain import MISSING, running
from uplinks import row
from usage import processor_s

from rig import answers, children_named, free_port, passes, until
from runner.configuration.config import configuration
from runner.mqtt.broker import private_broker
from runner.settings import Endpoint

HERE = Path(__file__).parent
CAMERA, KBPS = "front_center", 5000
WIDTH, HEIGHT = 1920, 1040
PICTURES = 40  # of the clip, which repeat
SETTLE_S = 3.0
ATTEMPTS = 6  # to connect, within WAIT_S
TOPIC = "/front/image_raw"


class Cost(NamedTuple):
    """Of one camera: processor time per wall time, and frames received per second."""

    cores: float
    fps: float


class Clip(NamedTuple):
    """The pictures, and how often they are captured, Hz."""

    pictures: Sequence[np.ndarray]
    fps: int
    directory: Path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", type=Path)
    parser.add_argument("--fps", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=15)
    parser.add_argument("--only", nargs="*", choices=WAYS, default=[*WAYS])
    options = parser.parse_args()
    print(row("way in", "cores", "frames a second", "two cores carry"))
    print(row(*["---"] * 4), flush=True)
    with tempfile.TemporaryDirectory() as directory:
        try:
            pictures = pictures_of(options.clip, WIDTH, HEIGHT, PICTURES)
        except ValueError as error:
            raise SystemExit(str(error)) from None
        clip = Clip(pictures, options.fps, Path(directory))
        for name in options.only:
            title, missing, words_of = WAYS[name]
            if missing:
                print(row(title, "–", "–", missing))
                continue
            with words_of(clip) as words:
                cost = measure(words, options.seconds)
            print(row(title, f"{cost.cores:.2f}", f"{cost.fps:.1f}", f"{int(2 / cost.cores)}"), flush=True)


# --- the ways in: overrides that use them, while the block lasts ------------------------------------------------------


@contextmanager
def test_picture(clip: Clip) -> Iterator[list[str]]:
    yield ["source=test", f"fps_max={clip.fps}"]


@contextmanager
def clip_file(clip: Clip) -> Iterator[list[str]]:
    yield ["source=file", f"source.clip={encoded(clip)}", f"fps_max={clip.fps}"]


@contextmanager
def ip_camera(clip: Clip) -> Iterator[list[str]]:
    port, line = free_port(), f"multifilesrc location={encoded(clip, 'h264')} loop=true ! h264parse"
    line += f" ! video/x-h264,framerate={clip.fps}/1 ! identity sync=true ! rtph264pay name=pay0 config-interval=-1"
    with child_of([HERE / "bare.py", "serve", str(port)], stdin=subprocess.PIPE) as camera:
        assert camera.stdin
        write_line(camera.stdin, {"stream": f"( {line} )"})
        address = f"cameras.{CAMERA}.address=rtsp://127.0.0.1:{port}/stream"
        yield ["source=rtsp", address, f"fps_max={clip.fps}"]


@contextmanager
def passed_on(clip: Clip) -> Iterator[list[str]]:
    with ip_camera(clip) as words:
        yield [*words, "graph=pass_through"]


@contextmanager
def raw_bag(clip: Clip) -> Iterator[list[str]]:
    yield _bag(clip, raw)


@contextmanager
def jpeg_bag(clip: Clip) -> Iterator[list[str]]:
    yield _bag(clip, _jpeg)


def _bag(clip: Clip, message: Callable[..., Any]) -> list[str]:
    path = bag_of(clip.pictures, clip.fps, clip.directory / message.__name__, [TOPIC], message)
    return ["source=bag", f"source.bag={path}", f"cameras.{CAMERA}.topic={TOPIC}", f"fps_max={above(clip.fps):g}"]


def ros(version: int) -> Callable[[Clip], object]:
    @contextmanager
    def published(clip: Clip) -> Iterator[list[str]]:
        with (
            running(version, clip.directory) as started,
            publishing(started, clip.pictures, clip.fps, clip.directory, TOPIC),
        ):
            yield ["source=ros", f"cameras.{CAMERA}.topic={TOPIC}", *started.words, f"fps_max={above(clip.fps):g}"]

    return published


WAYS = {
    "test": ("`test`: GStreamer's test picture", "", test_picture),
    "file": ("`file`: a clip in H.264", "", clip_file),
    "rtsp": ("`rtsp`: an IP camera, H.264", "", ip_camera),
    "passed": ("`rtsp` with `graph=pass_through`: the same, passed on", "", passed_on),
    "bag": ("`bag`: MCAP, bgr8", "", raw_bag),
    "bag_jpeg": ("`bag`: MCAP, JPEG", "", jpeg_bag),
    "ros2": ("`ros`: a topic of ROS 2, bgr8", MISSING[2], ros(2)),
    "ros1": ("`ros`: a topic of ROS 1, bgr8", MISSING[1], ros(1)),
}


def _jpeg(store: Any, ns: int, picture: np.ndarray) -> Any:
    return compressed(store, ns, cv2.imencode(".jpg", picture)[1].tobytes(), "jpeg")


def encoded(clip: Clip, form: str = "mp4") -> Path:
    """The clip in H.264, made once."""
    path = clip.directory / f"clip.{form}"
    if not path.exists():
        caps = f"rawvideoparse format=bgr width={WIDTH} height={HEIGHT} framerate={clip.fps}/1"
        stream = "video/x-h264,profile=high,stream-format=byte-stream,alignment=au"
        last = "h264parse ! mp4mux !" if form == "mp4" else ""
        line = f"fdsrc fd=0 ! {caps} ! videoconvert ! x264enc bitrate=8000 ! {stream} ! {last} filesink location={path}"
        pictures = b"".join(picture.tobytes() for picture in clip.pictures)
        subprocess.run(["gst-launch-1.0", "-q", *line.split()], input=pictures, check=True, timeout=WAIT_S * 4)
    return path


# --- measuring --------------------------------------------------------------------------------------------------------


def measure(words: Sequence[str], seconds: float) -> Cost:
    others = [f"~cameras.{name}" for name in configuration([]).vehicle().cameras if name != CAMERA]
    media, broker = free_port(), Endpoint("127.0.0.1", free_port())
    total = ["modes=open_loop", "pqos=constant", f"pqos.kbps={KBPS}", "mode=automatic"]
    ports = [f"media.port={media}", f"control.port={broker.port}"]
    with private_broker(broker), child_of(["-m", "runner", "vehicle", *others, *words, *total, *ports]) as side:
        until(lambda: answers(media), WAIT_S)
        with _watched(f"rtsp://127.0.0.1:{media}/{CAMERA}") as frames:
            time.sleep(SETTLE_S)
            used_s, began, before = _of_all(side.pid), time.monotonic(), len(frames)
            time.sleep(seconds)
            took_s = time.monotonic() - began
            return Cost((_of_all(side.pid) - used_s) / took_s, (len(frames) - before) / took_s)


@contextmanager
def _watched(url: str) -> Iterator[list[Frame]]:
    """The frames of a client, which connects again while the source has no picture yet."""
    frames: list[Frame] = []
    for _ in range(ATTEMPTS):
        with child_of([HERE / "bare.py", "watch", url], stdout=subprocess.PIPE) as client:
            threading.Thread(target=read_frames, args=(client.stdout, frames), daemon=True).start()
            if passes(lambda: frames, WAIT_S / ATTEMPTS):
                yield frames
                return
    raise SystemExit(f"no picture within {WAIT_S:g} s")


def _of_all(pid: int) -> float:
    """Processor time of a process and its children, s."""
    return processor_s(pid) + sum(map(_of_all, children_named(pid, "")))  # of any name


if __name__ == "__main__":
    main()
