#!/usr/bin/env bash
# gst-rtsp-server sets the rate control of a media back with each PLAY.
#
# `gst_rtsp_media_set_rate_control(media, FALSE)` in the factory's signal `media-configure` holds until a client sends
# PLAY: a request without the header Rate-Control sets it to TRUE again, so the sink of interleaved packets gets
# sync=true. A server that wants packets to leave at once must set it after each PLAY, or watch the sink's property.
#
# Debian 12: libgstrtspserver-1.0-0 and gir1.2-gst-rtsp-server-1.0 1.22.0-2, gstreamer1.0-plugins-good 1.22.0-5+deb12u4,
# python3-gi 3.42.2-3+b1.
# Output seen: "configured False, set up False, played True". Ends with another status than 0 if that changes.
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
server, factory, found, medias = GstRtspServer.RTSPServer(), GstRtspServer.RTSPMediaFactory(), [], []
factory.set_launch("( videotestsrc is-live=true ! video/x-raw,width=64,height=48 ! x264enc tune=zerolatency ! rtph264pay name=pay0 )")
factory.set_shared(True)

def configure(_factory, media):
    media.set_rate_control(False)
    medias.append(media)
    found.append(f"configured {media.get_rate_control()}")

factory.connect("media-configure", configure)
server.connect("client-connected", lambda _server, client: [
    client.connect("setup-request", lambda *_: found.append(f"set up {medias[0].get_rate_control()}")),
    client.connect("play-request", lambda *_: found.append(f"played {medias[0].get_rate_control()}")),
])
server.set_service("0")
server.get_mount_points().add_factory("/a", factory)
server.attach(None)
threading.Thread(target=GLib.MainLoop().run, daemon=True).start()
base = f"rtsp://127.0.0.1:{server.get_bound_port()}/a"
tcp = socket.create_connection(("127.0.0.1", server.get_bound_port()), 10)

def ask(number, method, url, *headers):
    tcp.sendall("\r\n".join([f"{method} {url} RTSP/1.0", f"CSeq: {number}", *headers, "", ""]).encode())
    return tcp.recv(65536).decode(errors="replace")

ask(1, "DESCRIBE", base)
answer = ask(2, "SETUP", f"{base}/stream=0", "Transport: RTP/AVP/TCP;unicast;interleaved=0-1")
session = next(line for line in answer.splitlines() if line.startswith("Session: ")).partition(";")[0]
ask(3, "PLAY", f"{base}/", session)
while len(found) < 3:
    time.sleep(0.01)
print(", ".join(found))
PYTHON
)
echo "$seen"
test "$seen" = "configured False, set up False, played True"
