#!/usr/bin/env bash
# x264enc puts an access unit delimiter (2 bytes) in front of each picture unless told `aud=false`, and rtph264pay sends
# it as a packet of its own: 100 small pictures are 205 packets instead of 105. Over UDP and IPv4 each such packet
# has 40 bytes of headers, 8 kbit/s of each camera at 25 Hz, and its loss looks like that of a picture.
# Seen with Debian 12: gstreamer1.0-plugins-ugly 1.22.0-2+deb12u2, gstreamer1.0-plugins-good 1.22.0-5+deb12u4.
# Exits with 1 if the behaviour differs, with 2 if these versions are not to be had. Needs python3-gi.
set -eu
. "$(dirname "$0")/pinned"
pinned gstreamer1.0-plugins-ugly=1.22.0-2+deb12u2 gstreamer1.0-plugins-good=1.22.0-5+deb12u4

/usr/bin/python3 - <<'PYTHON'
import gi

gi.require_version("Gst", "1.0")
from gi.repository import Gst

Gst.init(None)
DELIMITER = 9  # NAL unit type (ITU-T H.264, table 7-1)


def packets(more):
    """How many packets 100 pictures are, and how many of them hold a delimiter and nothing else."""
    pipeline = Gst.parse_launch(
        "videotestsrc num-buffers=100 pattern=ball ! video/x-raw,format=I420,width=160,height=96,framerate=25/1"
        f" ! x264enc tune=zerolatency threads=1 bitrate=100 key-int-max=1000 {more}"
        " ! rtph264pay config-interval=-1 ! appsink name=sink sync=false"
    )
    sink, sizes = pipeline.get_by_name("sink"), []
    pipeline.set_state(Gst.State.PLAYING)
    while sample := sink.emit("try-pull-sample", 5 * Gst.SECOND):
        listed = sample.get_buffer_list()
        buffers = [listed.get(at) for at in range(listed.length())] if listed else [sample.get_buffer()]
        sizes += [buffer.extract_dup(12, buffer.get_size() - 12) for buffer in buffers]
    pipeline.set_state(Gst.State.NULL)
    return len(sizes), sum(payload[0] & 0x1F == DELIMITER for payload in sizes)


(count, alone), (fewer, none) = packets(""), packets("aud=false")
print(f"as it is: {count} packets, {alone} with a delimiter alone; with aud=false: {fewer} packets, {none}")
raise SystemExit(not (alone == 100 and none == 0 and count - fewer == 100))
PYTHON
