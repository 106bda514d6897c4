"""Pictures of ROS topics for cameras: their type, whether they can be passed on, and what to report about them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from mmap import PROT_READ, mmap
from types import SimpleNamespace
from typing import NamedTuple

from runner.bag.compressed import compressed_form
from runner.bag.pictures import image_format, must_be_packed, packed_rows
from runner.core.model import Camera
from runner.ros.process import Message, NodeProcess
from runner.settings import RosSettings
from runner.system.clocks import SECOND_NS

OLD_NS = SECOND_NS  # a stamp that is older, or further in the future than FUTURE_NS, is from another clock
FUTURE_NS = 20_000_000
RATE_WINDOW_S = 5.0  # over which rates are measured
ENOUGH = 0.8  # share of the camera's rate


class PictureType(NamedTuple):
    """format: as in `runner.bag.pictures.Picture`; width, height: px."""

    format: str
    width: int
    height: int

    def __str__(self) -> str:
        return f"{self.format} {self.width}x{self.height}"


@dataclass(frozen=True, slots=True)
class SharedPicture:
    """A picture in memory that another process has filled.

    memory    file descriptor; whoever takes the picture closes it
    size      bytes
    step      bytes from one row to the next; 0: it is compressed
    captured  ns by CLOCK_MONOTONIC
    untimed   whether the capture time is unknown and `captured` is the time of arrival
    """

    memory: int
    size: int
    type: PictureType
    step: int
    captured: int
    untimed: bool = False

    def copy(self) -> SharedPicture:
        """Another descriptor of the same memory."""
        return replace(self, memory=os.dup(self.memory))


class RosCameras:
    """The node that subscribes to the topics of cameras, from `start` until `close`.

    insecure   whether unauthenticated nodes on other machines may be discovered
    push       called with a camera's name and its next picture, which it closes; from one thread
    on_report  called with a camera's name, or "" for all of them, and one line; from the same thread
    """

    def __init__(
        self,
        settings: RosSettings,
        cameras: Iterable[Camera],
        push: Callable[[str, SharedPicture], bool],
        on_report: Callable[[str, str], None],
        insecure: bool = False,
    ) -> None:
        self._push, self._on_report = push, on_report
        self._streams: dict[str, list[CameraStream]] = {}  # by topic
        for camera in cameras:
            if camera.topic:
                self._streams.setdefault(camera.topic, []).append(CameraStream(camera, on_report))
        self._node = NodeProcess(settings, self._take, self._report, pictures=self._streams, insecure=insecure)

    def start(self, *, patient: bool = False) -> None:
        """raises RunError if the node does not start; see `NodeProcess.start`"""
        self._node.start(patient=patient)

    def close(self) -> None:
        self._node.close()

    def _report(self, topic: str, what: str) -> None:
        if not topic:
            self._on_report("", what)
        for stream in self._streams.get(topic, ()):
            stream.report(what)

    def _take(self, message: Message, memory: int) -> None:
        try:
            for stream in self._streams[message["topic"]]:
                if picture := stream.add(message, memory):
                    self._push(stream.name, picture.copy() if picture.memory == memory else picture)
        finally:
            os.close(memory)


class CameraStream:
    """State of the pictures of a camera's topic. Reports each change once."""

    def __init__(self, camera: Camera, on_report: Callable[[str, str], None]) -> None:
        self._camera, self._on_report = camera, on_report
        self.name = camera.name
        self._faults: set[str] = set()  # why pictures are left out, until one is passed on
        self._type: PictureType | None = None
        self._captured = 0  # of the last picture, ns
        self._untimed = False  # whether the last stamp was from another clock
        self._rated = (0, 0)  # count of pictures, and the arrival of the first of them, ns
        self._slow = False

    def report(self, what: str) -> None:
        self._on_report(self.name, f"{self._camera.topic}: {what}")

    def add(self, message: Message, memory: int) -> SharedPicture | None:
        """The picture of a message, in its memory or in that of a copy; None if it is left out, which is reported."""
        try:
            kind = _picture_type(message, memory)
        except ValueError as error:
            self._leave_out(f"{error}: such pictures are skipped")
            return None
        captured = self._capture_time(message)
        self._rate(message["at"])
        if captured <= self._captured:
            self._leave_out("a picture is not later than the one before: such pictures are skipped")
            return None
        self._captured = captured
        self._faults.clear()
        self._note_type(kind)
        size, step = message["size"], message.get("step", 0)
        if step and must_be_packed(_raw_form(message)):
            memory, size, step = _packed(message, memory, self._camera.source.depth_m)
        return SharedPicture(memory, size, kind, step, captured, self._untimed)

    def _leave_out(self, why: str) -> None:
        if why not in self._faults:
            self._faults.add(why)
            self.report(why)

    def _note_type(self, kind: PictureType) -> None:
        before, self._type = self._type, kind
        if kind == before:
            return
        width, height = self._camera.source_size
        small = kind.width < width or kind.height < height
        scaled = f", scaled up to the camera's {width}x{height}" if small else ""
        self.report(f"pictures are {kind}{scaled}" + (f"; they were {before}" if before else ""))

    def _capture_time(self, message: Message) -> int:
        """By CLOCK_MONOTONIC, ns: from the stamp, or the time of arrival if the stamp is from another clock."""
        at, age = int(message["at"]), message["age"]
        untimed = age is None or not -FUTURE_NS <= age <= OLD_NS
        if untimed != self._untimed:
            self._untimed = untimed
            self.report(_stamp_problem(age) if untimed else "stamps are correct again")
        return at if untimed else at - max(0, age)

    def _rate(self, at: int) -> None:
        """Compare the rate with that of the camera."""
        count, since = self._rated
        if not since or at - since < RATE_WINDOW_S * SECOND_NS:
            self._rated = (count + 1, since or at)
            return
        rate, fps = (count * SECOND_NS) / (at - since), float(self._camera.fps)
        self._rated = (1, at)
        slow = rate < ENOUGH * fps
        if slow != self._slow:
            self._slow = slow
            self.report(f"{rate:.1f} pictures a second, the camera's fps is {fps:g}")


def _picture_type(message: Message, memory: int) -> PictureType:
    """raises ValueError with the rule that a picture breaks"""
    if "encoding" in message:
        form = _raw_form(message)
        return PictureType(image_format(form, message["size"]), form.width, form.height)
    if not message["size"]:
        raise ValueError("an empty picture")
    with mmap(memory, message["size"], prot=PROT_READ) as data:
        return PictureType(*compressed_form(data, message["stated"]))


def _raw_form(message: Message) -> SimpleNamespace:
    """As `RawForm`."""
    form = {key: message[key] for key in ("encoding", "width", "height", "step")}
    return SimpleNamespace(**form, is_bigendian=message["big"])


def _packed(message: Message, memory: int, depth_m: float) -> tuple[int, int, int]:
    """A copy with rows that GStreamer reads: its memory, bytes, and bytes from one row to the next."""
    rows = packed_rows(_raw_form(message), mmap(memory, message["size"], prot=PROT_READ), depth_m)
    copy = os.memfd_create("picture")
    with os.fdopen(copy, "wb", closefd=False) as file:
        file.write(rows.tobytes())
    return copy, rows.nbytes, rows.shape[1]


def _stamp_problem(age: int | None) -> str:
    if age is None:
        return "pictures have no stamp: their latency is unknown"
    of = f"{age / SECOND_NS:.2f} s old" if age > 0 else f"{-age / SECOND_NS:.2f} s in the future"
    return f"a stamp is {of}: the latency of these pictures is unknown"
