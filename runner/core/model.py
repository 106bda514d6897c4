"""The model: cameras, their rate-quality models, pipeline graphs, the vehicle. Frozen, valid once built.

Bitrates are kbit/s and exact (`Fraction` of the decimal text a user wrote), sizes are px, times are seconds.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from decimal import Decimal
from enum import StrEnum
from fractions import Fraction
from functools import lru_cache
from itertools import chain, pairwise
from math import inf, nextafter
from typing import Any, Protocol

from runner.core.capture import Capture
from runner.core.graph_settings import GraphSettings, KnobCommand, KnobTarget
from runner.core.hull import Curve
from runner.core.limits import Count
from runner.core.mounting import Place, Pose
from runner.errors import suggest

Kbps = Fraction
Value = bool | int | float | str  # type of an element's property in YAML

PLACEHOLDER = re.compile(r"\{(\w+)\}")  # in the properties of elements: "{clip}"
DEPTH_M = 20.0  # distance that is shown white, unless a source states another
SMALLEST_SIDE_PX = 16  # one H.264 macroblock; encoders refuse less
MOST_BUFFER_MS = 10_000  # of the encoder's rate control, as x264enc allows


class ModelError(ValueError):
    """A broken rule: the value found at `key` (a path below the object being built), and the rule.

    others  keys of further values that the rule is about
    """

    def __init__(self, key: str, found: object, rule: str, *others: str) -> None:
        super().__init__(f"{key}: {found}: {rule}")
        self.key, self.found, self.rule, self.others = key, found, rule, others


def exact(number: float | str | Fraction) -> Fraction:
    """The number as the user wrote it, without binary rounding: 0.1 is 1/10.

    A float prints as the shortest decimal text that parses to the same float: up to 15 digits, the text as typed.
    """
    if isinstance(number, float):
        return _exact(number)
    return Fraction(number) if isinstance(number, (int, Fraction)) else Fraction(Decimal(str(number)))


@lru_cache(maxsize=256)  # of the times of an event, which many rules read
def _exact(number: float) -> Fraction:
    return Fraction(Decimal(str(number)))


@lru_cache(maxsize=64)  # of the parameters of rules
def least_float(bound: Fraction) -> float:
    """The least float that is not below a bound. To compare floats with it is exact, and faster than with the bound."""
    nearest = float(bound)
    return nearest if nearest >= bound else nextafter(nearest, inf)


def plain(number: Fraction) -> int | float:
    """The same number for JSON and for display: whole numbers without a decimal point."""
    return number.numerator if number.denominator == 1 else float(number)


class ModeRule(Protocol):
    """A rule with its parameters, as a mode lists it, see `runner.core.rules`.

    key    of its memory: names of the rule and of its entry in the modes file
    reads  fields of the state whose change triggers a new decision
    gives  parts of the draft that exist after it
    """

    @property
    def name(self) -> str: ...
    @property
    def key(self) -> tuple[str, str]: ...
    @property
    def reads(self) -> frozenset[str]: ...
    @property
    def gives(self) -> frozenset[str]: ...
    def __call__(self, vehicle: Vehicle, state: Any, draft: Any, memory: Mapping[str, Any], /) -> Any: ...


class Mode(StrEnum):
    """Video rate control mode (paper, section II)."""

    SINGLE = "single"
    AUTOMATIC = "automatic"
    COLLECTIVE = "collective"


@dataclass(frozen=True, slots=True)
class Roi:
    """Region of interest, px of the camera's full (cropped) image.

    x, y           its left and upper edge, from those of the image
    width, height  its size
    """

    x: Count
    y: Count
    width: Count
    height: Count

    @property
    def pixels(self) -> int:
        return self.width * self.height

    def to_json(self) -> dict[str, int]:
        return {"x": self.x, "y": self.y, "width": self.width, "height": self.height}


@dataclass(frozen=True, slots=True)
class RateQuality:
    """Quality at a rate of pictures, of 1, in points (kbit/s, quality).

    delivered  of a picture that is sent, compared with itself: what counts while the scene stands
    held       of what a screen shows at each picture of the source, without latency: what counts while it moves
    """

    delivered: tuple[tuple[float, float], ...]
    held: tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class RateQualityModel:
    """Scaling factor that looks best in each bitrate range (paper, Eq. 3 and Table I).

    scaling  R factors in ]0, 1], increasing
    b_min    R lower bounds in kbit/s, increasing from 0
    b_full   kbit/s for the full image: the end of the last range and the camera's share in the allocation
    quality  of the full image over its bitrate with the best of these factors; None: not measured
    shown    by factor of the image's size at which a screen shows it, the model of what is seen there; ascending
    rates    by Hz, what fewer pictures a second look like at the same bitrate; none: not measured
    raises   ModelError

    Derived: `whole_b_min`, the bounds as integers if all are whole, otherwise empty; `ranges`, each range B_r and its
    factor as text: "range [300, 950) -> 0.25", "range [950, ...) -> 0.5".
    """

    scaling: tuple[Fraction, ...]
    b_min: tuple[Kbps, ...]
    b_full: Kbps
    quality: Curve | None = None
    shown: Mapping[Fraction, RateQualityModel] = field(default_factory=dict)
    rates: Mapping[Fraction, RateQuality] = field(default_factory=dict)
    whole_b_min: tuple[int, ...] = field(init=False, repr=False)
    ranges: tuple[str, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        bounds = [plain(b) for b in self.b_min]
        factors = [plain(s) for s in self.scaling]
        if not factors:
            raise ModelError("scaling", factors, "must have at least one factor")
        if len(factors) != len(bounds):
            rule = f"must have {len(factors)} entries, one per scaling factor"
            raise ModelError("b_min_kbps", bounds, rule, "scaling")
        if any(a >= b for a, b in pairwise(factors)):
            raise ModelError("scaling", factors, "must be strictly increasing")
        if factors[0] <= 0 or factors[-1] > 1:
            raise ModelError("scaling", factors, "must lie in ]0, 1]")
        if bounds[0] != 0 or any(a >= b for a, b in pairwise(bounds)):
            raise ModelError("b_min_kbps", bounds, "must start at 0 and be strictly increasing")
        if self.b_full <= self.b_min[-1]:
            rule = f"must be above the last b_min, {bounds[-1]}"
            raise ModelError("b_full_kbps", plain(self.b_full), rule, "b_min_kbps")
        whole = tuple(bound for bound in bounds if isinstance(bound, int))
        object.__setattr__(self, "whole_b_min", whole if len(whole) == len(bounds) else ())
        ends = [*bounds[1:], "..."]
        texts = (f"range [{a}, {b}) -> {s}" for a, b, s in zip(bounds, ends, factors, strict=True))
        object.__setattr__(self, "ranges", tuple(texts))

    @staticmethod
    def rates_of(data: Iterable[Mapping[str, Any]]) -> Mapping[Fraction, RateQuality]:
        """From a camera's `rate_quality.rates`."""
        points = {exact(its["fps"]): [tuple(map(tuple, its[key])) for key in ("delivered", "held")] for its in data}
        return {fps: RateQuality(*both) for fps, both in points.items()}

    def at(self, scale: Fraction) -> tuple[Fraction, RateQualityModel]:
        """The measured factor of the image's size that is nearest to that of a screen, and its model; 1: this one."""
        nearest = min((Fraction(1), *self.shown), key=lambda factor: max(factor / scale, scale / factor))
        return nearest, self.shown.get(nearest, self)


@dataclass(frozen=True, slots=True)
class Element:
    """One GStreamer element of a graph. A property value may hold {placeholders}, filled per camera by `graph.py`.

    sink, src  the pads to its neighbours, where GStreamer could not choose them; "": it chooses
    """

    name: str
    factory: str
    properties: Mapping[str, Value]
    sink: str = ""
    src: str = ""


@dataclass(frozen=True, slots=True)
class Graph:
    """A camera's pipeline on both sides as defined in YAML.

    transport     rtsp: a server on the vehicle, the operator's first element is its client;
                  pipeline: the vehicle's last element sends, the operator's first one receives
    wire          what `print` shows in place of server and client, since gst-launch has neither (rtsp only)
    placeholders  what its file states by name (mtu_bytes, jitter_buffer_ms, ...): properties refer to it as {name}
    mutable       (element, property) that knobs set although GStreamer does not declare it mutable while playing
    verified      False: only checked against its schema, never run by this project's tests
    passes        format of the pictures that it passes on as the source encodes them, h264 or h265; None: it encodes
    command       sets the bitrate of a camera whose pictures it passes on; None: knobs do, if there are some
    key_frame     how to request a key frame after unrecovered packet loss: "event", GStreamer's own; "caps", a pixel
                  aspect ratio that differs imperceptibly, for an encoder that ignores the event; None: not at all
    needs         by element that only the vehicle may have, the Debian package that provides it
    places        whether each encoded picture says which part of the full image it shows, see `runner.h264.region`
    """

    transport: str
    vehicle: tuple[Element, ...]
    operator: tuple[Element, ...]
    wire_vehicle: tuple[Element, ...]
    wire_operator: tuple[Element, ...]
    knobs: Mapping[str, tuple[KnobTarget, ...]]
    settings: GraphSettings
    placeholders: Mapping[str, Value]
    mutable: tuple[tuple[str, str], ...] = ()
    verified: bool = True
    passes: str | None = None
    command: KnobCommand | None = None
    key_frame: str | None = None
    needs: Mapping[str, str] = field(default_factory=dict)
    places: bool = False

    def __post_init__(self) -> None:
        names = [element.name for element in (*self.vehicle, *self.wire_vehicle)]
        for side, elements in (("vehicle", self.vehicle), ("operator", self.operator)):
            check_unique(side, [element.name for element in elements])
        if self.transport == "rtsp" and self.vehicle[-1].name != "pay0":
            rule = "the last element must be named pay0, as the RTSP server requires"
            last = f"vehicle[{len(self.vehicle) - 1}].name"
            raise ModelError("vehicle", repr(self.vehicle[-1].name), rule, last, "transport")
        for knob, targets in self.knobs.items():
            for index, target in enumerate(targets):
                if target.element not in names and not self.passes:  # else it may be one of the source
                    rule = f"no such element{suggest(target.element, names)}"
                    known = (f"vehicle[{place}].name" for place in range(len(self.vehicle)))
                    raise ModelError(f"knobs.{knob}[{index}].element", repr(target.element), rule, *known)
        if self.key_frame == "caps" and [target.property for target in self.knobs["size"]] != ["caps"]:
            raise ModelError(
                "key_frame", "'caps'", "needs a knob `size` that sets the caps of one element", "knobs.size"
            )
        turned = {(target.element, target.property) for targets in self.knobs.values() for target in targets}
        for index, pair in enumerate(self.mutable):
            if pair not in turned:
                raise ModelError(f"mutable[{index}]", repr(".".join(pair)), "no knob sets this property", "knobs")
        if self.command and not self.passes:
            rule = "a command sets the bitrate of pictures that are passed on, others are encoded here"
            raise ModelError("knobs.bitrate", None, rule, "passes")

    @property
    def sets_bitrate(self) -> bool:
        """Whether the bitrate of its pictures can be set, here or in the camera."""
        return bool(self.command or self.knobs.get("bitrate"))


def check_unique(key: str, names: list[str]) -> None:
    """raises ModelError if two elements of a list have the same name"""
    for index, name in enumerate(names):
        if name in names[:index]:
            rule = "is already the name of another element"
            raise ModelError(f"{key}[{index}].name", repr(name), rule, f"{key}[{names.index(name)}].name")


@dataclass(frozen=True, slots=True)
class Source:
    """Where a camera's frames come from: elements with {placeholders} for the mount's device, address, clip and size.

    encoded     by format, elements up to pictures as the origin encodes them, for graphs that pass these on
    settings    values for cameras that name none: clip, device, address, bag, topic
    capture     format requested from its cameras unless they state another, see `Capture`
    credentials file with user name and password, for cameras that name none
    medium      which of the video media that an IP camera offers, counted from 0
    first_reply_s  how long it may take for each answer until it streams
    loop        restart at the end without a gap (a clip, a bag)
    frozen_s    without a frame for so long, and 10 frame intervals, a playing source is replaced; None: not monitored
    repeated_s  the same picture for this long is a fault; None: pictures are not compared
    render      name of the procedural drive that makes the clip, or ""
    render_s    length of that drive, s
    plays_bags  frames are the pictures of a topic of a bag, which are pushed into its first element
    subscribes  the same for a ROS topic
    depth_m     distance that is shown white in pictures of distances, m, in both
    stand_in    elements that `print` shows if gst-launch cannot produce the frames (from Python, or not yet rendered)
    needs       by element that only the vehicle may have, the Debian package that provides it
    """

    elements: tuple[Element, ...]
    encoded: Mapping[str, tuple[Element, ...]] = field(default_factory=dict)
    settings: Mapping[str, Value] = field(default_factory=dict)
    capture: Mapping[str, Any] = field(default_factory=dict)
    credentials: str | None = None
    medium: int = 0
    first_reply_s: float = 30.0
    loop: bool = False
    frozen_s: float | None = None
    repeated_s: float | None = None
    render: str = ""
    render_s: float = 0
    plays_bags: bool = False
    subscribes: bool = False
    depth_m: float = DEPTH_M
    stand_in: tuple[Element, ...] = ()
    needs: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if (self.plays_bags or self.subscribes) and self.elements[0].factory != "appsrc":
            of = "a bag" if self.plays_bags else "a topic"
            rule = f"must be appsrc: the pictures of {of} are pushed into the first element"
            raise ModelError("elements[0].element", repr(self.elements[0].factory), rule, "bag", "ros")

    @property
    def placeholders(self) -> frozenset[str]:
        """Names of the placeholders in its elements."""
        every = (*self.elements, *chain(*self.encoded.values()))
        values = (value for element in every for value in element.properties.values())
        return frozenset(name for value in values if isinstance(value, str) for name in PLACEHOLDER.findall(value))


@dataclass(frozen=True, slots=True)
class BagTopic:
    """Pictures of a bag: the path of the bag, and their topic.

    depth_m  distance that is shown white in pictures of distances, m
    """

    path: str
    topic: str
    depth_m: float = DEPTH_M


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A camera mounted in a vehicle.

    width, height   px of the full image, after the crop of the native one
    native          px size of the source's image, of which `crop` is kept; None: it is the full image
    weight          explicit weight in the allocation, >= 0
    floor_kbps      kbit/s that the camera gets first if the mode's rules have floors; 0: none
    shed            order in which cameras are given up, lowest first, if all floors together exceed the total;
                    None: never
    mount           device, address, clip: values of the placeholders of these names; bag and topic to play, or topic
                    to subscribe to
    capture         format requested from its device
    credentials     file with user name and password for its address; None: not required
    framing         in the page's Drive view. fit: the whole picture is shown; fill: it fills its box; None: by place
    calibrated      whether pose, fov_deg and lens were measured, not estimated
    redundant       whether every uplink carries it
    always          region that is sent even if nobody looks; None: the central half in each direction
    least_scaling   factor below which no screen that shows little lowers the picture; None: the smallest of its factors
    """

    name: str
    width: int
    height: int
    fps: Fraction
    rate_quality: RateQualityModel
    graph: Graph
    source: Source
    weight: Fraction = Fraction(1)
    floor_kbps: Kbps = Fraction(0)
    shed: int | None = None
    native: tuple[int, int] | None = None
    crop: Roi | None = None
    mount: Mapping[str, Value] = field(default_factory=dict)
    capture: Capture = field(default_factory=Capture)
    credentials: str | None = None
    place: Place | None = None
    pose: Pose | None = None
    fov_deg: float = 90.0
    lens: str = "pinhole"
    framing: str | None = None
    calibrated: bool = False
    redundant: bool = False
    always: Roi | None = None
    least_scaling: Fraction | None = None
    full_roi: Roi = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "full_roi", Roi(0, 0, self.width, self.height))
        if self.native and self.crop:
            width, height = self.native
            if self.crop.x + self.crop.width > width or self.crop.y + self.crop.height > height:
                found = f"{self.crop.width}x{self.crop.height} at {self.crop.x},{self.crop.y}"
                rule = f"must lie inside the native {width}x{height}"
                side = "width_px" if self.crop.x + self.crop.width > width else "height_px"
                raise ModelError("native", found, rule, side)
        if (kept := self.always) and (kept.x + kept.width > self.width or kept.y + kept.height > self.height):
            found = f"{kept.width}x{kept.height} at {kept.x},{kept.y}"
            raise ModelError("always", found, f"must lie inside the image of {self.width}x{self.height}", "width_px")
        least, most = self.graph.settings.lowest_kbps, self.rate_quality.b_full
        if self.graph.passes and least > most:
            rule = f"must be at most the b_full_kbps of the camera, {plain(most)}"
            raise ModelError("graph.lowest_kbps", least, rule, "b_full_kbps")
        frames = self.graph.settings.vbv_frames or 0.0
        if 1000 * frames > MOST_BUFFER_MS * self.fps:
            rule = f"with vbv_frames {frames:g} of its graph it must be at least {1000 * frames / MOST_BUFFER_MS:g}"
            raise ModelError("fps", plain(self.fps), rule, "graph.vbv_frames", "fps_max")

    @property
    def source_size(self) -> tuple[int, int]:
        return self.native or (self.width, self.height)

    @property
    def in_source(self) -> Roi:
        """The full image within the source's image."""
        return self.crop or self.full_roi

    @property
    def kept_roi(self) -> Roi:
        """The region that is sent even if nobody looks."""
        return self.always or Roi(self.width // 4, self.height // 4, -(-self.width // 2), -(-self.height // 2))

    @property
    def address(self) -> str | None:
        """The address of its IP camera; None if it is none, or no address is configured."""
        address = self.mount.get("address", self.source.settings.get("address"))
        return str(address) if "address" in self.source.placeholders and address else None

    @property
    def device(self) -> str | None:
        """The device file that its source opens; None if it opens none, or none is configured."""
        device = self.mount.get("device", self.source.settings.get("device"))
        return str(device) if "device" in self.source.placeholders and device is not None else None

    @property
    def topic(self) -> str | None:
        """The ROS topic that its source subscribes to; None if it does not, or none is configured."""
        topic = self.mount.get("topic", self.source.settings.get("topic"))
        return str(topic) if self.source.subscribes and topic else None


@dataclass(frozen=True, slots=True, eq=False)
class Vehicle:
    """What the rules know of a vehicle, valid once built.

    mode     at the start
    modes    the rules of each mode, in order
    uplinks  by name, kbit/s that are left to other traffic; empty: there is one, without a name
    sound    kbit/s on the wire of one copy of its sound; 0: none
    fixed    cameras whose pictures are sent as their sources encode them, whatever the rules would choose
    lowest   those that also encode by themselves, but at a bitrate that can be set: kbit/s, the least of each
    """

    name: str
    cameras: Mapping[str, Camera]
    mode: Mode
    modes: Mapping[Mode, tuple[ModeRule, ...]]
    uplinks: Mapping[str, Kbps] = field(default_factory=dict)
    sound: Kbps = Fraction(0)
    fixed: frozenset[str] = field(init=False)
    lowest: Mapping[str, Kbps] = field(init=False)

    def __post_init__(self) -> None:
        passed = {name: each.graph for name, each in self.cameras.items() if each.graph.passes}
        lowest = {name: Kbps(each.settings.lowest_kbps) for name, each in passed.items() if each.sets_bitrate}
        object.__setattr__(self, "fixed", frozenset(passed.keys() - lowest.keys()))
        object.__setattr__(self, "lowest", lowest)


Progress = Callable[[str, float], None]  # current step, share done in [0, 1]
