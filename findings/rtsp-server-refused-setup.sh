#!/usr/bin/env bash
# gst-rtsp-server opens a camera once for each transport that it refuses.
#
# If no UDP port is free, SETUP over UDP is answered 461, and with it the library ends the media that DESCRIBE has
# prepared, unless another client uses it. rtspsrc then tries multicast and TCP on the same connection: for each of them
# a new media is constructed. One viewer thus opens a camera three times, and a source that takes long to start, or may
# be opened once only, fails although TCP would have worked.
#
# Debian 12: libgstrtspserver-1.0-0 and gir1.2-gst-rtsp-server-1.0 1.22.0-2, gstreamer1.0-plugins-good 1.22.0-5+deb12u4,
# python3-gi 3.42.2-3+b1.
# Output seen: "3 pipelines for one viewer". Ends with another status than 0 if that changes.
set -eu
. "$(dirname "$0")/pinned"
pinned libgstrtspserver-1.0-0=1.22.0-2 gir1.2-gst-rtsp-server-1.0=1.22.0-2 gstreamer1.0-plugins-good=1.22.0-5+deb12u4
seen=$(timeout 60 /usr/bin/python3 - <<'PYTHON'
import socket, threading, time
import gi
gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer

Gst.init(None)
taken = socket.socket(type=socket.SOCK_DGRAM)
taken.bind(("127.0.0.1", 0))
first = taken.getsockname()[1] // 2 * 2
server, factory, built, pictures = GstRtspServer.RTSPServer(), GstRtspServer.RTSPMediaFactory(), [], []
pool = GstRtspServer.RTSPAddressPool()
pool.add_range("127.0.0.1", "127.0.0.1", first, first + 1, 0)
factory.set_address_pool(pool)
factory.set_launch("( videotestsrc is-live=true ! video/x-raw,width=64,height=48 ! x264enc tune=zerolatency ! rtph264pay name=pay0 )")
factory.set_shared(True)
factory.connect("media-configure", lambda _factory, media: built.append(media))
server.set_service("0")
server.get_mount_points().add_factory("/a", factory)
server.attach(None)
threading.Thread(target=GLib.MainLoop().run, daemon=True).start()
line = f"rtspsrc location=rtsp://127.0.0.1:{server.get_bound_port()}/a ! fakesink name=sink signal-handoffs=true"
viewer = Gst.parse_launch(line)
viewer.get_by_name("sink").connect("handoff", lambda *_: pictures.append(1))
viewer.set_state(Gst.State.PLAYING)
end = time.monotonic() + 20
while not pictures and time.monotonic() < end:
    time.sleep(0.1)
print(f"{len(built)} pipelines for one viewer" if pictures else "no picture", flush=True)
viewer.set_state(Gst.State.NULL)
PYTHON
)
echo "$seen"
test "$seen" = "3 pipelines for one viewer"
