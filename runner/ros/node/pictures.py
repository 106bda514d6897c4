"""Pictures of topics on their way to the process that started the node, and of that process on their way to topics."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Hashable
from typing import Any

from .port import Port

LOOK_S = 0.5  # how often topics are looked for
ABSENT_S = 5.0  # a topic without a picture for so long is reported
LATE_NS = 200_000_000  # of pictures that wait for this node, those so much older than the newest are left out
COUNT_S, MOST_LOST = 5.0, 0.05  # pictures are counted over so long; if more of them are lost, that is reported
CLOSE_NS, TRIES = 100_000, 10  # clocks read within this count as read at once, or else the closest of so many readings
SECOND_NS = 1_000_000_000


class PictureCount:
    """Counts the pictures of a topic that come to this node, and those that are lost before it passes them on."""

    def __init__(self) -> None:
        self._newest: dict[Hashable, int] = {}  # by publisher, number of its newest picture
        self._since = time.monotonic()
        self._lossy = False  # as reported
        self._begin()

    def _begin(self) -> None:
        self._came = self._missing = 0  # the latter by the publishers' numbers
        self.untransported = 0  # of those missing, as far as the middleware knows
        self.late = 0  # of those that came

    def add(self, publisher: Hashable, number: int | None) -> int:
        """A picture has come, with its publisher's number for it; None: the middleware does not number pictures.

        returns  how many of this publisher are missing before it
        """
        self._came += 1
        if number is None:
            return 0
        missing = max(0, number - self._newest.get(publisher, number - 1) - 1)
        self._missing += missing
        self._newest[publisher] = number
        return missing

    def take_news(self) -> str:
        """Whether pictures are lost, and where; "" if nothing has changed. To be called every LOOK_S."""
        if time.monotonic() - self._since < COUNT_S:
            return ""
        self._since = time.monotonic()
        missing = max(self._missing, self.untransported)
        lost, all_of_them = missing + self.late, missing + self._came
        were, self._lossy = self._lossy, lost > MOST_LOST * all_of_them
        here = lost - self.untransported
        where = f"{self.untransported} between publisher and node, {here} since the node ran late"
        self._begin()
        if self._lossy and not were:
            return f"{lost} of {all_of_them} pictures were lost, {where}; docs/ros.md states what helps"
        return "no pictures are lost any more" if were and not self._lossy else ""


class PictureTopic:
    """A topic with pictures, which are passed on. What is wrong with it is reported once each. Used in one thread.

    now_ns  the node's clock, which may be that of a simulation
    """

    def __init__(self, port: Port, name: str, now_ns: Callable[[], int]) -> None:
        self._port, self.name, self._now_ns = port, name, now_ns
        self._heard = time.monotonic()  # when the last picture came
        self._faults: set[str] = set()
        self.losses = PictureCount()

    def fail(self, why: str) -> None:
        if why not in self._faults:
            self._faults.add(why)
            self._port.report(why, self.name)

    def judge(self, silence: str) -> None:
        """Report a topic without pictures, and pictures that are lost. To be called every LOOK_S.

        silence  why no picture comes, if none does
        """
        if time.monotonic() - self._heard > ABSENT_S and not self._faults:
            self.fail(f"{silence} for {ABSENT_S:g} s")
        if news := self.losses.take_news():
            self._port.report(news, self.name)

    def pass_on(self, message: Any, stamp: int) -> None:
        """Pass on a picture with its age.

        stamp  of its header, ns; 0: it has none, and its age is unknown
        """
        at, now = self._read_clocks()
        if self._faults:
            silent_s = time.monotonic() - self._heard
            self._faults.clear()
            self._port.report(f"pictures come again, after {silent_s:.0f} s", self.name)
        self._heard = time.monotonic()
        data, age = memoryview(message.data), now - stamp if stamp else None
        self._port.send_picture(data, topic=self.name, size=len(data), at=at, age=age, **form_of(message))

    def _read_clocks(self) -> tuple[int, int]:
        """CLOCK_MONOTONIC and the node's clock, ns; again if this process did not run between the two."""
        readings: list[tuple[int, int, int]] = []
        while len(readings) < TRIES and min(readings, default=(CLOSE_NS + 1,))[0] > CLOSE_NS:
            before, now, after = time.monotonic_ns(), self._now_ns(), time.monotonic_ns()
            readings.append((after - before, (before + after) // 2, now))
        return min(readings)[1:]


def form_of(message: Any) -> dict[str, Any]:
    """What is known about the data of an Image or a CompressedImage."""
    if not hasattr(message, "encoding"):
        return {"stated": message.format}
    form = {"encoding": message.encoding, "width": message.width, "height": message.height, "step": message.step}
    return {**form, "big": bool(message.is_bigendian)}


class PictureQueue:
    """Pictures that wait to be published, one of each topic at most: the newest."""

    def __init__(self) -> None:
        self._newest: dict[str, tuple[dict[str, Any], int]] = {}  # by topic: what is known, and the memory
        self._lock = threading.Lock()

    def put(self, order: dict[str, Any], memory: int) -> bool:
        """Take a picture and its memory, from any thread. Returns False if one of its topic waits to be published."""
        with self._lock:
            before = self._newest.pop(order["picture"], None)
            self._newest[order["picture"]] = order, memory
        if before:
            os.close(before[1])
        return not before

    def take(self, topic: str) -> tuple[dict[str, Any], int]:
        """The picture that waits, and its memory, which is then the caller's to close."""
        with self._lock:
            return self._newest.pop(topic)


def image_fields(order: dict[str, Any]) -> dict[str, Any]:
    """Fields of an Image, by their names, without header and data."""
    return {key: order[key] for key in ("encoding", "width", "height", "step")}


def info_fields(order: dict[str, Any]) -> dict[str, Any]:
    """Fields of a CameraInfo, by their names in ROS 1, without header. Unknown intrinsics are left out, as zeros."""
    fields: dict[str, Any] = {"width": order["width"], "height": order["height"]}
    if lens := order["intrinsics"]:
        fx, fy, cx, cy = (lens[key] for key in ("fx", "fy", "cx", "cy"))
        fields["distortion_model"] = lens["model"]
        fields["D"] = [0.0] * (4 if lens["model"] == "equidistant" else 5)
        fields["K"] = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        fields["R"] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        fields["P"] = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return fields
