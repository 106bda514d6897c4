#!/usr/bin/env bash
# rtph265pay config-interval=-1 ("send with every IDR frame") repeats no parameter sets in a stream of x265enc, whose later
# key pictures are CRA pictures, not IDR: of 4 key pictures only the first has VPS, SPS and PPS in front, so a viewer that
# joins later decodes nothing. x265enc marks all 4 as key pictures. With h265parse config-interval=-1 in front of the
# payloader all have them. (rtph265pay of GStreamer 1.28.8 repeats them in front of CRA pictures, too.)
# Seen with Debian 12: gstreamer1.0-plugins-good 1.22.0-5+deb12u4, gstreamer1.0-plugins-bad 1.22.0-4+deb12u8.
# Exits with 1 if the behaviour differs, with 2 if these versions are not to be had. Needs gst-launch-1.0, python3.
set -eu
. "$(dirname "$0")/pinned"
pinned gstreamer1.0-plugins-good=1.22.0-5+deb12u4 gstreamer1.0-plugins-bad=1.22.0-4+deb12u8
encode="videotestsrc num-buffers=95 ! video/x-raw,width=320,height=192,framerate=30/1
    ! x265enc key-int-max=30 tune=zerolatency"
packets="rtph265pay config-interval=-1 ! rtph265depay ! video/x-h265,stream-format=byte-stream,alignment=nal"
# shellcheck disable=SC2086  # words of a pipeline
gst-launch-1.0 -q $encode ! $packets ! filesink location="$place/without"
# shellcheck disable=SC2086
gst-launch-1.0 -q $encode ! h265parse config-interval=-1 ! $packets ! filesink location="$place/with"
python3 - "$place/without" "$place/with" <<'PYTHON'
import re
import sys

VPS, IRAP = 32, range(16, 24)  # ITU-T H.265, table 7-1


def counted(path: str) -> tuple[int, int]:
    """Key pictures in a byte stream, and those right behind parameter sets."""
    kinds = [unit[0] >> 1 & 63 for unit in re.split(b"\0\0\0?\x01", open(path, "rb").read())[1:] if unit]
    keys = told = 0
    fresh = False
    for kind in kinds:
        if kind in IRAP:
            keys, told, fresh = keys + 1, told + fresh, False
        elif kind == VPS:
            fresh = True
        elif kind < 16:
            fresh = False
    return keys, told


found = [counted(path) for path in sys.argv[1:]]
for what, (keys, told) in zip(("rtph265pay alone", "h265parse in front"), found):
    print(f"{what}: {told} of {keys} key pictures have parameter sets")
sys.exit(found != [(4, 1), (4, 4)])
PYTHON
