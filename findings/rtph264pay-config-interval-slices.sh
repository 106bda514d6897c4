#!/usr/bin/env bash
# rtph264pay config-interval=-1 ("send with every IDR frame") sends SPS and PPS before every slice of an IDR picture, so
# also between its slices. rtph264depay that puts out whole access units as a byte stream begins a new one there: each key
# picture of two slices leaves it as two, with the same time, and a decoder that takes one picture at a time shows its
# upper part empty. As avc the depayloader keeps it whole, since it takes the parameter sets out. x264enc
# tune=zerolatency cuts pictures into as many slices as it has threads, so many cameras made with GStreamer send this.
# With h264parse config-interval=-1 in front of the payloader instead, all pictures leave whole.
# Seen with Debian 12: gstreamer1.0-plugins-good 1.22.0-5+deb12u4, gstreamer1.0-plugins-bad 1.22.0-4+deb12u8.
# Exits with 1 if the behaviour differs, with 2 if these versions are not to be had. Needs gst-launch-1.0.
set -eu
. "$(dirname "$0")/pinned"
pinned gstreamer1.0-plugins-good=1.22.0-5+deb12u4 gstreamer1.0-plugins-bad=1.22.0-4+deb12u8
encode="videotestsrc num-buffers=30 ! video/x-raw,width=320,height=192,framerate=30/1
    ! x264enc tune=zerolatency threads=2 sliced-threads=true key-int-max=10"
count() { # PAYLOADER FORM: buffers that leave the depayloader
    mkdir -p "$place/$2$3"
    # shellcheck disable=SC2086  # words of a pipeline
    gst-launch-1.0 -q $encode ! $1 ! rtph264depay ! "video/x-h264,stream-format=$2,alignment=au" \
        ! multifilesink location="$place/$2$3/%02d"
    find "$place/$2$3" -type f | wc -l
}
bytes=$(count "rtph264pay config-interval=-1" byte-stream 1)
avc=$(count "rtph264pay config-interval=-1" avc 1)
parsed=$(count "h264parse config-interval=-1 ! rtph264pay" byte-stream 2)
echo "of 30 pictures, 3 of them key pictures: $bytes as a byte stream, $avc as avc, $parsed with h264parse"
[ "$bytes $avc $parsed" = "33 30 30" ]
