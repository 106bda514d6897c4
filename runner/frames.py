"""Public: decoded pictures for programs, see docs/operator.md."""

from runner.operator.frames import Frame, live_frames

__all__ = ["Frame", "live_frames"]
