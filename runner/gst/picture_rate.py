"""How many pictures of a camera arrive, from looks at a counter: no Python runs for a picture."""

from __future__ import annotations

from collections import deque

from runner.gst.allowance import Allowance
from runner.records.vehicle import SLOW, SLOW_S

WINDOW_S = 2.0  # over which the rate is measured
SPAN_S = 0.4  # the fastest part of that, as long as this, counts for the encoder: a stall is no lower rate
MARGIN = 1.1  # by which it must differ from what the encoder was told, or from the camera's rate
PACES = (0.25, 8.0)  # limits of the pace
ANOTHER, ANOTHER_HZ = 0.15, 1.0  # change of a low rate that is told: as a share of it, and at least so much
SILENT_S, SILENT_INTERVALS = 1.0, 3  # without a picture, after which nothing is known about the rate
STEADY = 0.8  # share of the camera's rate from which it is not slow any more


class PictureRate:
    """The rate of a camera's pictures, for encoders that count frames in place of time, and for the driver.

    fps        the rate in force, Hz
    is_steady  whether it was last measured to be about that; False while nothing is known

    `pace` is the camera's rate as a multiple of the one that arrives: an encoder that counts frames holds its bitrate
    if it is told that many times as much. It rises once the lower rate has lasted for a while, and falls at once:
    each picture in excess would be as large as those before.
    """

    def __init__(self, fps: float) -> None:
        self.fps = fps
        self._counted, self._last, self._held = 0, 0.0, -WINDOW_S
        self._allowance = Allowance()
        self._forget()

    def _forget(self) -> None:
        self.pace = 1.0
        self.is_steady = False
        self.slow_fps: float | None = None  # the rate that arrives, Hz, if it has been well below the camera's for long
        self._seen: deque[tuple[float, int]] = deque()  # when a number of pictures was first counted
        self._slow_since: float | None = None
        self._risen = 0.0  # when the rate was last seen to rise

    def silent_s(self, now: float) -> float:
        """Time since the last picture, s; 0 before the first."""
        return now - self._last if self._last else 0.0

    def look(self, now: float, count: int, is_held_up: bool = False) -> None:
        """Many times a second, from one thread.

        now         s by any steady clock
        count       of the pictures so far
        is_held_up  whether the network holds up the last one: how many the camera delivers cannot be seen then
        """
        if is_held_up:
            self._held, self._slow_since = now, None
        new, self._counted = count - self._counted, count
        limit_s = max(SILENT_S, SILENT_INTERVALS * self.pace / self.fps)
        if new < 0 or (self._seen and now - self._seen[-1][0] > limit_s):
            self._forget()
        if self._allowance.is_exceeded(now, new, self.fps / self.pace) and self.pace > 1:
            self.pace, self._risen = 1.0, now
        if new > 0:
            self._last = now
            self._seen.append((now, count))
            while len(self._seen) > 2 and now - self._seen[1][0] > WINDOW_S:
                self._seen.popleft()
            if now - self._seen[0][0] >= WINDOW_S / 2 and now - self._held > WINDOW_S:
                self._measure(now)

    def _measure(self, now: float) -> None:
        mean = _rate(self._seen[0], self._seen[-1])
        self._judge(now, mean)
        if _differs(self.fps / mean, self.pace):
            # Faster than the camera's rate counts only if it lasts: pictures may come late, then all together.
            rate = min(self._fastest(), max(mean, self.fps))
            pace = min(max(self.fps / rate, PACES[0]), PACES[1])
            if _differs(pace, self.pace):
                self.pace = pace if _differs(pace, 1.0) else 1.0

    def _fastest(self) -> float:
        """The highest rate of a part of the window, Hz."""
        recent = [seen for seen in self._seen if seen[0] >= self._risen]
        rates, begin = [], 0
        for seen in recent:
            while begin + 1 < len(recent) and seen[0] - recent[begin + 1][0] >= SPAN_S:
                begin += 1
            if seen[0] - recent[begin][0] >= SPAN_S:
                rates.append(_rate(recent[begin], seen))
        return max(rates, default=self.fps)

    def _judge(self, now: float, rate: float) -> None:
        self.is_steady = rate >= self.fps * (STEADY if self.slow_fps else SLOW)
        if self.is_steady:
            self._slow_since = self.slow_fps = None
            return
        if self._slow_since is None:
            self._slow_since = now
        is_told = self.slow_fps and abs(rate - self.slow_fps) <= max(ANOTHER_HZ, ANOTHER * self.slow_fps)
        if now - self._slow_since >= SLOW_S and not is_told:
            self.slow_fps = rate


def _rate(first: tuple[float, int], last: tuple[float, int]) -> float:
    return (last[1] - first[1]) / (last[0] - first[0])


def _differs(one: float, other: float) -> bool:
    return not 1 / MARGIN < one / other < MARGIN
