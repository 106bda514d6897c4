"""An IP camera in its own process whose elements are set over HTTP while it streams, as with a real one's settings."""

from __future__ import annotations

import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from rig import CHECKOUT, free_port


class ToldCamera:
    """rtsp and http: its addresses. GET of http/ELEMENT/PROPERTY/VALUE sets a property."""

    def __init__(self, rtsp: int, http: int) -> None:
        self.rtsp, self.http = f"rtsp://127.0.0.1:{rtsp}/stream", f"http://127.0.0.1:{http}"

    def tell(self, element: str, key: str, value: str) -> None:
        self._get(f"{element}/{key}/{value}")

    @property
    def key_pictures_asked(self) -> int:
        """How often a key picture was requested of its encoder."""
        return int(self._get("asked"))

    def _get(self, path: str) -> str:
        with urllib.request.urlopen(f"{self.http}/{urllib.request.quote(path)}", timeout=10) as answer:
            return str(answer.read().decode())


@contextmanager
def told_camera(media: str, *, feedback: bool = False) -> Iterator[ToldCamera]:
    """An IP camera.

    media     its pipeline; what is told of is named, the encoder is named encoder
    feedback  whether it takes requests for key pictures (RTP profile AVPF)
    """
    camera = ToldCamera(free_port(), free_port())
    ports = [camera.rtsp.split(":")[2].partition("/")[0], camera.http.rpartition(":")[2]]
    command = [sys.executable, __file__, *ports, media, "feedback" if feedback else ""]
    environment = {"PYTHONPATH": f"{CHECKOUT}:{CHECKOUT / 'tests' / 'integration'}", "PATH": "/usr/bin:/bin"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment, cwd=CHECKOUT) as child:
        try:
            assert child.stdout is not None
            assert child.stdout.readline() == "serves\n"
            yield camera
        finally:
            child.kill()


def main() -> None:
    """Serve until killed."""
    from runner.gst import GLib, Gst  # isort: skip (names the versions)
    from gi.repository import GstRtsp, GstRtspServer

    rtsp, http, media, feedback = sys.argv[1:]
    server, factory = GstRtspServer.RTSPServer(), GstRtspServer.RTSPMediaFactory()
    server.set_address("127.0.0.1")
    server.set_service(rtsp)
    factory.set_launch(f"( {media} )")
    factory.set_shared(True)
    if feedback:
        factory.set_profiles(GstRtsp.RTSPProfile.AVPF)
    elements: dict[str, Gst.Element] = {}
    asked = [0]

    def on_event(_pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        structure = info.get_event().get_structure()
        asked[0] += bool(structure and structure.get_name() == "GstForceKeyUnit")
        return Gst.PadProbeReturn.OK

    def on_media(_factory: GstRtspServer.RTSPMediaFactory, made: GstRtspServer.RTSPMedia) -> None:
        elements.clear()
        elements.update({element.get_name(): element for element in made.get_element().iterate_recurse()})
        elements["encoder"].get_static_pad("src").add_probe(Gst.PadProbeType.EVENT_UPSTREAM, on_event)

    class Settings(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            text, status = str(asked[0]), 200
            if self.path != "/asked":
                name, key, value = urllib.request.unquote(self.path)[1:].split("/", 2)
                text, status = ("set", 200) if name in elements else ("no such element", 404)
                if status == 200:
                    Gst.util_set_object_arg(elements[name], key, value)
            self.send_response(status)
            self.send_header("Content-Length", str(len(text)))
            self.end_headers()
            self.wfile.write(text.encode())

        def log_message(self, *_: object) -> None:
            pass

    factory.connect("media-configure", on_media)
    server.get_mount_points().add_factory("/stream", factory)
    server.attach(None)
    settings = ThreadingHTTPServer(("127.0.0.1", int(http)), Settings)
    threading.Thread(target=settings.serve_forever, daemon=True).start()
    print("serves", flush=True)
    GLib.MainLoop().run()


if __name__ == "__main__":
    main()
