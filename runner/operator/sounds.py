"""The vehicle's sound for programs: numpy arrays with the time of capture.

    with live_sound(["vehicle=delivery_robot", "sound=alsa"]) as sounds:
        for sound in sounds:                          # waits for the next one
            detect(sound.samples, sound.captured)     # int16, 48 kHz, one channel

Runs alone, or in addition to an operator as a listener like any other (`media.max_viewers`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.configuration.config import configuration
from runner.core.budget import SOUND
from runner.errors import UserError
from runner.operator.awaited import Awaited, watched
from runner.plans import sound_plan
from runner.security.exposure import viewer_keyring

KEPT = 100  # sounds that a slow program may be behind: 2 s; then it misses the oldest


class Sound(NamedTuple):
    """What one packet held, or what conceals lost ones.

    captured  when its first sample was, s since 1970 by the vehicle's clock; None: unknown
    samples   int16, 48 kHz
    """

    captured: float | None
    samples: NDArray[np.int16]


class Sounds(Awaited[Sound]):
    """Each sound once, in order."""

    def __init__(self) -> None:
        self._kept: deque[Sound] = deque(maxlen=KEPT)
        super().__init__(self._kept, self._kept.popleft)

    def put(self, captured: float | None, data: bytes) -> None:
        """Add samples from the decoder."""
        with self._changed:
            self._kept.append(Sound(captured, np.frombuffer(data, np.int16)))
            self._changed.notify()


@contextmanager
def live_sound(
    overrides: Sequence[str] = (),
    conf: Path | str | None = None,
    *,
    report: Callable[[str], None] = lambda what: None,
) -> Iterator[Sounds]:
    """Receive and decode the sound of a streaming vehicle, losses concealed; a pipeline that fails is rebuilt.

    overrides  Hydra overrides, as on the command line, also conf=DIR
    conf       directory of files of your own, which shadow the packaged ones
    report     called with what happened to it
    raises     ConfigError; UserError for a configuration without sound, or missing keys
    """
    from runner import apply

    setup = configuration(overrides, conf, runnable=False, check=apply.check_operator).setup()
    plan = sound_plan(setup)
    if plan is None:
        raise UserError("", SOUND, "null", "must be chosen, as on the vehicle: sound=alsa")
    sounds = Sounds()
    side = apply.OperatorSide(
        [],
        lambda _, what: report(what),
        keyring=viewer_keyring(setup),
        vehicle=setup.vehicle.name,
        sound=plan,
        on_samples=sounds.put,
    )

    with watched(side, sounds, lambda: side.sample({SOUND: True})):
        yield sounds
