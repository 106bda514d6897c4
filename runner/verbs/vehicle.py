"""usage: tod-runner vehicle [OVERRIDE ...] [log=DIR | drives=DIR] [duration_s=N]

The vehicle's side: an RTSP server with one stream per camera at rtsp://HOST:8554/CAMERA, the rules that set bitrate and
size of each, the prediction source, and the control link. Needs an MQTT broker at control.host. Ends with Ctrl-C or
after duration_s. With log=DIR events, decisions and telemetry are written to DIR/drive.jsonl, which must not exist;
with drives=DIR to DIR/TIME/drive.jsonl, where TIME is the start in UTC. Who is in control outlasts a restart, in
~/.local/state/tod-runner/vehicles (or below XDG_STATE_HOME).

Predictions and positions come over the control link (pqos=live) unless a file or an override states another source.

  tod-runner vehicle                                        the paper's vehicle with rendered pictures
  tod-runner vehicle source=v4l2                            real cameras
  tod-runner vehicle pqos=map                               as in the demo: positions of a simulated drive along a map
  tod-runner vehicle keys=tod-keys graph=h264_srt media.host=192.0.2.7 control.host=192.0.2.7 control.port=8883
                                                            connect to an operator that listens there
"""

from __future__ import annotations

import sys

from runner.drive.keeping import keeping_room
from runner.system.kept import state_directory
from runner.system.memory import freeze_loaded
from runner.system.signals import stopping
from runner.vehicle.live import live_vehicle
from runner.verbs import Arguments
from runner.verbs.screen import SWITCH_S, progress_bar, say, streaming


def run(arguments: Arguments) -> int:
    streaming()
    duration = arguments.number("duration_s")
    sys.setswitchinterval(SWITCH_S)
    with (
        progress_bar() as progress,
        live_vehicle(
            arguments.overrides,
            arguments.conf,
            log=arguments.drive(),
            state=state_directory() / "vehicles",
            say=say,
            progress=progress,
            site=arguments.site,
        ) as vehicle,
        keeping_room(arguments.path("drives"), vehicle.loop.setup.log, vehicle.loop.on_report),
        stopping(action=vehicle.loop.stop) as stop,
    ):
        if vehicle.loop.track is not None:
            own = "for the vehicle's own: pqos=live, or pqos.position.kind=live"
            say(f"positions, and predictions that follow from them, are those of a simulated drive; {own}")
        freeze_loaded()
        vehicle.run(duration)
    return stop.status
