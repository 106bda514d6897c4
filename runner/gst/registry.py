"""Checks a plan against this machine's GStreamer registry, to find errors before they show while driving."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache, lru_cache

from gi.repository import GLib, GObject, Gst

from runner.core.commands import KnobValue
from runner.core.model import Element, ModelError, Value
from runner.errors import RunError, suggest
from runner.graph import Plan, assignments, launch, text
from runner.gst.enums import enum_values

PACKAGES = {  # elements by Debian package; `doctor` and messages on missing plugins name the package
    "gstreamer1.0-plugins-base": "videoconvert videoscale videorate videotestsrc decodebin appsrc appsink",
    "gstreamer1.0-plugins-good": "videocrop aspectratiocrop rtph264pay rtph264depay rtpjitterbuffer rtspsrc udpsrc"
    " udpsink v4l2src rtpbin rtpsession jpegdec capssetter qtdemux matroskademux matroskamux vp8enc vp8dec rtpvp8pay"
    " rtpvp8depay",
    "gstreamer1.0-plugins-bad": "h264parse h265parse mpegtsmux tsdemux openh264enc x265enc srtsrc srtsink bayer2rgb"
    " vah264enc nvh264enc",
    "gstreamer1.0-plugins-ugly": "x264enc",
    "gstreamer1.0-libav": "avdec_h264 avdec_ffv1 avenc_ffv1",
    "gstreamer1.0-rtsp": "rtspclientsink",
    "gstreamer1.0-x": "textoverlay",
    "nvidia-l4t-gstreamer": "nvvidconv nvv4l2h264enc",
}
HARDWARE = {"vah264enc": "va", "nvh264enc": "nvcodec"}  # plugin by element that exists only with its hardware
PARTS = ("vehicle", "operator", "recording")  # of a plan
PACKAGE_OF = {element: package for package, elements in PACKAGES.items() for element in elements.split()}


def missing_plugins(plan: Plan, sides: Sequence[str] = ("vehicle", "operator")) -> list[str]:
    """One sentence for each known element that streaming needs on these sides and this machine lacks."""
    needed = {"vehicle": (*plan.source, *plan.vehicle), "operator": plan.operator}
    return _missing((*(element for side in sides for element in needed[side]), *plan.video_elements))


def missing_recorders(plan: Plan) -> list[str]:
    """The same for recording."""
    return _missing((*plan.source, *plan.recorder))


def require_plugins(plans: Iterable[Plan], sides: Sequence[str]) -> None:
    """Check that every plugin that streaming needs on these sides is installed.

    raises  RunError with the packages to install, for all cameras at once
    """
    _require(sentence for plan in plans for sentence in missing_plugins(plan, sides))


def check_recorders(plans: Iterable[Plan]) -> None:
    """The same for recording."""
    _require(sentence for plan in plans for sentence in missing_recorders(plan))


def _require(missing: Iterable[str]) -> None:
    if found := dict.fromkeys(missing):
        raise RunError("\n".join(found))


def _missing(elements: Iterable[Element]) -> list[str]:
    names = dict.fromkeys(element.factory for element in elements)
    return [why_missing(name) for name in names if name in PACKAGE_OF and Gst.ElementFactory.find(name) is None]


def why_missing(name: str) -> str:
    """The remedy for a known element that this machine lacks."""
    plugin = HARDWARE.get(name)
    if plugin and Gst.Registry.get().find_plugin(plugin):
        return f"the GStreamer element {name} needs hardware and a driver that its plugin {plugin} does not find here"
    return f"the GStreamer element {name} is not installed; on Debian: apt-get install {PACKAGE_OF[name]}"


def versions(elements: Iterable[Element]) -> dict[str, str]:
    """GStreamer's version, and by element the version of its plugin."""
    found = {"GStreamer": ".".join(map(str, Gst.version()[:3]))}
    for element in elements:
        factory = Gst.ElementFactory.find(element.factory)
        if factory:
            plugin = factory.get_plugin()
            found[element.factory] = f"{plugin.get_package()}, {plugin.get_version()}"
    return found


def check_plan(plan: Plan, parts: Collection[str] = PARTS) -> list[ModelError]:
    """Everything the registry does not allow: unknown elements and properties, wrong types and ranges, fixed knobs.

    Known elements that are not installed are reported by `missing_plugins` and `missing_recorders`.

    parts  to check; the plugins of the others are not loaded: a decoder takes 30 MB of a vehicle's memory
    """
    elements = [
        ("vehicle", "source.elements", plan.source),
        ("vehicle", "graph.vehicle", plan.vehicle),
        ("operator", "graph.operator", plan.operator),
        ("vehicle", "graph.wire.vehicle", plan.wire_vehicle),
        ("operator", "graph.wire.operator", plan.wire_operator),
        ("recording", "recording.elements", plan.recorder),
    ]
    found = [error for part, where, its in elements if part in parts for error in _check_elements(its, where)]
    if "vehicle" in parts:
        found += _check_knobs(plan)
    return found or _check_links(plan, parts)


def check_vehicle(plan: Plan) -> list[ModelError]:
    """`check_plan` of the vehicle's part, for the side that runs only that."""
    return check_plan(plan, ("vehicle",))


def check_operator(plan: Plan) -> list[ModelError]:
    """`check_plan` of the operator's part, for the side that runs only that."""
    return check_plan(plan, ("operator",))


def _check_elements(elements: tuple[Element, ...], where: str) -> Iterator[ModelError]:
    for index, element in enumerate(elements):
        path = f"{where}[{index}]"
        if _template(element.factory) is None:
            if element.factory not in PACKAGE_OF:
                rule = f"unknown element{suggest(element.factory, _factory_names(element.factory))}"
                yield ModelError(f"{path}.element", repr(element.factory), rule)
            continue
        for direction, pad in (("sink", element.sink), ("src", element.src)):
            if pad and (problem := _pad_problem(element.factory, direction, pad)):
                yield ModelError(f"{path}.pads.{direction}", repr(pad), problem)
        for key, value in element.properties.items():
            problem = _property_problem(element.factory, key, value)
            if problem:
                yield ModelError(f"{path}.properties.{key}", _shown(value), problem, f"{path}.element")


def _check_knobs(plan: Plan) -> Iterator[ModelError]:
    """Each knob's property must exist, be mutable while PLAYING and accept the knob's largest value."""
    camera = plan.camera
    factories = {element.name: element.factory for element in (*plan.source, *plan.vehicle)}
    stated = {element.name: f"graph.vehicle[{place}].element" for place, element in enumerate(plan.vehicle)}
    largest: dict[str, KnobValue] = {
        "sending": True,
        "roi": camera.full_roi,
        "size": (camera.width, camera.height),
        "bitrate": max(1, int(camera.rate_quality.b_full)),
    }
    for knob, value in largest.items():
        for index, (name, key, filled) in enumerate(assignments(camera, knob, value)):
            factory = factories[name]
            element = _template(factory)
            if element is None:
                continue
            path = f"graph.knobs.{knob}[{index}]"
            rule = _property_problem(factory, key, filled)
            if rule:
                yield ModelError(f"{path}.property", repr(key), rule, stated[name])
            elif not _may_change(element, key) and (name, key) not in camera.graph.mutable:
                rule = f"{factory} does not declare {key} as mutable while playing; if it is, list it under mutable"
                yield ModelError(f"{path}.property", repr(key), rule, stated[name])


def _may_change(element: Gst.Element, key: str) -> bool:
    """Whether an element declares a property as mutable while PLAYING."""
    return bool(int(element.find_property(key).flags) & Gst.PARAM_MUTABLE_PLAYING)


def _check_links(plan: Plan, parts: Collection[str]) -> list[ModelError]:
    """Check that neighbouring elements can be linked."""
    errors: dict[str, ModelError] = {}
    for where, line in _lines(plan, parts):
        if where not in errors and (message := _unlinkable(line)):
            part = plan.operator if where == "graph.operator" else (*plan.source, *plan.vehicle)
            message += _misfit(message, [(each.name, each.factory) for each in part])
            errors[where] = ModelError(where, None, message, *(f"{where}[{place}].name" for place in range(len(part))))
    return list(errors.values())


def _lines(plan: Plan, parts: Collection[str]) -> Iterator[tuple[str, str]]:
    """The plan's pipelines as GStreamer parses them, except those with an element that this machine lacks.

    A source that ends in a filter becomes a line of its own, which many graphs share; the rest is another.
    """
    filtered = bool(plan.source) and plan.source[-1].factory == "capsfilter"
    rest = replace(plan, source=plan.source[-1:]) if filtered else plan
    sides = [side for side in ("vehicle", "operator") if side in parts]
    streams = not missing_plugins(plan, sides)
    sends, receives = ("vehicle" in sides and streams), ("operator" in sides and streams)
    records = "recording" in parts and plan.recorder and not missing_recorders(plan)
    if filtered and (sends or records):
        yield "graph.vehicle" if sends else "recording.elements", launch(plan.source)
    if sends:
        yield "graph.vehicle", rest.pipeline
    if receives:
        yield "graph.operator", plan.receiver
    if records:
        yield "recording.elements", rest.recording("/dev/null")


@cache
def _unlinkable(line: str) -> str | None:
    """GStreamer's message if neighbours in a line cannot be linked, otherwise None."""
    try:
        Gst.parse_launch(line)
    except GLib.Error as error:
        return str(error.message)
    return None


def _misfit(message: str, elements: Sequence[tuple[str, str]]) -> str:
    """Which media do not fit where GStreamer could not link two elements, and what would; "" if that is not why."""
    factories, found = dict(elements), re.match(r"could not link (\S+) to ([^\s,]+)", message)
    if not found or not {*found.groups()} <= factories.keys():
        return ""
    names = list(factories)
    before = [factories[name] for name in reversed(names[: names.index(found[1]) + 1])]
    source = next((factory for factory in before if _media(factory, Gst.PadDirection.SRC)), None)
    sink = factories[found[2]]
    takes = _media(sink, Gst.PadDirection.SINK)
    gives = _media(source, Gst.PadDirection.SRC) if source else frozenset()
    if not gives or not takes or gives & takes:
        return ""
    fitting = [name for name in _like(sink) if gives <= _media(name, Gst.PadDirection.SINK)]
    instead = f"; in place of {sink}: {', '.join(fitting)}, and what receives it at the other side" if fitting else ""
    return f": {source} gives {', '.join(sorted(gives))}, {sink} takes {', '.join(sorted(takes))}{instead}"


def _media(factory: str, direction: Gst.PadDirection) -> frozenset[str]:
    """Media types of an element's pads by their templates; none if it takes any."""
    templates = Gst.ElementFactory.find(factory).get_static_pad_templates()
    every = [template.get_caps() for template in templates if template.direction == direction]
    if any(caps.is_any() for caps in every):
        return frozenset()
    return frozenset(caps.get_structure(n).get_name() for caps in every for n in range(caps.get_size()))


def _like(factory: str) -> list[str]:
    """Elements of the same class, those of the highest rank first."""
    wanted = Gst.ElementFactory.find(factory).get_metadata("klass")
    every = Gst.Registry.get().get_feature_list(Gst.ElementFactory)
    alike = [each for each in every if each.get_metadata("klass") == wanted and each.get_rank()]
    return [each.get_name() for each in sorted(alike, key=lambda each: (-each.get_rank(), each.get_name()))]


@lru_cache(maxsize=None, typed=True)
def _property_problem(factory: str, key: str, value: Value) -> str | None:
    """Why an element does not accept this value of this property; None if it does."""
    element = _template(factory)
    assert element is not None
    spec = element.find_property(key)
    if spec is None:
        return f"{factory} has no such property{suggest(key, (p.name for p in element.list_properties()))}"
    if not int(spec.flags) & GObject.ParamFlags.WRITABLE:
        return f"{key} of {factory} is read-only"
    kind = spec.value_type.name
    if not _readable(kind, text(value)):
        nicks = [value.nick for value in enum_values(spec.value_type)]
        return f"must be one of {', '.join(nicks)}" if nicks else f"must be a {kind.removeprefix('g')}"
    if hasattr(spec, "minimum") and not spec.minimum <= float(value) <= spec.maximum:
        return f"must be from {spec.minimum} to {spec.maximum}"
    return None


def _pad_problem(factory: str, direction: str, pad: str) -> str | None:
    """Why an element cannot have a pad of this name in this direction; None if it can."""
    wanted = Gst.PadDirection.SINK if direction == "sink" else Gst.PadDirection.SRC
    templates = Gst.ElementFactory.find(factory).get_static_pad_templates()
    names = sorted(template.name_template for template in templates if template.direction == wanted)
    if any(re.fullmatch(re.sub("%[ud]", "[0-9]+", name).replace("%s", ".+"), pad) for name in names):
        return None
    return f"{factory} has no such {direction} pad; expected one of {', '.join(names) or '(none)'}"


def _readable(kind: str, value: str) -> bool:
    """Whether GStreamer parses a text as a property of that type; only parsing within a structure reports errors."""
    quoted = value.replace("\\", "\\\\").replace('"', '\\"')
    for written in (value, f'"{quoted}"'):
        try:
            Gst.Structure.from_string(f"x, value=({kind}){written}")
        except TypeError:
            continue
        return True
    return False


@cache
def _template(factory: str) -> Gst.Element | None:
    """An element of a factory, to inspect its properties; None: there is no such factory on this machine."""
    found = Gst.ElementFactory.find(factory)  # `make` raises on 1.28 where it returned None before
    return found and found.create(None)


def _factory_names(like: str) -> list[str]:
    """Likely correct names for a misspelt one; a list of all would have a thousand."""
    every = Gst.Registry.get().get_feature_list(Gst.ElementFactory)
    from difflib import get_close_matches

    near: list[str] = get_close_matches(like, [feature.get_name() for feature in every], 1)
    return near or ["a list of all: gst-inspect-1.0"]


def _shown(value: Value) -> str:
    return repr(value) if isinstance(value, str) else text(value)
