"""usage: tod-runner doctor [VERB] [OVERRIDE ...] [registry=FILE]
       tod-runner doctor cameras [OVERRIDE ...]

Lists what this machine lacks to run a verb with this configuration, and how to install it: Python packages, GStreamer
and its bindings, elements, broker, free ports, certificates that are valid for 30 more days, cameras and the USB
bandwidth they share, uplinks, cores. The default verb is `demo`, which needs everything that both sides need. Ends with
status 1 if something is missing.

`doctor cameras` lists the V4L2 cameras of this machine with their formats, sizes and rates, and the topics of ROS with
pictures (see ros.* in docs/ros.md). For each it prints the YAML that mounts it. Ends with status 1 if there is none.

registry=FILE keeps what GStreamer offers on this machine, a vehicle for example, for `tod-runner validate target=FILE`
on another.

  tod-runner doctor
  tod-runner doctor cameras
  tod-runner doctor vehicle source=v4l2 graph=h264_va_rtsp
  tod-runner doctor vehicle registry=van.registry
  tod-runner doctor model metric=vmaf
"""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from runner.configuration.config import configuration
from runner.core.model import Vehicle
from runner.errors import ArgumentError, MissingBindings, RunError, UserError, reason, suggest
from runner.graph import Plan
from runner.inputs import input_problem
from runner.mqtt.broker import find_mosquitto
from runner.plans import compile_plans, nearest_rate, other_plans
from runner.security.keyring import HOLDER, Keyring
from runner.security.validity import date, expiring, invalid
from runner.settings import Endpoint, RosSettings, Setup
from runner.system.extras import EXTRAS, how_to_install
from runner.system.ports import check_port_free
from runner.system.rtsp import OK, UNAUTHORIZED, describe
from runner.system.usb import UsbCamera, buses
from runner.system.v4l2 import connected, device_problem
from runner.verbs import VERBS, Arguments, study_word
from runner.verbs.doctor_uplinks import Diagnosis, check_uplinks

CAMERAS = "cameras"  # in place of a verb
IMPORT_S = 30  # rclpy or rospy loads within a second
CORE_MPX_S = 180  # cropped, scaled and encoded per core and second at factor 0.5, measured with h264_rtsp
OLDEST_GSTREAMER = (1, 22)  # its jitter buffer keeps the times at which pictures were captured
STREAMING = ("vehicle", "operator", "latency", "demo", "record", "model", "quality")  # verbs that need GStreamer
CONNECTING = ("vehicle", "operator", "latency", "ros", "demo")  # verbs that use keys
NEEDED = {  # extras of this package that a verb needs with any configuration
    "vehicle": ("live",),
    "operator": ("live",),
    "latency": ("live", "page"),
    "ros": ("live",),
    "demo": ("live",),
    "record": ("live",),
    "model": ("model",),
    "report": ("report",),
    "quality": ("model",),
    "export": ("mcap",),
}


def run(arguments: Arguments) -> int:
    if arguments.words == (CAMERAS,):
        return _cameras(arguments)
    verb = _verb(arguments)
    overrides = [study_word(word) for word in arguments.overrides] if verb == "model" else arguments.overrides
    site = arguments.site if VERBS[verb].sited else None
    config = configuration(overrides, arguments.conf, runnable=False, site=site)
    findings = list(examine(verb, config.setup(), config.document))
    if site:
        print(f"ok      site file {site}")
    for fine, what in findings:
        print(f"{'ok     ' if fine else 'MISSING'} {what}")
    if not findings:
        print(f"ok      {verb} needs only this package")
    if path := arguments.path("registry"):
        _keep_registry(path)
    return 0 if all(fine for fine, _ in findings) else 1


def _cameras(arguments: Arguments) -> int:
    from runner.verbs.doctor_cameras import list_cameras

    if registry := arguments.path("registry"):
        raise ArgumentError("registry", registry, f"must not be given with {CAMERAS}")
    config = configuration(arguments.overrides, arguments.conf, runnable=False, site=arguments.site)
    return 0 if list_cameras(config.setup()) else 1


def _keep_registry(path: Path) -> None:
    """raises  RunError if the file cannot be written"""
    try:
        from runner.apply import LIVE
    except MissingBindings as error:
        raise RunError(f"{path}: nothing was written: {error}") from None
    from runner.elements.dump import write_dump

    dump = LIVE.dump()
    write_dump(path, dump)
    print(f"written {path}: {len(dump.elements)} elements of GStreamer {dump.gstreamer}")


def _verb(arguments: Arguments) -> str:
    words = arguments.words or ("demo",)
    if len(words) > 1:
        raise ArgumentError("", words[1], "must be one verb")
    if words[0] not in VERBS:
        raise ArgumentError("", words[0], f"unknown verb{suggest(words[0], (*VERBS, CAMERAS))}")
    return words[0]


def examine(verb: str, setup: Setup, document: Mapping[str, Any]) -> Iterator[Diagnosis]:
    """Everything that a verb needs with this configuration."""
    vehicle = setup.vehicle
    needed: dict[str, str] = {}
    for extra in _extras(verb, setup, document):
        for module in EXTRAS[extra]:
            needed.setdefault(module, extra)
    for module, extra in needed.items():
        found = find_spec(module) is not None
        hint = "" if found else f": {how_to_install(extra)}"
        yield Diagnosis(found, f"Python module {module}{hint}")
    if verb in STREAMING:
        bindings = list(_bindings())
        yield from bindings
        if all(finding.fine for finding in bindings):
            yield from _elements(verb, setup)
    if _starts_broker(verb, setup):
        yield _broker()
    yield from _ports(verb, setup)
    if verb in CONNECTING and setup.keys is not None and find_spec("cryptography"):
        yield from _certificates(Path(setup.keys))
    if verb in ("vehicle", "operator", "ros") and setup.control.foreign and find_spec("cryptography"):
        from runner.verbs.doctor_broker import check_broker

        yield from check_broker(setup, verb)
    if verb in ("vehicle", "demo", "record"):
        yield from _devices(vehicle)
        yield from _connected()
        yield from _ip_cameras(setup)
        yield from _commands(setup)
    if verb in ("vehicle", "demo"):
        if not (document.get("link") or {}).get("lanes"):  # they make the devices of the uplinks
            yield from check_uplinks(setup.uplinks, setup.control.host)
        yield _cores(vehicle)
    subscribes = any(camera.source.subscribes for camera in vehicle.cameras.values())
    publishes = setup.ros.pictures and verb in ("operator", "demo")
    if verb == "ros" or publishes or (subscribes and verb in ("vehicle", "demo")):
        yield _ros_library(setup.ros)


def _extras(verb: str, setup: Setup, document: Mapping[str, Any]) -> Iterator[str]:
    """Extras of this package that a verb needs."""
    sources = [camera.source for camera in setup.vehicle.cameras.values()]
    yield from NEEDED.get(verb, ())
    if verb in ("operator", "demo") and setup.page.serve:
        yield "page"
    if verb in ("vehicle", "demo", "record") and any(source.render for source in sources):
        yield "synthetic"
    if verb in CONNECTING:
        yield from ["security"] if setup.keys is not None or setup.control.foreign else []
    ports = {"vehicle": setup.metrics.vehicle_port, "operator": setup.metrics.operator_port}
    if any(port is not None and verb in (side, "demo") for side, port in ports.items()):
        yield "metrics"
    if verb in ("vehicle", "demo", "record", "model") and any(source.plays_bags for source in sources):
        yield "bag"
    if verb == "model":
        study = document["study"]
        yield from ["vmaf"] if "vmaf" in study["metric"] else []
        yield from ["cluster"] if study["workers"] == "dask" else []


def _ros_library(settings: RosSettings) -> Diagnosis:
    """The Python interpreter of the ROS node, which must have rclpy or rospy."""
    from runner.ros.node.start import LIBRARIES
    from runner.ros.process import INSTALL_HINT

    library = LIBRARIES[settings.version]
    try:
        command = [settings.interpreter, "-c", f"import {library}, sensor_msgs.msg, std_srvs.srv"]
        done = subprocess.run(command, capture_output=True, timeout=IMPORT_S, check=False)
        why = None if done.returncode == 0 else done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
    except (OSError, subprocess.TimeoutExpired) as error:
        why = str(error)
    hint = f": {why}; {INSTALL_HINT[settings.version]}, see docs/ros.md" if why is not None else ""
    return Diagnosis(why is None, f"{library} for ros.python {settings.interpreter}{hint}")


def _bindings() -> Iterator[Diagnosis]:
    """GStreamer's Python bindings: PyGObject and typelibs."""
    try:
        from runner import apply
    except MissingBindings as error:
        yield from (Diagnosis(False, f"{part}: {why}") for part, why in error.missing.items())
    else:
        yield from (Diagnosis(True, f"typelib {name}") for name in apply.TYPELIBS)
        yield gstreamer_fits(apply.versions(())["GStreamer"])


def gstreamer_fits(version: str) -> Diagnosis:
    """Whether a version of GStreamer, such as 1.22.0, is new enough."""
    fits = tuple(map(int, version.split(".")))[:2] >= OLDEST_GSTREAMER
    hint = ": too old; times of capture, and so latencies, need 1.22 or later, see docs/install.md"
    return Diagnosis(fits, f"GStreamer {version}{'' if fits else hint}")


def _elements(verb: str, setup: Setup) -> Iterator[Diagnosis]:
    """GStreamer elements: those of one side for its own verb, otherwise all."""
    from runner.apply import LIVE
    from runner.elements.packages import missing_plugins, missing_recorders

    lines, missing = [], dict[str, None]()
    others = [plan for plan in other_plans(setup) if plan]
    for plan in (*compile_plans(setup), *others):
        if verb == "operator":
            lines += [plan.operator]
            missing |= dict.fromkeys(missing_plugins(LIVE, plan, ("operator",)))
        elif verb == "vehicle":
            lines += [plan.source, plan.vehicle]
            missing |= dict.fromkeys(missing_plugins(LIVE, plan, ("vehicle",)))
        else:
            lines += [plan.source, plan.vehicle, plan.operator]
            missing |= dict.fromkeys(missing_plugins(LIVE, plan))
            if isinstance(plan, Plan):
                lines += [plan.recorder]
                missing |= dict.fromkeys(missing_recorders(LIVE, plan))
    names = {element.factory for line in lines for element in line}
    yield from (Diagnosis(False, sentence) for sentence in missing)
    if not missing:
        yield Diagnosis(True, f"{len(names)} GStreamer elements")


def _starts_broker(verb: str, setup: Setup) -> bool:
    return verb == "demo" or (setup.control.embedded and verb in ("vehicle", "operator"))


def _broker() -> Diagnosis:
    try:
        return Diagnosis(True, f"MQTT broker {find_mosquitto()}, which this verb starts")
    except RunError as error:
        return Diagnosis(False, str(error))


def _ports(verb: str, setup: Setup) -> Iterator[Diagnosis]:
    """Ports that a verb listens on."""
    ports: dict[str, Endpoint] = {}
    if verb in ("vehicle", "demo"):
        ports["media.port"] = setup.media
    if _starts_broker(verb, setup):
        ports["control.port"] = setup.control
    if verb == "latency" or (verb in ("operator", "demo") and setup.page.serve):
        ports["page.port"] = setup.page.endpoint
    for key, endpoint in ports.items():
        try:
            check_port_free(endpoint)
        except RunError as error:
            yield Diagnosis(False, f"{key}: {error}")
        else:
            yield Diagnosis(True, f"{key}: {endpoint} is free")


def _certificates(keys: Path) -> Iterator[Diagnosis]:
    """Until when certificates are valid: of one holder, or of all for a demo."""
    for directory in [keys] if (keys / HOLDER).exists() else sorted(path.parent for path in keys.glob(f"*/{HOLDER}")):
        ring = Keyring(directory)
        try:
            name, validity = ring.holder.name, ring.validity()
        except UserError as error:
            yield Diagnosis(False, str(error))
            continue
        now, whose = time.time(), f"{name}'s"
        why = invalid(validity, now)
        wrong = [f"{whose} certificate {why}"] if why else expiring({whose: validity.ends}, now)
        fine = f"{whose} certificate is valid until {date(validity.ends)}"
        yield Diagnosis(
            not wrong, f"{wrong[0]}: `tod-runner keys output=DIR rotate={name}` renews it" if wrong else fine
        )


def _devices(vehicle: Vehicle) -> Iterator[Diagnosis]:
    """Clips, bags and V4L2 cameras, and the bandwidth of the USB buses that they share."""
    cameras = []
    for camera in vehicle.cameras.values():
        if absent := input_problem(camera):
            yield Diagnosis(False, f"camera {camera.name}: {absent}")
        if camera.device is not None:
            path = Path(camera.device)
            why = device_problem(path, camera.capture, camera.fps)
            rate = nearest_rate(camera) if why is None else None
            taken = f" captures at {rate} Hz, the nearest to {float(camera.capture.fps or 0):g}" if rate else ""
            yield Diagnosis(why is None, f"camera {camera.name}: {path}{f' {why}' if why else taken}")
            cameras.append(UsbCamera(camera.name, path, camera.capture, camera.fps))
    for bus in buses(cameras):
        need = f"about {bus.mbps:.0f} of {bus.budget_mbps:.0f} Mbit/s"
        what = f"USB bus {bus.number} at {bus.speed_mbps} Mbit/s: {', '.join(bus.cameras)} need {need}"
        if bus.unknown:
            what += f", without {', '.join(bus.unknown)}, whose capture does not state format and size"
        fits = bus.mbps <= bus.budget_mbps
        yield Diagnosis(fits, what if fits else f"{what}: choose mjpeg, a lower fps, or another bus")


def _connected() -> Iterator[Diagnosis]:
    if found := len(list(connected())):
        yield Diagnosis(True, f"V4L2 cameras: {found}; `tod-runner doctor {CAMERAS}` lists them, with their YAML")


def _ip_cameras(setup: Setup) -> Iterator[Diagnosis]:
    """What the IP cameras offer, without a login."""
    with ThreadPoolExecutor() as pool:
        yield from pool.map(_ip_camera, (plan for plan in compile_plans(setup) if plan.camera.address))


def _ip_camera(plan: Plan) -> Diagnosis:
    camera = plan.camera
    name, video = f"camera {camera.name}: {camera.address}", camera.source.medium + 1
    try:
        found = describe(str(camera.address), camera.source.first_reply_s)
    except (OSError, ValueError) as error:
        return Diagnosis(False, f"{name}: {reason(error) if isinstance(error, OSError) else error}")
    if found.unknown_login:
        return Diagnosis(False, f"{name}: {found.unknown_login}")
    if found.status == UNAUTHORIZED:
        what = f"{name} demands a login ({' or '.join(found.logins)})"
        given = camera.credentials is not None
        return Diagnosis(given, f"{what}, not tried here" if given else f"{what}: name the file as credentials")
    if found.status != OK:
        return Diagnosis(False, f"{name}: answers DESCRIBE with status {found.status}")
    what = f"{name} offers {found.video} video media"
    if video > found.video:
        return Diagnosis(False, f"{what}, counted from 0: source.medium is {camera.source.medium}")
    return _passed_on(plan, name) if camera.graph.passes else Diagnosis(True, what)


def _commands(setup: Setup) -> Iterator[Diagnosis]:
    """Whether the programs are here that set bitrates in cameras."""
    for camera in setup.vehicle.cameras.values():
        if camera.graph.command:
            program = camera.graph.command.words[0]
            what = f"camera {camera.name}: {program}, which sets its bitrate"
            yield Diagnosis(shutil.which(program) is not None, what)


def _passed_on(plan: Plan, name: str) -> Diagnosis:
    """What is wrong with the pictures of a camera that are passed on."""
    try:
        from runner.apply import first_look
    except MissingBindings:
        return Diagnosis(True, f"{name}: its pictures are not looked at without GStreamer")
    count, wrong = first_look(plan, plan.camera.source.first_reply_s)
    what = f"{name}: {count} pictures looked at"
    return Diagnosis(bool(count) and not wrong, f"{what}: {'; '.join(wrong)}" if wrong else what)


def _cores(vehicle: Vehicle) -> Diagnosis:
    """Whether the cores can handle all cameras at full rate, as an estimate; never reported as missing."""
    load_mpx = sum(float(camera.fps) * camera.width * camera.height for camera in vehicle.cameras.values()) / 1e6
    cores = os.cpu_count() or 1
    need = load_mpx / CORE_MPX_S
    return Diagnosis(
        True, f"{cores} cores; sending all cameras at their own rates takes about {need:.1f} of them, receiving more"
    )
