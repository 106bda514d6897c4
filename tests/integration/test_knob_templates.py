"""A knob that sets a structure, as for `extra-controls` of V4L2 encoders: `sdes` of an rtpsession stands in for it."""

from __future__ import annotations

from rig import until
from runner.configuration.config import configuration
from runner.plans import compile_plans

SDES = "application/x-rtp-source-sdes, cname=(string)rear, note=(string)"
KNOBS = f"""
defaults: [h264_srt, _self_]
vbv_frames: 2
knobs:
  bitrate:
    - {{element: encoder, property: bitrate, value: kbps}}
    - {{element: session, property: sdes, value: "{SDES}{{bps}}-{{vbv_ms}}-{{key_interval_frames}}"}}
mutable: [{{element: session, property: sdes}}]
"""
WORDS = ("vehicle=delivery_robot", "source=test", "graph=controls", "fps_max=20", "graph.key_interval_s=2")


def test_a_template_is_set_and_read_back_while_playing(conf):
    from runner.apply import check_plan
    from runner.gst import Gst
    from runner.gst.knobs import KnobPanel

    conf.write("graph/controls.yaml", KNOBS)
    setup = configuration(WORDS, conf.path, check=check_plan).setup()
    plan = next(plan for plan in compile_plans(setup) if plan.camera.name == "rear")
    pipeline = Gst.parse_launch(plan.pipeline)
    session, reported = pipeline.get_by_name("session"), []
    panel = KnobPanel(pipeline, plan.camera, lambda: None, reported.append)

    def note():
        return session.get_property("sdes").get_string("note")

    panel.set_now({"bitrate": 700})
    assert (note(), panel.applied) == ("700000-100-40", {"bitrate": 700})
    pipeline.set_state(Gst.State.PLAYING)
    try:
        panel.turn({"bitrate": 300})
        until(lambda: panel.applied == {"bitrate": 300})
        assert note() == "300000-100-40"
        session.set_property("sdes", Gst.Structure.new_from_string(f"{SDES}another"))
        panel.turn({"bitrate": 300})
        until(lambda: note() == "300000-100-40")
    finally:
        pipeline.set_state(Gst.State.NULL)
    assert reported == []
