"""Which package provides an element, for those that this project and its packaged files name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from runner.core.model import Element
from runner.elements.description import Registry
from runner.graph import Plan

if TYPE_CHECKING:
    from runner.sound import SoundPlan
    from runner.voice import VoicePlan

PACKAGES = {  # elements by Debian package; `doctor` and messages on missing plugins name the package
    "gstreamer1.0-plugins-base": "videoconvert videoscale videorate videotestsrc decodebin appsrc appsink"
    " audioconvert audioresample audiotestsrc opusenc opusdec",
    "gstreamer1.0-plugins-good": "videocrop aspectratiocrop rtph264pay rtph264depay rtpjitterbuffer rtspsrc udpsrc"
    " rtph265pay rtph265depay udpsink v4l2src rtpbin rtpsession jpegdec capssetter qtdemux matroskademux matroskamux"
    " vp8enc vp8dec rtpvp8pay rtpvp8depay v4l2h264enc rtpopuspay rtpopusdepay level pulsesrc",
    "gstreamer1.0-plugins-bad": "h264parse h265parse mpegtsmux tsdemux openh264enc x265enc srtsrc srtsink bayer2rgb"
    " vah264enc nvh264enc vah265enc nvh265enc",
    "gstreamer1.0-plugins-ugly": "x264enc",
    "gstreamer1.0-libav": "avdec_h264 avdec_h265 avdec_ffv1 avenc_ffv1",
    "gstreamer1.0-rtsp": "rtspclientsink",
    "gstreamer1.0-x": "textoverlay",
    "gstreamer1.0-alsa": "alsasrc alsasink",
    "gstreamer1.0-pipewire": "pipewiresrc",
}
HARDWARE = {  # plugin by element that exists only with its hardware
    "vah264enc": "va",
    "vah265enc": "va",
    "nvh264enc": "nvcodec",
    "nvh265enc": "nvcodec",
    "v4l2h264enc": "video4linux2",
}
PACKAGE_OF = {element: package for package, elements in PACKAGES.items() for element in elements.split()}


def missing_plugins(
    registry: Registry, plan: Plan | SoundPlan | VoicePlan, sides: Sequence[str] = ("vehicle", "operator")
) -> list[str]:
    """One sentence for each known element that streaming needs on these sides and the registry lacks."""
    needed = {"vehicle": (*plan.source, *plan.vehicle), "operator": plan.operator}
    written: tuple[Element, ...] = plan.video_elements if isinstance(plan, Plan) else ()
    if isinstance(plan, Plan) and "vehicle" in sides:
        written += plan.lossless_elements
    elements = (*(element for side in sides for element in needed[side]), *written)
    return _missing(registry, elements, plan.needs)


def missing_recorders(registry: Registry, plan: Plan) -> list[str]:
    """The same for recording."""
    return _missing(registry, (*plan.source, *plan.recorder), plan.needs)


def why_missing(registry: Registry, name: str, packages: Mapping[str, str] = PACKAGE_OF) -> str:
    """The remedy for a known element that the registry lacks."""
    plugin = HARDWARE.get(name)
    if plugin and registry.has_plugin(plugin):
        where = f"in {registry.name}" if registry.name else "here"
        return (
            f"the GStreamer element {name} needs hardware and a driver that its plugin {plugin} does not find {where}"
        )
    lacks = f"not in {registry.name}" if registry.name else "not installed"
    return f"the GStreamer element {name} is {lacks}; on Debian: apt-get install {packages[name]}"


def _missing(registry: Registry, elements: Iterable[Element], named: Mapping[str, str]) -> list[str]:
    packages = {**PACKAGE_OF, **named}
    names = dict.fromkeys(element.factory for element in elements)
    return [why_missing(registry, name, packages) for name in names if name in packages and registry.find(name) is None]
