"""usage: tod-runner vehicle [OVERRIDE ...] [log=DIR] [duration_s=N]

The vehicle's side: an RTSP server with one stream per camera at rtsp://HOST:8554/CAMERA, the rules that set bitrate and
size of each, the source of predictions, and the control link. Needs an MQTT broker at control.host. Ends with Ctrl-C or
after duration_s. With log=DIR events, decisions and telemetry are appended to DIR/drive.jsonl.

  tod-runner vehicle                                        the paper's vehicle with a synthetic drive
  tod-runner vehicle source=v4l2 pqos=live                  real cameras; predictions come over the control link
  tod-runner vehicle graph=h264_srt media.host=192.0.2.7    dial out to an operator who listens there
"""

from __future__ import annotations

import signal

from runner.config import load_run
from runner.control import OFFLINE, Link, read_request
from runner.graph import rtsp_url
from runner.loop import Log, Loop
from runner.sources import compile_plans, render_missing
from runner.verbs import Arguments
from runner.verbs.live import progress_bar, say, streaming


def run(arguments: Arguments) -> int:
    apply = streaming()
    duration = arguments.number("duration_s")
    vehicle, pqos, track = load_run(arguments.overrides, arguments.conf, check=apply.check_plan)
    with progress_bar() as progress:
        render_missing(vehicle, progress)
    plans = compile_plans(vehicle)
    apply.check_machine(plans)
    side = apply.VehicleSide(plans, vehicle.media, lambda camera, what: say(f"{camera}: {what}"))

    def on_request(payload: bytes) -> None:
        document, identity, problem = read_request(payload)
        if problem:
            link.publish("reply", {"id": identity, "accepted": False, "reason": problem})
            return
        loop.post(document, lambda said: link.publish("reply", {"id": identity, **said}))

    def on_connected(here: bool) -> None:
        if not here:
            loop.post({"event": "operator_disconnected"})  # for the vehicle, who cannot be heard is gone

    link = Link(vehicle.name, vehicle.control, ("state", OFFLINE), {"request": on_request}, on_connected)
    loop = Loop(vehicle, side, pqos, track, Log(arguments.path("log")), link.publish, say)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: loop.stop())
    try:
        link.connect()
        for plan in plans:
            say(f"{plan.camera.name}: {rtsp_url(vehicle.media, plan.camera.name) if plan.serves else 'dials out'}")
        loop.run(duration)
    finally:
        link.close("state", OFFLINE)
        side.stop()
    return 0
