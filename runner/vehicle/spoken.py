"""Who has spoken at the vehicle's loudspeaker, for how long and how loud: lines for people and the log. Pure."""

from __future__ import annotations

import math

from runner.records.vehicle import VoiceReading


class Spoken:
    """Of readings several times a second."""

    def __init__(self) -> None:
        self._began: float | None = None  # s; None: nobody speaks
        self._first = self._last = VoiceReading()
        self._powers: list[float] = []

    def look(self, now: VoiceReading, t: float) -> str | None:
        """What has just begun or ended, in words; None: nothing.

        t  s, of the monotonic clock
        """
        if now.speaking and self._began is None:
            self._began, self._first, self._powers = t, self._last, []
            self._last = now
            return f"{now.operator} speaks"
        if now.speaking and now.level_db is not None:
            self._powers.append(10 ** (now.level_db / 10))
        began, before, self._last = self._began, self._last, now
        if now.speaking or began is None:
            return None
        self._began = None
        missing, all_ = now.missing - self._first.missing, now.packets + now.missing
        share = missing / max(1, all_ - self._first.packets - self._first.missing)
        power = sum(self._powers) / max(1, len(self._powers))
        level = f"{10 * math.log10(power):.0f} dB" if power else "level unknown"
        return f"{before.operator} has spoken for {t - began:.1f} s: {level}, {100 * share:.1f} % of the packets lost"
