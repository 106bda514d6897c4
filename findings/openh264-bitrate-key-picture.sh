#!/usr/bin/env bash
# openh264enc's bitrate is changeable while playing, but the first change after a start makes a key picture, and later
# ones do not: a sender that must send less at once, because its link has become worse, then sends its largest picture.
# Seen with Debian 12: gstreamer1.0-plugins-bad 1.22.0-4+deb12u8, libopenh264-7 2.3.1+dfsg-3+deb12u2,
# Python 3.11: key pictures of 100: the first one without changes; 0 and 30 with changes before 30, 60 and 90.
# Exits with 1 if the behaviour differs, with 2 if these versions are not to be had.
set -eu
. "$(dirname "$0")/pinned"
pinned gstreamer1.0-plugins-bad=1.22.0-4+deb12u8 libopenh264-7=2.3.1+dfsg-3+deb12u2 gstreamer1.0-tools=1.22.0-2+deb12u1

/usr/bin/python3 - <<'PYTHON'
import gi

gi.require_version("Gst", "1.0")
from gi.repository import Gst

Gst.init(None)


def keys(changes):
    """Numbers of the key pictures among 100; the bitrate changes before every 30th picture, or never."""
    pipeline = Gst.parse_launch(
        "videotestsrc num-buffers=100 pattern=smpte ! video/x-raw,format=I420,width=320,height=240,framerate=25/1"
        " ! openh264enc name=e rate-control=bitrate gop-size=1000 bitrate=1000000 ! fakesink name=s signal-handoffs=true"
    )
    encoder, found, count = pipeline.get_by_name("e"), [], [0, 0]

    def on_raw(pad, info):
        if changes and count[0] and count[0] % 30 == 0:
            encoder.set_property("bitrate", 1_000_000 - 1000 * count[0])
        count[0] += 1
        return Gst.PadProbeReturn.OK

    def on_coded(sink, buffer, pad):
        if not buffer.has_flags(Gst.BufferFlags.DELTA_UNIT):
            found.append(count[1])
        count[1] += 1

    encoder.get_static_pad("sink").add_probe(Gst.PadProbeType.BUFFER, on_raw)
    pipeline.get_by_name("s").connect("handoff", on_coded)
    pipeline.set_state(Gst.State.PLAYING)
    pipeline.get_bus().timed_pop_filtered(20 * Gst.SECOND, Gst.MessageType.EOS | Gst.MessageType.ERROR)
    pipeline.set_state(Gst.State.NULL)
    return found


steady, changed = keys(False), keys(True)
print(f"key pictures at a steady bitrate: {steady}; with changes before 30, 60 and 90: {changed}")
raise SystemExit(not (steady == [0] and changed == [0, 30]))
PYTHON
