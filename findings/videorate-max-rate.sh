#!/usr/bin/env bash
# videorate's max-rate is documented as "Maximum framerate allowed to pass through (in frames per second, implies
# drop-only)", but it does not imply drop-only: a gap of 4 s in the times of the pictures is filled with 39 copies of the
# last one. With drop-only=true in addition there is none.
# Seen with Debian 12: gstreamer1.0-plugins-base 1.22.0-3+deb12u7, python3-gi 3.42.2-3+b1.
# Exits with 1 if the behaviour differs, with 2 if this version is not to be had. Needs python3-gi.
set -eu
. "$(dirname "$0")/pinned"
pinned gstreamer1.0-plugins-base=1.22.0-3+deb12u7
/usr/bin/python3 - <<'PYTHON'
import sys

try:
    import gi

    gi.require_version("Gst", "1.0")
    from gi.repository import Gst
except (ImportError, ValueError) as error:
    print(error)
    sys.exit(2)
Gst.init(None)
print(Gst.version_string())


def duplicates(properties: str) -> int:
    caps = "video/x-raw,format=I420,width=16,height=16,framerate=40/1"
    line = f"appsrc name=source format=time caps={caps} ! videorate name=rate {properties} ! fakesink sync=false"
    pipeline = Gst.parse_launch(line)
    pipeline.set_state(Gst.State.PLAYING)
    source, rate = map(pipeline.get_by_name, ("source", "rate"))
    for at in [*range(40), *range(200, 240)]:  # 40 Hz, from 0 to 1 s and from 5 to 6 s
        picture = Gst.Buffer.new_wrapped(bytes(384))
        picture.pts = at * Gst.SECOND // 40
        source.emit("push-buffer", picture)
    source.emit("end-of-stream")
    pipeline.get_bus().timed_pop_filtered(5 * Gst.SECOND, Gst.MessageType.EOS | Gst.MessageType.ERROR)
    found = rate.get_property("duplicate")
    pipeline.set_state(Gst.State.NULL)
    return found


alone, both = duplicates("max-rate=10"), duplicates("max-rate=10 drop-only=true")
print(f"copies with max-rate=10: {alone}; with drop-only=true as well: {both}")
sys.exit(not (alone > 30 and both == 0))
PYTHON
