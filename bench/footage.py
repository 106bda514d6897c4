"""The pictures of a clip, decoded, for benchmarks that feed encoders themselves."""

from __future__ import annotations

from pathlib import Path

from runner.gst import Gst

WAIT = 10 * Gst.SECOND


def pictures(clip: Path, size: tuple[int, int], most: int, fps: int | None = None) -> list[bytes]:
    """Its first pictures as I420 of this size; fps: at another rate than the clip's."""
    rate = ("videorate ! ", f",framerate={fps}/1") if fps else ("", "")
    pipeline = Gst.parse_launch(
        f'filesrc location="{clip}" ! decodebin ! videoconvert ! {rate[0]}videoscale ! video/x-raw,format=I420,'
        f"width={size[0]},height={size[1]}{rate[1]},pixel-aspect-ratio=1/1 ! appsink name=out sync=false"
    )
    pipeline.set_state(Gst.State.PLAYING)
    sink, found = pipeline.get_by_name("out"), []
    while len(found) < most and (sample := sink.emit("try-pull-sample", WAIT)):
        buffer = sample.get_buffer()
        found.append(buffer.extract_dup(0, buffer.get_size()))
    pipeline.set_state(Gst.State.NULL)
    return found
