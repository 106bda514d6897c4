"""Key frames that repair pictures after packet loss, or after an uplink has failed. Pure: time is passed in."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from runner.core.decision import Decision
from runner.core.graph_settings import NEVER_S

KEY_FRAME_S = 0.5  # between two of a camera: each costs bits of the next pictures
WATCHER_KEY_FRAME_S = 3.0  # likewise, if those who only watch ask: it costs the driver's picture


@dataclass
class KeyFrames:
    _sent: dict[str, float] = field(default_factory=dict)  # by camera, time of the last one

    def due(self, damaged: Iterable[str], t: float, every_s: float = KEY_FRAME_S) -> list[str]:
        """The cameras that are sent a key frame now, of those with unrecovered loss."""
        due = sorted(name for name in damaged if t - self._sent.get(name, -every_s) >= every_s)
        self._sent |= dict.fromkeys(due, t)
        return due

    def to_repair(self, damaged: Iterable[str], decision: Decision, t: float, drives: bool) -> list[str]:
        """Those of the cameras that an operator reports as damaged; one that is not sent needs none.

        drives  whether that operator is in control; for another one, refresh waves heal a picture, if there are any
        """
        sending = {name: setting.wave_s or 0 for name, setting in decision.settings.items() if setting.sending}
        if drives:
            return self.due(sending.keys() & set(damaged), t)
        healed_so = {name for name, wave_s in sending.items() if wave_s >= NEVER_S}
        return self.due(healed_so.intersection(damaged), t, WATCHER_KEY_FRAME_S)


def cut_off(before: Decision, after: Decision) -> list[str]:
    """The cameras whose uplinks have all just stalled, and whose new one gives them less than they had.

    What the stalled ones have swallowed would take longer to send again than it took to send, and delay what follows.
    """
    return [
        name
        for name, now in after.settings.items()
        if (had := before.settings[name].uplinks)
        and now.uplinks
        and now.uplinks[0] not in had
        and all(after.uplinks[uplink].stalled for uplink in had)
        and now.kbps < before.settings[name].kbps
    ]
