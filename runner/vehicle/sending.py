"""How late the vehicle itself sent what has arrived: a busy machine must not be mistaken for a busy link. Pure.

If a payloader has not output a frame yet, longer after its capture than usual, the vehicle delays it. Only what is
certain counts, so that a queue in front of the link is never underestimated, with one exception: if the machine was too
busy to look in time, a frame counts as sent when it was seen.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import takewhile
from math import inf
from operator import attrgetter

from msgspec import UNSET

from runner.core.decision import NOTHING
from runner.records.reception import ReceptionReported, SentFrame

BUSY_S = 0.04  # between two looks at a payloader, twice the usual time
KEPT_S = 5.0  # a frame that arrives later is not looked up, and one that has not arrived by then is lost
BUCKET_S = 10.0  # the usual duration is the shortest of the current time bucket and the previous one
SAME_S = 0.002  # capture times of the same frame, rounded by RTP and in reports, differ by less
MAX_AHEAD_S = 1.0  # a frame that seems to arrive longer before it is seen to leave is from before a clock was stepped
ON_ITS_WAY_S = 0.05  # what was sent less than this before an operator's view of the vehicle may still arrive


@dataclass
class _Camera:
    """The frames that a camera sent recently, in order, and the shortest time from capture to sending."""

    frames: list[SentFrame] = field(default_factory=list)
    arrived: dict[str, float] = field(default_factory=dict)  # capture time of the newest frame by uplink
    began: float = -inf  # of the current time bucket
    before: float = inf
    shortest: float = inf

    @property
    def usual_s(self) -> float:
        return min(self.before, self.shortest)

    def add(self, frame: SentFrame) -> None:
        if self.frames and frame.captured < self.frames[-1].captured:  # a clock was stepped
            self.frames, self.arrived, self.began, self.shortest = [], {}, -inf, inf
        if frame.captured - self.began > BUCKET_S:
            self.began, self.before, self.shortest = frame.captured, self.shortest, inf
        self.shortest = min(self.shortest, frame.sent - frame.captured)
        self.frames.append(frame)
        if self.frames[0].captured < frame.captured - 2 * KEPT_S:
            del self.frames[: self._index(frame.captured - KEPT_S)]

    def add_arrived(self, captured: float, uplink: str) -> None:
        if self.frames and captured <= self.frames[-1].captured + MAX_AHEAD_S:
            self.arrived[uplink] = max(captured, self.arrived.get(uplink, -inf))

    def late_s(self, captured: float) -> float:
        index = self._index(captured - SAME_S)
        if index == len(self.frames) or captured < self.frames[0].captured - SAME_S:
            return 0.0
        frame = self.frames[index]
        left = frame.sent if frame.sent - frame.unsent > BUSY_S else frame.unsent
        return max(0.0, left - captured - self.usual_s)

    def missing(self, uplink: str) -> Iterator[SentFrame]:
        """The frames newer than all that have arrived by this uplink, the newest first."""
        arrived = self.arrived.get(uplink, -inf) + SAME_S
        return takewhile(lambda frame: frame.captured > arrived, reversed(self.frames))

    def _index(self, captured: float) -> int:
        """Of the first frame captured then or later."""
        return bisect_left(self.frames, captured, key=attrgetter("captured"))


@dataclass
class SendingTimes:
    """What each camera sent recently, and how much of it has arrived. Times are s since 1970 by the vehicle's clock."""

    _cameras: dict[str, _Camera] = field(default_factory=dict)

    def add(self, sent: Mapping[str, Iterable[SentFrame]]) -> None:
        """Add frames, in the order in which they were sent."""
        for name, frames in sent.items():
            camera = self._cameras.setdefault(name, _Camera())
            for frame in frames:
                camera.add(frame)

    def late_s(self, name: str, captured: float, uplink: str = "") -> float:
        """By how much longer than usual the vehicle at least took to send a frame that has arrived; 0: unknown, too."""
        camera = self._cameras.get(name)
        if camera is None:
            return 0.0
        camera.add_arrived(captured, uplink)
        return camera.late_s(captured)

    def judge(
        self, reported: ReceptionReported, made_at: float, placed: Mapping[str, Collection[str]] = NOTHING
    ) -> ReceptionReported:
        """A report, with what this side knows of its own delays.

        made_at  when it was made, by the vehicle's clock
        placed   by camera, uplinks that carry it; empty: there is one
        """
        report = reported.report
        uplink = "" if report.uplink is UNSET else report.uplink
        if not report.units:
            elsewhere = {name for name, at in placed.items() if uplink not in at}
            return replace(reported, all_received=self.is_all_received(made_at, uplink, elsewhere) or UNSET)
        if report.offset_s is UNSET:
            return reported
        at = report.at - report.offset_s
        late_s = tuple(round(self.late_s(unit.camera, unit.captured(at), uplink), 4) for unit in report.units)
        return replace(reported, late_s=late_s if any(late_s) else UNSET)

    def is_all_received(self, at: float, uplink: str = "", elsewhere: Collection[str] = ()) -> bool:
        """Whether nothing is on its way that was sent before this time: each frame, or a newer one, has arrived.

        False if that is not known.

        elsewhere  cameras that other uplinks carry
        """
        sending = [camera for name, camera in self._cameras.items() if camera.frames and name not in elsewhere]
        missing = (frame.sent for camera in sending for frame in camera.missing(uplink))
        return bool(sending) and not any(at - KEPT_S < sent <= at - ON_ITS_WAY_S for sent in missing)
