"""usage: tod-runner print [OVERRIDE ...] [total_kbps=N] [format=text|json]

Dry run: for each camera the pipeline of the vehicle and of the operator, and the rules' decision for a total of
N kbit/s, with the reason. Starts nothing and needs no GStreamer. Each line runs as it is: in place of the live system's
RTSP server and client, the lines have a UDP sink and the matching source, since gst-launch has neither. Passwords in
addresses are left out: put them back to run such a line.

  tod-runner print total_kbps=3000                              the paper's vehicle at 3 Mbit/s
  tod-runner print vehicle=delivery_robot mode=collective       another vehicle
  tod-runner print graph=openh264_rtsp format=json              for programs
  sh -c "gst-launch-1.0 $(tod-runner print source=test format=json | jq -r .cameras.front_left.vehicle)"
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace

from runner.configuration.config import configuration
from runner.core.commands import wanted
from runner.core.decision import Decision
from runner.core.events import BitratePredicted, Event, ModeSelected, TotalSet
from runner.core.model import Kbps, Mode, Vehicle, exact, plain
from runner.core.step import start, step
from runner.graph import Plan
from runner.plans import compile_plans
from runner.records import CameraDecision, to_json
from runner.redact import redacted
from runner.verbs import Arguments


def run(arguments: Arguments) -> int:
    form = arguments.choice("format", ("text", "json"))
    total = arguments.number("total_kbps")
    vehicle = configuration(arguments.overrides, arguments.conf).vehicle()
    plans = compile_plans(vehicle)
    decision = decide(vehicle, None if total is None else exact(total))
    text = as_json(plans, decision) if form == "json" else as_text(vehicle, plans, decision)
    print(redacted(text))
    notes = _stand_ins(plans) if form == "json" else []
    if redacted(text) != text:
        notes.append("passwords of addresses are left out")
    print("\n".join(notes), end="\n" if notes else "", file=sys.stderr)
    return 0


def decide(vehicle: Vehicle, total: Kbps | None) -> Decision:
    """The rules' decision at the start, or for a total in kbit/s; mode single uses what automatic would."""
    events: Sequence[Event] = ()
    if total is not None and vehicle.mode is Mode.COLLECTIVE:
        events = (TotalSet(t=0, kbps=total),)
    elif total is not None:
        events = (BitratePredicted(t=0, kbps=total), ModeSelected(t=0, mode=vehicle.mode))
        vehicle = replace(vehicle, mode=Mode.AUTOMATIC)
    run = start(vehicle)
    for event in events:
        run = step(vehicle, run, event)
    return run.decision


def as_json(plans: Sequence[Plan], decision: Decision) -> str:
    cameras = {
        plan.camera.name: {
            "vehicle": plan.vehicle_line(wanted(decision.settings[plan.camera.name])),
            "operator": plan.operator_line(),
            "server": plan.server,
            "decision": to_json(CameraDecision.of(decision.settings[plan.camera.name])),
        }
        for plan in plans
    }
    document = {"mode": decision.mode.value, "total_kbps": plain(decision.total), "cameras": cameras}
    return json.dumps(document, indent=2, ensure_ascii=False)


def as_text(vehicle: Vehicle, plans: Sequence[Plan], decision: Decision) -> str:
    lines = [f"# {vehicle.name}, mode {decision.mode}, total {plain(decision.total)} kbit/s"]
    lines += [f"# {note}" for note in _stand_ins(plans)]
    for plan in plans:
        setting = decision.settings[plan.camera.name]
        what = f"{setting.width}x{setting.height} at {setting.kbps} kbit/s" if setting.sending else "not sending"
        lines += ["", f"# {plan.camera.name}: {what}: {setting.reason}"]
        lines.append(f"gst-launch-1.0 {plan.vehicle_line(wanted(setting))}")
        lines.append(f"gst-launch-1.0 {plan.operator_line()}")
        if plan.server:
            lines.append(f"# server: {plan.server}")
    return "\n".join(lines)


def _stand_ins(plans: Sequence[Plan]) -> list[str]:
    names = [plan.camera.name for plan in plans if plan.stands_in]
    return [f"videotestsrc stands in for the frames of {', '.join(names)}"] if names else []
