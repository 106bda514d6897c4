"""Decoded pictures as ROS topics: of a real vehicle, through a real operator's side, with real rclpy and rospy."""

from __future__ import annotations

import json
import time
from math import radians, tan

import pytest
from ros_domain import MARKS

from rig import Operator, free_port, process, until
from runner.mqtt.broker import private_broker
from runner.settings import Endpoint

pytestmark = MARKS
NODE = "/tod_runner_operator"
IMAGE, INFO = f"{NODE}/camera/front/image", f"{NODE}/camera/front/camera_info"
SPOT, NATIVE = (204, 204), (1280, 960)  # centre of a white square of 8 px, in the native picture
EDGES = (
    f"{{left: {4 - SPOT[0]}, right: {SPOT[0] + 4 - NATIVE[0]}, top: {4 - SPOT[1]}, bottom: {SPOT[1] + 4 - NATIVE[1]}}}"
)
ELEMENTS = ", ".join(
    (
        "{name: source, element: videotestsrc, properties: {is-live: true, pattern: white}}",
        "{name: small, element: capsfilter, properties: "
        "{caps: 'video/x-raw,format=I420,width=8,height=8,framerate=10/1'}}",
        f"{{name: spot, element: videobox, properties: {EDGES}}}",
        "{name: raw, element: capsfilter, properties: {caps: '{raw_caps}'}}",
    )
)
WHOLE = {"x": 0, "y": 0, "width": 320, "height": 180, "screen_width": 160, "screen_height": 90}
FOCAL = {"pinhole": 640 / tan(radians(50)), "fisheye": 640 / radians(50)}  # of 100 degrees
WORDS = (
    *("vehicle=delivery_robot", "~cameras.rear", "~cameras.mast", "cameras.front.width_px=320"),
    *(
        "cameras.front.height_px=180",
        "cameras.front.fov_deg=100",
        "source=test",
        f"source.elements=[{ELEMENTS}]",
        "fps_max=10",
        "modes=open_loop",
    ),
    *("pqos=constant", "pqos.kbps=3000", "page.serve=false"),
)


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_a_point_is_where_camera_info_says(ros, lens):
    """After the crop of the native picture, and also with a region of interest and a factor."""
    broker = Endpoint("127.0.0.1", free_port())
    words = [*WORDS, f"cameras.front.lens={lens}", f"control.port={broker.port}", f"media.port={free_port()}"]
    asker = None
    with (
        private_broker(broker),
        process("vehicle", *words),
        process("operator", *words, "ros.pictures=true", *ros.words),
        ros.client("viewer", IMAGE, INFO) as viewer,
    ):
        until(lambda: close(viewer, lens), every_s=0.2)
        image = viewer.texts(IMAGE)[-1]
        assert (image["frame_id"], image["encoding"]) == ("front_optical_frame", "rgb8")
        assert 0 < time.time() - image["stamp"] < 20
        asker = Operator(broker)
        region = {"x": 104, "y": 34, "width": 160, "height": 90}
        for event in (
            {"event": "mode_selected", "mode": "single"},
            {"event": "camera_configured", "camera": "front", "kbps": 1000, "scaling": 0.5},
            {"event": "roi_set", "camera": "front", **region},
        ):
            assert asker.ask("x", **event)["result"] == "applied"
        until(lambda: close(viewer, lens) == (80, 46), every_s=0.2)
        asker.link.close()


def close(viewer, lens):
    """The size of the newest picture if its spot is within 1 px of where its camera_info says, otherwise None."""
    infos = {info["stamp"]: info for info in viewer.texts(INFO)}
    both = [(image, infos[image["stamp"]]) for image in viewer.texts(IMAGE) if image["stamp"] in infos]
    if not both or not both[-1][1]["k"][0]:
        return None
    image, info = both[-1]
    fx, cx, fy, cy = (info["k"][place] for place in (0, 2, 4, 5))
    assert info["model"] == {"pinhole": "plumb_bob", "fisheye": "equidistant"}[lens]
    assert (info["width"], info["height"]) == (image["width"], image["height"])
    # In units of the native focal length the spot is as far from the axis in both lenses' models.
    across, down = ((spot - side / 2) / FOCAL[lens] for spot, side in zip(SPOT, NATIVE, strict=True))
    found = image["spot"]
    if not found or max(abs(found[0] - fx * across - cx), abs(found[1] - fy * down - cy)) >= 1:
        return None
    return image["width"], image["height"]


def test_subscribers_state_what_they_show(ros, tmp_path):
    """It holds for 2 s; what is impossible counts as seen in full."""
    broker, seen = Endpoint("127.0.0.1", free_port()), f"{NODE}/camera/front/seen"
    words = [*WORDS, f"control.port={broker.port}", f"media.port={free_port()}"]

    def stated():
        lines = (json.loads(line) for line in (tmp_path / "log" / "drive.jsonl").read_text().splitlines())
        return [line["view"].get("front") for line in lines if line.get("event") == "view_reported"]

    with (
        private_broker(broker),
        process("vehicle", *words, f"log={tmp_path / 'log'}"),
        process("operator", *words, "ros.pictures=true", *ros.words) as operator,
        ros.client("viewer", IMAGE) as viewer,
    ):
        until(lambda: viewer.texts(IMAGE), every_s=0.2)

        def shows(*values):
            viewer.publish(seen, seen=values)
            return stated()[-1:]

        part = {"x": 32, "y": 18, "width": 160, "height": 90, "screen_width": 320, "screen_height": 180}
        until(lambda: shows(*part.values()) == [part], every_s=0.3)
        until(lambda: shows(0, 0, 0, 0, 160, 90) == [{**part, **WHOLE}], every_s=0.3)
        until(lambda: shows(0, 0, 0, 0, 0, 0) == [dict.fromkeys(part, 0)], every_s=0.3)
        until(lambda: shows(300, 0, 160, 90, 160, 90) == [None], every_s=0.3)
        until(lambda: shows(*part.values()) == [part], every_s=0.3)
        until(lambda: stated()[-1] is None, every_s=0.3)
        operator.terminate()
        assert "must lie inside the image of 320x180 px; it counts as seen in full" in operator.communicate()[0]
