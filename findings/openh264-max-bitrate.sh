#!/usr/bin/env bash
# openh264enc's max-bitrate ("Maximum Bitrate (in bits per second)") limits nothing: noise goes out at 3.8 times that
# rate in rate control mode `bitrate`, as without it. Only enable-frame-skip=true holds it, by leaving out pictures.
# Seen with Debian 12: gstreamer1.0-plugins-bad 1.22.0-4+deb12u8, libopenh264-7 2.3.1+dfsg-3+deb12u2,
# gstreamer1.0-tools 1.22.0-2+deb12u1: 15130 kbit/s at 4000 set, 15130 with max-bitrate, 4728 with frame skipping.
# Exits with 1 if the behaviour differs, with 2 if these versions are not to be had.
set -eu
. "$(dirname "$0")/pinned"
pinned gstreamer1.0-plugins-bad=1.22.0-4+deb12u8 libopenh264-7=2.3.1+dfsg-3+deb12u2 gstreamer1.0-tools=1.22.0-2+deb12u1

kbps() {  # PROPERTY...: mean bitrate of 3 s of noise, 640x360 at 30 Hz, with 4 Mbit/s set
    gst-launch-1.0 -q videotestsrc num-buffers=90 pattern=snow \
        ! video/x-raw,format=I420,width=640,height=360,framerate=30/1 \
        ! openh264enc rate-control=bitrate complexity=low bitrate=4000000 "$@" ! filesink location="$place/out.h264" \
        >/dev/null 2>&1
    echo $(($(stat -c %s "$place/out.h264") * 8 / 3000))
}

plain=$(kbps)
limited=$(kbps max-bitrate=4000000)
skipping=$(kbps max-bitrate=4000000 enable-frame-skip=true)
echo "4000 kbit/s set: $plain; with max-bitrate=4000000: $limited; and enable-frame-skip=true: $skipping"
[ "$limited" -gt 6000 ] && [ "$skipping" -lt 6000 ]
