"""Pictures from topics to the process that started the node, and from that process to topics."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Hashable
from typing import Any

from .port import Port

POLL_S = 0.5  # between two updates of the known topics
ABSENT_S = 5.0  # a topic without a picture for this long is reported
LATE_NS = 200_000_000  # pictures in the queue that are this much older than the newest are left out
COUNT_S, MOST_LOST = 5.0, 0.05  # over this time pictures are counted; a larger share of losses is reported
CLOSE_NS, TRIES = 100_000, 10  # readings within this count as simultaneous; otherwise the closest of so many
SECOND_NS = 1_000_000_000


class PictureCount:
    """Counts the pictures of a topic that arrive at this node, and those lost before it passes them on."""

    def __init__(self) -> None:
        self._newest: dict[Hashable, int] = {}  # by publisher, number of its newest picture
        self._since = time.monotonic()
        self._lossy = False  # as reported
        self._begin()

    def _begin(self) -> None:
        self._arrived = self._missing = 0  # missing ones according to the publishers' numbers
        self.lost_in_transport = 0  # of those missing, as far as the middleware knows
        self.late = 0  # of those that arrived

    def add(self, publisher: Hashable, number: int | None) -> int:
        """Count a picture that has arrived, with its publisher's number; None: the middleware does not number them.

        returns  how many of this publisher are missing before it
        """
        self._arrived += 1
        if number is None:
            return 0
        missing = max(0, number - self._newest.get(publisher, number - 1) - 1)
        self._missing += missing
        self._newest[publisher] = number
        return missing

    def update(self) -> str:
        """Whether and where pictures are lost, as a report; "" if nothing has changed. To be called every POLL_S."""
        if time.monotonic() - self._since < COUNT_S:
            return ""
        self._since = time.monotonic()
        missing = max(self._missing, self.lost_in_transport)
        lost, all_of_them = missing + self.late, missing + self._arrived
        was_lossy, self._lossy = self._lossy, lost > MOST_LOST * all_of_them
        here = lost - self.lost_in_transport
        where = f"{self.lost_in_transport} between publisher and node, {here} since the node ran late"
        self._begin()
        if self._lossy and not was_lossy:
            return f"{lost} of {all_of_them} pictures were lost, {where}; docs/ros.md states what helps"
        return "no more pictures are lost" if was_lossy and not self._lossy else ""


class PictureTopic:
    """A topic whose pictures are passed on. Each problem is reported once. Used in one thread.

    now_ns  the node's clock, which may be that of a simulation
    """

    def __init__(self, port: Port, name: str, now_ns: Callable[[], int]) -> None:
        self._port, self.name, self._now_ns = port, name, now_ns
        self._last_arrival = time.monotonic()  # of a picture
        self._faults: set[str] = set()
        self.losses = PictureCount()

    def fail(self, why: str) -> None:
        if why not in self._faults:
            self._faults.add(why)
            self._port.report(why, self.name)

    def check_arrivals(self, silence: str) -> None:
        """Report a topic without pictures, and lost pictures. To be called every POLL_S.

        silence  why no picture arrives, if none does
        """
        if time.monotonic() - self._last_arrival > ABSENT_S and not self._faults:
            self.fail(f"{silence} for {ABSENT_S:g} s")
        if report := self.losses.update():
            self._port.report(report, self.name)

    def pass_on(self, message: Any, stamp: int) -> None:
        """Pass on a picture with its age.

        stamp  from its header, ns; 0: none, so its age is unknown
        """
        at, now = self._read_clocks()
        if self._faults:
            silent_s = time.monotonic() - self._last_arrival
            self._faults.clear()
            self._port.report(f"pictures arrive again, after {silent_s:.0f} s", self.name)
        self._last_arrival = time.monotonic()
        data, age = memoryview(message.data), now - stamp if stamp else None
        self._port.send_picture(data, topic=self.name, size=len(data), at=at, age=age, **properties_of(message))

    def _read_clocks(self) -> tuple[int, int]:
        """CLOCK_MONOTONIC and the node's clock, ns; read again if this process was suspended in between."""
        readings: list[tuple[int, int, int]] = []
        while len(readings) < TRIES and min(readings, default=(CLOSE_NS + 1,))[0] > CLOSE_NS:
            before, now, after = time.monotonic_ns(), self._now_ns(), time.monotonic_ns()
            readings.append((after - before, (before + after) // 2, now))
        return min(readings)[1:]


def properties_of(message: Any) -> dict[str, Any]:
    """Properties of the data of an Image or a CompressedImage."""
    if not hasattr(message, "encoding"):
        return {"stated": message.format}
    form = {"encoding": message.encoding, "width": message.width, "height": message.height, "step": message.step}
    return {**form, "big": bool(message.is_bigendian)}


class PictureQueue:
    """Pictures that wait to be published, at most one for each topic: the newest."""

    def __init__(self) -> None:
        self._newest: dict[str, tuple[dict[str, Any], int]] = {}  # by topic: properties, and the memory
        self._lock = threading.Lock()

    def put(self, order: dict[str, Any], memory: int) -> bool:
        """Add a picture and its memory, from any thread. Returns False if one of its topic already waits."""
        with self._lock:
            before = self._newest.pop(order["picture"], None)
            self._newest[order["picture"]] = order, memory
        if before:
            os.close(before[1])
        return not before

    def take(self, topic: str) -> tuple[dict[str, Any], int]:
        """The picture that waits, and its memory, which the caller must close."""
        with self._lock:
            return self._newest.pop(topic)


def image_fields(order: dict[str, Any]) -> dict[str, Any]:
    """Fields of an Image by name, without header and data."""
    return {key: order[key] for key in ("encoding", "width", "height", "step")}


def info_fields(order: dict[str, Any]) -> dict[str, Any]:
    """Fields of a CameraInfo by their names in ROS 1, without header. Unknown intrinsics are left at zero."""
    fields: dict[str, Any] = {"width": order["width"], "height": order["height"]}
    if lens := order["intrinsics"]:
        fx, fy, cx, cy = (lens[key] for key in ("fx", "fy", "cx", "cy"))
        fields["distortion_model"] = lens["model"]
        fields["D"] = [0.0] * (4 if lens["model"] == "equidistant" else 5)
        fields["K"] = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        fields["R"] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        fields["P"] = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return fields
