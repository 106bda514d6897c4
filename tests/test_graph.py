"""Graphs compile to plain text, compared in full; knobs turn into assignments; text survives a shell."""

from __future__ import annotations

import shlex
from dataclasses import replace
from fractions import Fraction
from typing import Any

import pytest
from helpers import CONF, setup, source_for, vehicle

from runner.core.commands import KnobValue
from runner.core.graph_settings import GraphSettings, KnobTarget
from runner.core.model import Camera, Element, Graph, ModelError, Roi, Source
from runner.graph import Plan, compile_graph, launch, rtsp_url, shell
from runner.plans import compile_plans
from runner.settings import Lossless, Media
from runner.turning import assignments, text

MEDIA = Media("127.0.0.1", 8554, rtp_ports=(20000, 20999), session_timeout_s=10, max_viewers=1)
LEFT = vehicle("modes=paper").cameras["front_left"]
ROBOT = vehicle("vehicle=delivery_robot").cameras["front"]  # its full image is cut out of a native one
GRAPHS = sorted(path.stem for path in (CONF / "graph").glob("*.yaml"))

SOURCE = (
    "videotestsrc name=source is-live=true pattern=smpte ! capsfilter name=raw "
    "caps=video/x-raw,format=I420,width=1920,height=1040,framerate=40/1,pixel-aspect-ratio=1/1,colorimetry=bt709"
)
ENCODER = (
    "x264enc name=encoder tune=zerolatency speed-preset=superfast option-string=repeat-headers=0 intra-refresh=true "
    "key-int-max=60 pass=qual quantizer=10 vbv-buf-capacity=38 threads=1 aud=false"
)
SENT = "capsfilter name=form caps=video/x-h264,stream-format=avc ! identity name=sent"
PAY = f"{SENT} ! rtph264pay name=pay0 pt=96 mtu=1200 config-interval=-1 aggregate-mode=zero-latency"
DECODE = (
    "rtph264depay name=depay ! capsfilter name=units caps=video/x-h264,stream-format=byte-stream,alignment=au "
    "! identity name=received ! capssetter name=colors caps=video/x-h264,colorimetry=bt709 "
    "! avdec_h264 name=decoder max-threads=1 ! "
    "fakesink name=sink sync=false async=false enable-last-sample=false"
)
KNOBS: dict[str, KnobValue] = {"sending": True, "roi": Roi(0, 0, 1920, 1040), "size": (480, 260), "bitrate": 545}


def plan(camera: Camera = LEFT, index: int = 0, clip: str | None = None, **changes: Any) -> Plan:
    return compile_graph(replace(camera, **changes), MEDIA, index, clip)


# --- golden plans -----------------------------------------------------------------------------------------------------


def test_the_server_of_front_left() -> None:
    assert plan().server == (
        f"( {SOURCE} ! valve name=gate drop-mode=forward-sticky-events ! videocrop name=crop ! "
        f"videoscale name=scaler add-borders=false ! capsfilter name=size ! {ENCODER} ! {PAY} )"
    )


def test_the_receiver_of_front_left() -> None:
    assert plan().receiver == (
        "rtspsrc name=client location=rtsp://127.0.0.1:8554/front_left/feedback latency=40 tcp-timeout=1000000 "
        f"timeout=0 do-retransmission=true add-reference-timestamp-meta=true ! {DECODE}"
    )


def test_a_file_follows_a_tee_on_both_sides_and_is_never_printed() -> None:
    bare, kept = plan(), replace(plan(), video=True)
    branch = (
        " video-tee. ! valve name=video-gate ! queue name=video-queue leaky=downstream max-size-bytes=8000000 "
        "max-size-buffers=0 max-size-time=0 ! h264parse name=video-parser config-interval=-1 ! "
        "mpegtsmux name=video-muxer ! filesink name=video-file sync=false async=false enable-last-sample=false "
        "buffer-mode=unbuffered"
    )
    tee = " ! tee name=video-tee"
    for side, counter in (("pipeline", "identity name=sent"), ("receiver", "identity name=received")):
        assert getattr(kept, side) == getattr(bare, side).replace(counter, counter + tee) + branch
    assert kept.receiver_into("fakesink").endswith(f" ! fakesink{branch}")
    assert bare.receiver_into("fakesink") == bare.receiver.partition(" name=sink")[0]
    assert kept.vehicle_line(KNOBS) == bare.vehicle_line(KNOBS)
    assert kept.operator_line() == bare.operator_line()


def test_the_printed_lines_of_front_left() -> None:
    assert plan().vehicle_line(KNOBS) == (
        f"{SOURCE} ! valve name=gate drop-mode=forward-sticky-events drop=false ! "
        "videocrop name=crop left=0 right=0 top=0 bottom=0 ! videoscale name=scaler add-borders=false ! "
        "capsfilter name=size caps=video/x-raw,width=480,height=260,pixel-aspect-ratio=1/1 ! "
        f"{ENCODER} bitrate=545 ! {PAY} ! udpsink name=wire host=127.0.0.1 port=5600 sync=false async=false"
    )
    assert plan().operator_line() == (
        "udpsrc name=wire address=127.0.0.1 port=5600 "
        "caps=application/x-rtp,media=video,clock-rate=90000,encoding-name=H264,payload=96 ! "
        f"rtpjitterbuffer name=jitterbuffer latency=40 ! {DECODE}"
    )


def test_the_recording_of_front_left() -> None:
    recording = setup("modes=paper").recording
    assert compile_graph(LEFT, MEDIA, recording=recording).recording("/tmp/my rec/.front_left.mkv.part") == (
        f"{SOURCE} ! queue name=waiting leaky=upstream max-size-bytes=128000000 max-size-buffers=0 max-size-time=0 ! "
        "identity name=recorded single-segment=true ! "
        "x264enc name=encoder pass=quant quantizer=0 speed-preset=ultrafast key-int-max=30 ! "
        'matroskamux name=mux timecodescale=1000 ! filesink name=writer location="/tmp/my rec/.front_left.mkv.part"'
    )


@pytest.mark.parametrize("name", GRAPHS)
def test_every_graph_ends_in_a_sink_and_begins_with_the_source_for_it(name: str) -> None:
    camera = vehicle(f"graph={name}", f"source={source_for(name)}").cameras["front_right"]
    compiled = plan(camera, index=2)
    port = str(camera.graph.settings.first_port + 2)
    sink, source = compiled.vehicle_line(KNOBS).split(" ! ")[-1], compiled.operator_line().split(" ! ")[0]
    assert (sink.split()[0], source.split()[0]) in {("udpsink", "udpsrc"), ("srtsink", "srtsrc")}
    assert port in sink and port in source
    assert compiled.serves == (compiled.server is not None) == (camera.graph.transport == "rtsp")
    assert "{" not in compiled.pipeline + compiled.receiver


# --- knobs ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "camera, knob, value, expected",
    [
        (LEFT, "sending", False, {"gate.drop": True}),
        (LEFT, "sending", True, {"gate.drop": False}),
        (LEFT, "bitrate", 545, {"encoder.bitrate": 545, "encoder.vbv-buf-capacity": 38}),
        (LEFT, "bitrate", 27, {"encoder.bitrate": 27, "encoder.vbv-buf-capacity": 38}),
        (LEFT, "bitrate", 26, {"encoder.bitrate": 26, "encoder.vbv-buf-capacity": 39}),  # 1 kbit, not 0.988
        (LEFT, "bitrate", 1, {"encoder.bitrate": 1, "encoder.vbv-buf-capacity": 1000}),
        (LEFT, "size", (480, 260), {"size.caps": "video/x-raw,width=480,height=260,pixel-aspect-ratio=1/1"}),
        (
            LEFT,
            "roi",
            Roi(100, 40, 960, 520),
            {"crop.left": 100, "crop.right": 860, "crop.top": 40, "crop.bottom": 480},
        ),
        (
            ROBOT,
            "roi",
            Roi(0, 0, 1280, 720),
            {"crop.left": 0, "crop.right": 0, "crop.top": 120, "crop.bottom": 120},
        ),
        (
            ROBOT,
            "roi",
            Roi(10, 20, 100, 50),
            {"crop.left": 10, "crop.right": 1170, "crop.top": 140, "crop.bottom": 770},
        ),
    ],
)
def test_a_knob_turns_properties(camera: Camera, knob: str, value: KnobValue, expected: dict[str, Any]) -> None:
    assert {f"{element}.{key}": v for element, key, v in assignments(camera, knob, value)} == expected


def test_encoders_that_count_in_bits() -> None:
    camera = vehicle("graph=openh264_rtsp").cameras["front_left"]
    assert assignments(camera, "bitrate", 545) == [("encoder", "bitrate", 545_000)]


# --- placeholders -----------------------------------------------------------------------------------------------------


def graph(**properties: Any) -> Graph:
    element = Element("pay0", "rtph264pay", properties)
    return Graph("rtsp", (element,), (Element("sink", "fakesink", {}),), (), (), {}, GraphSettings(5600), {"mtu": 1200})


def test_a_whole_placeholder_keeps_its_type_and_a_part_becomes_text() -> None:
    filled = plan(graph=graph(mtu="{mtu}", location="{camera}-{port}")).vehicle[0].properties
    assert filled == {"mtu": 1200, "location": "front_left-5600"}


def test_nothing_fills_an_unknown_placeholder() -> None:
    with pytest.raises(ModelError) as refused:
        plan(graph=graph(mtu="{mtuu}"))
    rule = "unknown placeholder {mtuu}, did you mean mtu?"
    assert str(refused.value) == f"graph.vehicle[0].properties.mtu: '{{mtuu}}': {rule}"


def test_a_source_may_not_use_the_name_of_an_element_of_the_graph() -> None:
    with pytest.raises(ModelError) as refused:
        plan(source=Source((Element("gate", "videotestsrc", {}),)))
    assert str(refused.value) == "source.elements[0].name: 'gate': is already the name of another element"


def test_settings_that_depend_on_the_frame_rate() -> None:
    own = graph(interval="{key_interval_frames}", vbv="{vbv_ms}")
    settings = GraphSettings(5600, key_interval_s=1.5, vbv_frames=2.1)
    slow = plan(fps=Fraction(30000, 1001), graph=replace(own, settings=settings))
    assert slow.vehicle[0].properties == {"interval": 45, "vbv": 70}
    assert "framerate=30000/1001" in slow.pipeline


# --- sources ----------------------------------------------------------------------------------------------------------

CLIP = Source(
    elements=(Element("file", "filesrc", {"location": "{clip}"}),),
    loop=True,
    render="town",
    render_s=12,
    stand_in=(Element("source", "videotestsrc", {}),),
)


def test_a_clip_that_is_not_rendered_yet_has_a_stand_in() -> None:
    missing, rendered = plan(source=CLIP), plan(source=CLIP, clip="/cache/a.mkv")
    assert [element.factory for element in missing.printed] == ["videotestsrc"]
    assert (missing.stands_in, missing.loops) == (True, False)
    assert rendered.printed[0].properties == {"location": "/cache/a.mkv"}
    assert (rendered.stands_in, rendered.loops) == (False, True)


def test_frames_generated_in_python_are_printed_as_a_test_picture() -> None:
    camera = vehicle("source=appsrc").cameras["front_left"]
    compiled = plan(camera)
    assert compiled.stands_in
    assert compiled.vehicle_line(KNOBS).startswith("videotestsrc ")
    assert (compiled.server or "").startswith("( appsrc ")


# --- text -------------------------------------------------------------------------------------------------------------

AWKWARD = '/tmp/it\'s a "clip" with $HOME, `x`, a \\ and ü.mp4'


def test_pads_that_are_named() -> None:
    session = Element("session", "rtpsession", {"rtp-profile": "avpf"}, sink="send_rtp_sink", src="send_rtp_src")
    line = launch([Element("pay0", "rtph264pay", {}), session, Element("sink", "fakesink", {})])
    assert line == (
        "rtph264pay name=pay0 ! session.send_rtp_sink "
        "rtpsession name=session rtp-profile=avpf session.send_rtp_src ! fakesink name=sink"
    )


def test_quoting_for_a_shell() -> None:
    line = shell([Element("file", "filesrc", {"location": AWKWARD}), Element("sink", "fakesink", {"sync": False})])
    assert shlex.split(line) == [
        "filesrc",
        "name=file",
        f"location={AWKWARD}",
        "!",
        "fakesink",
        "name=sink",
        "sync=false",
    ]


def test_quoting_for_gstreamer() -> None:
    line = launch([Element("file", "filesrc", {"location": 'a "b" \\c'})])
    assert line == r'filesrc name=file location="a \"b\" \\c"'
    assert launch([Element("nvmm", "capsfilter", {"caps": "video/x-raw(memory:NVMM)"})]).endswith(
        'caps="video/x-raw(memory:NVMM)"'
    )


@pytest.mark.parametrize(
    "value, expected",
    [(True, "true"), (False, "false"), (3, "3"), (0.1, "0.1"), (90000.0, "90000"), ("a b", "a b")],
)
def test_values_as_gstreamer_reads_them(value: Any, expected: str) -> None:
    assert text(value) == expected


def test_the_url_of_a_camera() -> None:
    assert rtsp_url(MEDIA, "front_left") == "rtsp://127.0.0.1:8554/front_left"
    assert rtsp_url(MEDIA, "front_left", feedback=True) == "rtsp://127.0.0.1:8554/front_left/feedback"
    assert rtsp_url(replace(MEDIA, host="fd00::2"), "front_left") == "rtsp://[fd00::2]:8554/front_left"


# --- invalid graphs -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes, message",
    [
        (
            {"vehicle": (Element("pay", "rtph264pay", {}),)},
            "vehicle: 'pay': the last element must be named pay0, as the RTSP server requires",
        ),
        (
            {"vehicle": (Element("pay0", "a", {}), Element("pay0", "b", {}))},
            "vehicle[1].name: 'pay0': is already the name of another element",
        ),
        (
            {"operator": (Element("sink", "a", {}), Element("sink", "b", {}))},
            "operator[1].name: 'sink': is already the name of another element",
        ),
        (
            {"knobs": {"bitrate": (KnobTarget("pay0", "x", "kbps"), KnobTarget("pay1", "x", "kbps"))}},
            "knobs.bitrate[1].element: 'pay1': no such element, did you mean pay0?",
        ),
    ],
)
def test_a_graph_is_valid_once_built(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError) as refused:
        replace(graph(), **changes)
    assert str(refused.value) == message


def test_a_template_of_several_quantities() -> None:
    settings = GraphSettings(5600, key_interval_s=1.5, vbv_frames=2)
    value = "controls,video_bitrate={bps},period={key_interval_frames},x={kbps}/{vbv_ms}"
    target = KnobTarget("pay0", "extra-controls", value)
    camera = replace(LEFT, fps=Fraction(20), graph=replace(graph(), knobs={"bitrate": (target,)}, settings=settings))
    expected = ("pay0", "extra-controls", "controls,video_bitrate=700000,period=30,x=700/100")
    assert assignments(camera, "bitrate", 700) == [expected]
    wrong = replace(camera, graph=replace(camera.graph, knobs={"bitrate": (replace(target, value="{bps}{width}"),)}))
    with pytest.raises(ModelError) as refused:
        assignments(wrong, "bitrate", 700)
    rule = "bitrate offers kbps, bps, controls, key_interval_frames, vbv_ms"
    assert str(refused.value) == f"graph.knobs.bitrate: '{{bps}}{{width}}': {rule}"


def test_a_knob_that_cannot_offer_the_requested_value() -> None:
    wrong = replace(graph(), knobs={"bitrate": (KnobTarget("pay0", "x", "left"),)})
    with pytest.raises(ModelError) as refused:
        assignments(replace(LEFT, graph=wrong), "bitrate", 1)
    assert str(refused.value) == "graph.knobs.bitrate: 'left': bitrate offers kbps, bps, controls"


def test_whole_pictures_are_kept_in_a_branch_behind_the_source() -> None:
    words = ("vehicle=delivery_robot", "source=test", "log.lossless={front: {for_s: 9}}")
    front, rear = compile_plans(setup(*words))[:2]
    assert front.lossless == Lossless(for_s=9.0, every_s=60.0, most_gb=10.0)
    assert front.entry == "lossless-tee"
    assert front.server is not None
    assert f"! tee name=lossless-tee ! {front.vehicle[0].factory} " in front.server
    assert "lossless-tee. ! valve name=lossless-gate drop=true ! identity name=lossless-arrived ! queue" in front.server
    assert "x264enc name=lossless-encoder pass=quant quantizer=0" in front.server
    assert "lossless" not in f"{rear.server}{front.receiver}{front.recording('/dev/null')}"
    assert "lossless" not in front.vehicle_line({}), "what a shell runs writes no file"
