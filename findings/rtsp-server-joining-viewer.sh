#!/usr/bin/env bash
# A viewer that joins a shared gst-rtsp-server media over UDP makes the encoder negotiate again.
#
# For a viewer of a kind that the media does not serve yet (here UDP, beside one over TCP) the server links another sink
# behind the payloader while the media plays. That sends RECONFIGURE upstream, through payloader and encoder up to the
# source. All elements then negotiate again although nothing about the stream has changed, while the new branch may not
# be linked yet. A server that wants its running viewers undisturbed drops the event at the payloader's source pad.
#
# Debian 12: libgstrtspserver-1.0-0 and gir1.2-gst-rtsp-server-1.0 1.22.0-2, gstreamer1.0-plugins-good 1.22.0-5+deb12u4,
# python3-gi 3.42.2-3+b1.
# Output seen: "before 0, after 1 or more". Ends with another status than 0 if that changes.
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
server, factory, asked = GstRtspServer.RTSPServer(), GstRtspServer.RTSPMediaFactory(), []
factory.set_launch(
    "( videotestsrc is-live=true ! video/x-raw,width=64,height=48 ! x264enc name=encoder tune=zerolatency"
    " ! rtph264pay name=pay0 )"
)
factory.set_shared(True)

def on_event(_pad, info):
    if info.get_event().type == Gst.EventType.RECONFIGURE:
        asked.append(time.monotonic())
    return Gst.PadProbeReturn.OK

def configure(_factory, media):
    encoder = media.get_element().get_by_name("encoder")
    encoder.get_static_pad("src").add_probe(Gst.PadProbeType.EVENT_UPSTREAM, on_event)

factory.connect("media-configure", configure)
server.set_service("0")
server.get_mount_points().add_factory("/a", factory)
server.attach(None)
threading.Thread(target=GLib.MainLoop().run, daemon=True).start()
base = f"rtsp://127.0.0.1:{server.get_bound_port()}/a"

def play(transport):
    tcp = socket.create_connection(("127.0.0.1", server.get_bound_port()), 10)
    reading = tcp.makefile("rb")

    def ask(number, method, url, *headers):
        tcp.sendall("\r\n".join([f"{method} {url} RTSP/1.0", f"CSeq: {number}", *headers, "", ""]).encode())
        lines = []
        while (line := reading.readline().decode().strip()) or not lines:
            lines.append(line)
        length = next((int(l.split(":")[1]) for l in lines if l.lower().startswith("content-length")), 0)
        reading.read(length)
        return lines

    ask(1, "DESCRIBE", base)
    answer = ask(2, "SETUP", f"{base}/stream=0", f"Transport: RTP/{transport}")
    session = next(line for line in answer if line.startswith("Session: ")).partition(";")[0]
    ask(3, "PLAY", f"{base}/", session)
    return tcp

first = play("AVP/TCP;unicast;interleaved=0-1")
time.sleep(2)
before = len(asked)
asked.clear()
time.sleep(2)
quiet = len(asked)
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as rtp:
    rtp.bind(("127.0.0.1", 0))
    port = rtp.getsockname()[1] & ~1
    second = play(f"AVP;unicast;client_port={port}-{port + 1}")
    time.sleep(2)
print(f"before {quiet}, after {'1 or more' if asked else 0}")
PYTHON
)
echo "$seen"
test "$seen" = "before 0, after 1 or more"
