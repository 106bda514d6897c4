"""This machine's GStreamer registry, as checks of plans ask it."""

from __future__ import annotations

import platform
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import date
from functools import cache, partial
from typing import TYPE_CHECKING

from gi.repository import GLib, GObject, Gst

from runner.core.model import Element
from runner.elements import check, packages
from runner.elements.description import SINK, SRC, Factory, Pad, Property, Registry
from runner.errors import RunError
from runner.graph import Plan, launch
from runner.gst.caps import structure
from runner.gst.enums import enum_values

if TYPE_CHECKING:
    from runner.elements.dump import Dump
    from runner.sound import SoundPlan
    from runner.voice import VoicePlan


class LiveRegistry(Registry):
    """The registry of this machine. A plugin is loaded once the properties of one of its elements are asked for."""

    def names(self) -> Iterable[str]:
        return [factory.get_name() for factory in Gst.Registry.get().get_feature_list(Gst.ElementFactory)]

    def has_plugin(self, name: str) -> bool:
        return Gst.Registry.get().find_plugin(name) is not None

    def find(self, element: str) -> Factory | None:
        # Asked each time, as elements may come and go. `make` would raise on 1.28 where it returned None before.
        return _factory(element) if Gst.ElementFactory.find(element) else None

    def properties(self, element: str) -> Mapping[str, Property]:
        return _properties(element)

    def alike(self, klass: str) -> Iterable[str]:
        every = Gst.Registry.get().get_feature_list(Gst.ElementFactory)
        found = [each for each in every if each.get_metadata("klass") == klass and each.get_rank()]
        return [each.get_name() for each in sorted(found, key=lambda each: (-each.get_rank(), each.get_name()))]

    def reads(self, type_name: str, text: str) -> bool:
        quoted = text.replace("\\", "\\\\").replace('"', '\\"')
        for written in (text, f'"{quoted}"'):
            # Only parsing within a structure reports errors.
            with suppress(TypeError):
                Gst.Structure.from_string(f"x, value=({type_name}){written}")
                return True
        return False

    def link_problem(self, elements: Sequence[Element]) -> str | None:
        return _unlinkable(launch(elements))

    def dump(self) -> Dump:
        """All of it, to be kept in a file. Loads every plugin; what does not load is left out."""
        from runner.elements.dump import Described, Dump

        found = {name: self.find(name) for name in self.names() if Gst.ElementFactory.find(name).load()}
        return Dump(
            gstreamer=_version(),
            date=date.today().isoformat(),
            system=platform.freedesktop_os_release().get("PRETTY_NAME", platform.system()),
            machine=platform.machine(),
            plugins={plugin.get_name(): plugin.get_version() for plugin in Gst.Registry.get().get_plugin_list()},
            elements={name: Described(each, self.properties(name)) for name, each in found.items() if each},
        )


LIVE = LiveRegistry()
check_plan = partial(check.check_plan, LIVE)
check_vehicle = partial(check.check_plan, LIVE, parts=("vehicle",))  # for the side that runs only that
check_operator = partial(check.check_plan, LIVE, parts=("operator",))
missing_plugins = partial(packages.missing_plugins, LIVE)
why_missing = partial(packages.why_missing, LIVE)


def require_plugins(plans: Iterable[Plan | SoundPlan | VoicePlan], sides: Sequence[str]) -> None:
    """Check that every plugin that streaming needs on these sides is installed.

    raises  RunError with the packages to install, for all cameras at once
    """
    _require(sentence for plan in plans for sentence in missing_plugins(plan, sides))


def check_recorders(plans: Iterable[Plan]) -> None:
    """The same for recording."""
    _require(sentence for plan in plans for sentence in packages.missing_recorders(LIVE, plan))


def _require(missing: Iterable[str]) -> None:
    if found := dict.fromkeys(missing):
        raise RunError("\n".join(found))


def versions(elements: Iterable[Element]) -> dict[str, str]:
    """GStreamer's version, and by element the version of its plugin."""
    found = {"GStreamer": _version()}
    for element in elements:
        factory = Gst.ElementFactory.find(element.factory)
        if factory:
            plugin = factory.get_plugin()
            found[element.factory] = f"{plugin.get_package()}, {plugin.get_version()}"
    return found


def _version() -> str:
    return ".".join(map(str, Gst.version()[:3]))


@cache
def _unlinkable(line: str) -> str | None:
    """GStreamer's message if neighbours in a line cannot be linked, otherwise None."""
    try:
        Gst.parse_launch(line)
    except GLib.Error as error:
        return str(error.message)
    return None


@cache
def _factory(element: str) -> Factory:
    found = Gst.ElementFactory.find(element)
    pads = sorted((_pad(template) for template in found.get_static_pad_templates()), key=lambda pad: pad.name)
    return Factory(found.get_metadata("klass"), found.get_rank(), found.get_plugin_name(), tuple(pads))


def _pad(template: Gst.StaticPadTemplate) -> Pad:
    caps = template.get_caps()
    names = (structure(caps, place).get_name() for place in range(caps.get_size()))
    media = None if caps.is_any() else tuple(dict.fromkeys(names))
    return Pad(template.name_template, SINK if template.direction == Gst.PadDirection.SINK else SRC, media)


@cache
def _properties(element: str) -> Mapping[str, Property]:
    """The properties of an element, from its class: no element is made.

    raises  RunError if its plugin does not load
    """
    loaded = Gst.ElementFactory.find(element).load()
    if loaded is None:
        raise RunError(f"the plugin of the GStreamer element {element} does not load")
    return {spec.name: _property(spec) for spec in GObject.list_properties(loaded.get_element_type())}


def _property(spec: GObject.ParamSpec) -> Property:
    values, flags = enum_values(spec.value_type), int(spec.flags)
    return Property(
        type=spec.value_type.name,
        least=getattr(spec, "minimum", None),
        most=getattr(spec, "maximum", None),
        enum=values if spec.value_type.is_a(GObject.TYPE_ENUM) else (),
        flags=values if spec.value_type.is_a(GObject.TYPE_FLAGS) else (),
        writable=bool(flags & GObject.ParamFlags.WRITABLE),
        playing=bool(flags & Gst.PARAM_MUTABLE_PLAYING),
    )
