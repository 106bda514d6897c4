"""A bare GStreamer RTSP server and client: processes that load no code of the project, run by bench/cost.py.

python bench/bare.py serve PORT    launch lines by camera from the first line of standard input, as JSON. Each further
                                   line sets properties: [camera, element, property, value as gst-launch writes it]
python bench/bare.py watch URL...  receives every stream and decodes none; a line of JSON for each frame on standard
                                   output: [stream, time of arrival, ms since its capture or null, width of the picture]
"""

from __future__ import annotations

import json
import re
import sys
import threading
import time
from typing import Any

import gi

gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer  # noqa: E402

NTP_EPOCH_S = 2_208_988_800  # from 1900 to 1970, RFC 5905
JITTER_BUFFER_MS = 40


def serve(port: str) -> None:
    lines = json.loads(sys.stdin.readline())
    server = GstRtspServer.RTSPServer(service=port, address="127.0.0.1")
    elements: dict[str, Any] = {}
    for camera, line in lines.items():
        factory = GstRtspServer.RTSPMediaFactory()
        factory.set_launch(line)
        factory.set_shared(True)
        factory.set_latency(0)
        factory.connect("media-configure", lambda _f, media, name: elements.update({name: media.get_element()}), camera)
        server.get_mount_points().add_factory(f"/{camera}", factory)
    server.attach()

    def set_properties() -> None:
        for line in sys.stdin:
            camera, element, key, value = json.loads(line)
            Gst.util_set_object_arg(elements[camera].get_by_name(element), key, value)

    threading.Thread(target=set_properties, daemon=True).start()
    GLib.MainLoop().run()


def watch(*urls: str) -> None:
    pipelines = [_receiver(number, url) for number, url in enumerate(urls)]
    for pipeline in pipelines:
        pipeline.set_state(Gst.State.PLAYING)
    GLib.MainLoop().run()


def _receiver(number: int, url: str) -> Gst.Pipeline:
    pipeline = Gst.parse_launch(
        f'rtspsrc location="{url}" latency={JITTER_BUFFER_MS} add-reference-timestamp-meta=true '
        "! rtph264depay ! h264parse name=parser ! video/x-h264,alignment=au ! fakesink sync=false"
    )
    pad = pipeline.get_by_name("parser").get_static_pad("src")
    pad.add_probe(Gst.PadProbeType.BUFFER, _on_frame, number)
    return pipeline


def _on_frame(pad: Gst.Pad, info: Gst.PadProbeInfo, number: int) -> Gst.PadProbeReturn:
    now, meta = time.time(), info.get_buffer().get_reference_timestamp_meta(None)
    age_ms = 1000 * (now - meta.timestamp / Gst.SECOND + NTP_EPOCH_S) if meta else None
    width = re.search(r"width=\(int\)(\d+)", pad.get_current_caps().to_string())
    sys.stdout.write(json.dumps([number, now, age_ms, int(width[1]) if width else 0]) + "\n")
    sys.stdout.flush()
    return Gst.PadProbeReturn.OK


if __name__ == "__main__":
    Gst.init(None)
    {"serve": serve, "watch": watch}[sys.argv[1]](*sys.argv[2:])
