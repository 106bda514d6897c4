#!/usr/bin/env bash
# videoconvert of GStreamer 1.22.0 (Debian 12: gstreamer1.0-plugins-base 1.22.0-3+deb12u7) converts
# full to limited range only together with the matrix. Input and output of the same matrix, or an input whose stream
# states the range without a matrix (1:0:0:0, as H.264 and H.265 may): luma stays 0 to 255, although the caps behind say
# bt709, limited range. No warning. Through RGB the result is right (110 ms of processor time for a picture of 1920x1080).
# Exits 0 while that is so.
set -euo pipefail
. "$(dirname "$0")/pinned"
pinned gstreamer1.0-plugins-base=1.22.0-3+deb12u7 gstreamer1.0-tools=1.22.0-2+deb12u1 gstreamer1.0-plugins-bad=1.22.0-4+deb12u8

head -c $((64 * 64)) /dev/zero >"$place/in"          # a black picture in full range: luma 0 ...
head -c $((64 * 32)) /dev/zero | tr '\0' '\200' >>"$place/in"   # ... and chroma 128

luma() { # of the first pixel, for an input colorimetry and elements before the last videoconvert
  gst-launch-1.0 -q filesrc location="$place/in" blocksize=6144 ! rawvideoparse format=i420 width=64 height=64 \
    ! capssetter caps="video/x-raw,colorimetry=(string)$1" $2 ! videoconvert \
    ! video/x-raw,format=I420,colorimetry=bt709 ! filesink location="$place/out"
  od -An -tu1 -N1 "$place/out" | tr -d ' '
}

echo "BT.709 full to limited:              luma $(luma 1:3:5:1 ''), right is 16"
echo "range only stated, to limited:       luma $(luma 1:0:0:0 ''), right is 16"
echo "BT.601 full to BT.709 limited:       luma $(luma 1:4:0:0 ''), right is 16"
echo "BT.709 full to limited, through RGB: luma $(luma 1:3:5:1 '! videoconvert ! video/x-raw,format=RGBx'), right is 16"
[ "$(luma 1:3:5:1 '')" = 0 ] && [ "$(luma 1:0:0:0 '')" = 0 ] && [ "$(luma 1:4:0:0 '')" != 0 ]
