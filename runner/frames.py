"""Public: decoded pictures and sound for programs, see docs/operator.md and docs/sound.md."""

from runner.operator.frames import Frame, live_frames
from runner.operator.sounds import Sound, live_sound

__all__ = ["Frame", "Sound", "live_frames", "live_sound"]
