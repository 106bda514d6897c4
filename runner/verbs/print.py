"""usage: tod-runner print [-m] [OVERRIDE ...] [total_kbps=N] [format=text|json|yaml]

Dry run: prints for each camera the pipelines of vehicle and operator, and the rules' decision for a total of N kbit/s,
with the reason. Starts nothing and needs no GStreamer. Each line runs as printed: a UDP sink and the matching source
replace the live system's RTSP server and client, which gst-launch does not have. Start the operator's line first: x264
states its parameter sets once, and only the vehicle itself repeats them. Passwords are never printed: for a camera
with `credentials`, add user-id= and user-pw= to rtspsrc. Of several uplinks it says where predictions of what each
carries come from.

format=yaml shows the composed configuration instead, with the file or the override that each value comes from.

With -m, commas and range() define a sweep, also of total_kbps: each combination is a run, and the last word changes
fastest. Each run is one line of JSON, as with format=json, with the additional key overrides.

  tod-runner print total_kbps=3000                              the paper's vehicle at 3 Mbit/s
  tod-runner print vehicle=delivery_robot mode=collective       another vehicle
  tod-runner print graph=openh264_rtsp format=json              for programs
  tod-runner print vehicle=delivery_robot format=yaml           each value and where it is set
  tod-runner print -m modes=paper,safe 'total_kbps=range(1000,9000,1000)'
  sh -c "gst-launch-1.0 $(tod-runner print source=test format=json | jq -r .cameras.front_left.vehicle)"
"""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from runner.configuration.config import configuration
from runner.configuration.uplinks import KEYS, described, pqos_of_uplinks
from runner.core.budget import SOUND, VOICE
from runner.core.commands import wanted
from runner.core.decision import Decision
from runner.core.events import BitratePredicted, Event, ModeSelected, TotalSet
from runner.core.model import Kbps, Mode, Vehicle, exact, plain
from runner.core.step import start, step
from runner.errors import ArgumentError, MissingBindings
from runner.graph import Plan, may_lack_parameter_sets
from runner.plans import compile_plans, other_plans
from runner.records import to_json
from runner.records.decisions import CameraDecision, uplinks_decided
from runner.redact import redacted
from runner.verbs import Arguments

if TYPE_CHECKING:
    from runner.sound import SoundPlan
    from runner.voice import VoicePlan

Uplinks = Mapping[str, Mapping[str, str]]  # by name, what is to be said of each
Others = Sequence["SoundPlan | VoicePlan"]  # streams beside the cameras'
LOADS = {SOUND: "taken from the total", VOICE: "on the downlink, while somebody speaks"}


def run(arguments: Arguments) -> int:
    form = arguments.choice("format", ("json",) if arguments.sweeps else ())
    if arguments.sweeps:
        return _sweep(arguments)
    if form == "yaml":
        return _print_configuration(arguments)
    vehicle, plans, others, decision, uplinks = _plan(arguments)
    text = json.dumps(as_json(plans, others, decision, uplinks), indent=2, ensure_ascii=False) if form == "json" else ""
    notes = _notes(plans, uplinks) if form == "json" else []
    _print(text or as_text(vehicle, plans, others, decision, uplinks), [*notes, *_parameter_sets(plans)])
    return 0


def _print_configuration(arguments: Arguments) -> int:
    if "total_kbps" in arguments.values:
        raise ArgumentError("total_kbps", None, "has no effect with format=yaml")
    config = configuration(arguments.overrides, arguments.conf, site=arguments.site)
    config.setup()
    _print(config.listing(), [])
    return 0


def _sweep(arguments: Arguments) -> int:
    from runner.verbs.sweep import prepare_all

    runs = prepare_all(arguments, _plan)
    lines = [
        json.dumps({"overrides": words, **as_json(plans, others, decision, uplinks)}, ensure_ascii=False)
        for words, (_, plans, others, decision, uplinks) in runs
    ]
    notes = (note for _, (_, plans, *_, uplinks) in runs for note in _notes(plans, uplinks))
    _print("\n".join(lines), list(dict.fromkeys(notes)))
    return 0


def _parameter_sets(plans: Sequence[Plan]) -> list[str]:
    """What viewers who join later lack; unknown without GStreamer."""
    suspected = [plan for plan in plans if may_lack_parameter_sets(plan)]
    if not suspected:
        return []
    try:
        from runner.apply import parameter_set_notes
    except MissingBindings:
        return []
    return [f"{plan.camera.name}: {sentence}" for plan in suspected for sentence in parameter_set_notes(plan)]


def _plan(arguments: Arguments) -> tuple[Vehicle, Sequence[Plan], Others, Decision, Uplinks]:
    total = arguments.number("total_kbps")
    config = configuration(arguments.overrides, arguments.conf, site=arguments.site)
    setup = config.setup()
    decision = decide(setup.vehicle, None if total is None else exact(total))
    others = [plan for plan in other_plans(setup) if plan]
    return setup.vehicle, compile_plans(setup), others, decision, _uplinks(config.document)


def _uplinks(document: Mapping[str, Any]) -> Uplinks:
    """By uplink its ways, and where predictions of what it carries come from."""
    own = pqos_of_uplinks(document)
    of_all = f"{described(document['pqos'])}, for all together"
    return {
        name: {key: way[key] for key in KEYS if key in way}
        | {"predictions": described(own[name]) if name in own else of_all}
        for name, way in document.get("uplinks", {}).items()
    }


def _print(text: str, notes: list[str]) -> None:
    """Print without passwords; notes go to standard error."""
    print(redacted(text))
    if redacted(text) != text:
        notes.append("passwords of addresses are left out")
    print("\n".join(notes), end="\n" if notes else "", file=sys.stderr)


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


def as_json(plans: Sequence[Plan], others: Others, decision: Decision, uplinks: Uplinks) -> dict[str, Any]:
    cameras = {
        plan.camera.name: {
            "vehicle": plan.vehicle_line(wanted(decision.settings[plan.camera.name])),
            "operator": plan.operator_line(),
            "server": plan.server,
            "decision": to_json(CameraDecision.of(decision.settings[plan.camera.name])),
            **({"command": words} if (words := _command(plan, decision)) else {}),
        }
        for plan in plans
    }
    document: dict[str, Any] = {"mode": decision.mode.value, "total_kbps": plain(decision.total), "cameras": cameras}
    for other in others:
        document[other.name] = {
            "vehicle": other.vehicle_line(),
            "operator": other.operator_line(),
            "server": other.server,
            "kbps_on_the_wire": plain(other.wire_kbps),
        }
    if not uplinks:
        return document
    shares = to_json(uplinks_decided(decision)) if decision.uplinks else {}
    return {**document, "uplinks": {name: {**way, **shares.get(name, {})} for name, way in uplinks.items()}}


def _command(plan: Plan, decision: Decision) -> list[str] | None:
    """What sets the bitrate in the camera; None: nothing does."""
    kbps = decision.settings[plan.camera.name].kbps
    return plan.command.with_bitrate(kbps) if plan.command and kbps else None


def as_text(vehicle: Vehicle, plans: Sequence[Plan], others: Others, decision: Decision, uplinks: Uplinks) -> str:
    lines = [f"# {vehicle.name}, mode {decision.mode}, total {plain(decision.total)} kbit/s"]
    for name, way in uplinks.items():
        share = decision.uplinks.get(name)
        words = [f"{plain(share.total)} kbit/s", share.reason] if share else []
        words += [f"{key} {value}" for key, value in way.items()]
        lines.append(f"# uplink {name}: {', '.join(filter(None, words))}")
    lines += [f"# {note}" for note in _notes(plans, uplinks)]
    for plan in plans:
        setting = decision.settings[plan.camera.name]
        what = f"{setting.width}x{setting.height} at {setting.kbps} kbit/s" if setting.sending else "not sending"
        lines += ["", f"# {plan.camera.name}: {what}: {setting.reason}"]
        lines.append(f"gst-launch-1.0 {plan.vehicle_line(wanted(setting))}")
        lines.append(f"gst-launch-1.0 {plan.operator_line()}")
        if plan.server:
            lines.append(f"# server: {plan.server}")
        if command := _command(plan, decision):
            lines.append(f"# sets the bitrate: {shlex.join(command)}")
    for other in others:
        lines += ["", f"# {other.name}: {plain(other.wire_kbps)} kbit/s on the wire, {LOADS[other.name]}"]
        lines.append(f"gst-launch-1.0 {other.vehicle_line()}")
        lines.append(f"gst-launch-1.0 {other.operator_line()}")
        lines.append(f"# server: {other.server}")
    return "\n".join(lines)


def _notes(plans: Sequence[Plan], uplinks: Uplinks) -> list[str]:
    stand_ins = [plan.camera.name for plan in plans if plan.stands_in]
    notes = [f"videotestsrc stands in for the frames of {', '.join(stand_ins)}"] if stand_ins else []
    redundant = [plan.camera.name for plan in plans if plan.camera.redundant]
    if redundant and len(uplinks) < 2:
        notes.append(f"redundant has no effect on {', '.join(redundant)}: it needs two uplinks")
    return notes
