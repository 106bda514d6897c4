#!/usr/bin/env bash
# x265enc's bitrate is changeable while playing, but each new value ends the encoder and opens another: a key picture,
# and a rate control without memory. If the bitrate alternates between 200 and 204 kbit/s before every fifth picture, it
# sends 261 kbit/s of a moving test picture; with one bitrate of 200 it sends 200.
# Seen with Debian 12: gstreamer1.0-plugins-bad 1.22.0-4+deb12u8, libx265-199 3.5-2+b1.
# Exits with 1 if the behaviour differs, with 2 if these versions are not to be had. Needs python3-gi.
set -eu
. "$(dirname "$0")/pinned"
pinned gstreamer1.0-plugins-bad=1.22.0-4+deb12u8 libx265-199=3.5-2+b1

/usr/bin/python3 - <<'PYTHON'
import gi

gi.require_version("Gst", "1.0")
from gi.repository import Gst

Gst.init(None)
PICTURES, FPS, SETTLED = 150, 25, 25


def sent(changes):
    """Mean kbit/s after the first second, and the numbers of the key pictures."""
    pipeline = Gst.parse_launch(
        f"videotestsrc num-buffers={PICTURES} pattern=zone-plate kx2=4 ky2=4 kt=2"
        f" ! video/x-raw,format=I420,width=640,height=352,framerate={FPS}/1"
        " ! x265enc name=e tune=zerolatency speed-preset=ultrafast key-int-max=1000 bitrate=200"
        " ! fakesink name=s signal-handoffs=true"
    )
    encoder, sizes, keys, count = pipeline.get_by_name("e"), [], [], [0]

    def on_raw(pad, info):
        if changes and count[0] and count[0] % 5 == 0:
            encoder.set_property("bitrate", 204 if count[0] % 10 else 200)
        count[0] += 1
        return Gst.PadProbeReturn.OK

    def on_coded(sink, buffer, pad):
        if not buffer.has_flags(Gst.BufferFlags.DELTA_UNIT):
            keys.append(len(sizes))
        sizes.append(buffer.get_size())

    encoder.get_static_pad("sink").add_probe(Gst.PadProbeType.BUFFER, on_raw)
    pipeline.get_by_name("s").connect("handoff", on_coded)
    pipeline.set_state(Gst.State.PLAYING)
    pipeline.get_bus().timed_pop_filtered(60 * Gst.SECOND, Gst.MessageType.EOS | Gst.MessageType.ERROR)
    pipeline.set_state(Gst.State.NULL)
    return 8 * sum(sizes[SETTLED:]) / 1000 * FPS / (len(sizes) - SETTLED), keys


(steady, one), (changing, many) = sent(False), sent(True)
print(f"one bitrate: {steady:.0f} kbit/s, key pictures {one}; 200 and 204 in turn: {changing:.0f} kbit/s, {many}")
raise SystemExit(not (one == [0] and many == list(range(0, PICTURES, 5)) and steady < 210 and changing > 1.2 * 204))
PYTHON
