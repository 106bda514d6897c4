"""Compile a sequence and a camera's graph into one GStreamer line with many encoders. Pure text.

Each lane is the live line of both sides with the wire cut out: the vehicle's elements from the crop to the
payloader, followed directly by the operator's elements up to the decoder.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

from runner.core.commands import KnobValue
from runner.core.model import BagTopic, Element, ModelError, Roi
from runner.core.scaling import output_size
from runner.graph import Plan, launch
from runner.turning import turn_elements

BAG = "bag"  # the appsrc of a sequence that is a topic of a bag
LEFT_OUT = "left-out-"  # begins the names of elements that leave out pictures
FRAMES = "frames"  # the tee that passes every frame of the sequence
QUEUE = "queue max-size-buffers=3 max-size-bytes=0 max-size-time=0"
SINK = "videoconvert ! video/x-raw,format=I420 ! appsink name={} emit-signals=true sync=false async=false max-buffers=2"


@dataclass(frozen=True, slots=True)
class Lane:
    """One encoding: a scaling factor and a target bitrate; every nth picture is encoded."""

    scaling: Fraction
    kbps: int
    nth: int = 1


@dataclass(frozen=True, slots=True)
class LaneNames:
    """Names of a lane's elements in the line."""

    encoder: str
    counter: str
    sink: str


@dataclass(frozen=True, slots=True)
class LaneSet:
    """A line to run and the elements to watch in it.

    bag  pictures that are pushed into its element `BAG`; None: it has none
    """

    line: str
    fps: Fraction
    lanes: tuple[LaneNames, ...]
    bag: BagTopic | None = None


def compile_lanes(plan: Plan, decode: str, roi: Roi, lanes: Sequence[Lane], bag: BagTopic | None = None) -> LaneSet:
    """One line for several lanes of a camera.

    plan    the camera at the size and rate of the sequence
    decode  the line that decodes the sequence to I420 frames
    bag     the pictures of the sequence, if they are a topic of a bag
    roi     part of the full image that is encoded
    raises  ModelError if the graph's bitrate knob names no element that frames pass through
    """
    before, after = cut(plan)
    shares = sorted({(lane.scaling, lane.nth) for lane in lanes})
    parts = [f"{decode} ! tee name={FRAMES}"]
    for i, (factor, nth) in enumerate(shares):
        shared = _turned(plan, before, {"roi": roi, "size": output_size(roi, factor)}, f"_{i}")
        line = " ! ".join((QUEUE, *_dropping(plan, nth, i), launch(shared)))
        parts.append(f"{FRAMES}. ! {line} ! tee name=scaled_{i}" if shared else "")
    names = []
    for j, lane in enumerate(lanes):
        own = _turned(plan, after, {"bitrate": lane.kbps}, f"_lane{j}", lane.nth)
        scaled = f"scaled_{shares.index((lane.scaling, lane.nth))}."
        parts.append(f"{scaled} ! {QUEUE} ! {launch(own)} ! {SINK.format(f'sink_{j}')}")
        names.append(LaneNames(f"{encoder(plan)}_lane{j}", f"{_counter(plan)}_lane{j}", f"sink_{j}"))
    return LaneSet(" ".join(parts), plan.camera.fps, tuple(names), bag)


def fragment(plan: Plan, roi: Roi, lane: Lane) -> str:
    """The elements that produce a lane's pictures, as text: any change of graph or settings changes it."""
    before, after = cut(plan)
    knobs: dict[str, KnobValue] = {"roi": roi, "size": output_size(roi, lane.scaling), "bitrate": lane.kbps}
    return " ! ".join(
        (*_dropping(plan, lane.nth), launch(turn_elements(plan.camera, (*before, *after), knobs, lane.nth)))
    )


def _dropping(plan: Plan, nth: int, number: int = 0) -> tuple[str, ...]:
    """Leaves out all but each n-th picture, as the knob `fps` does while driving: behind it the caps stay."""
    if nth == 1:
        return ()
    rates = (plan.camera.fps, plan.camera.fps / nth)
    own, slow = (f"video/x-raw,framerate={fps.numerator}/{fps.denominator}" for fps in rates)
    return (f"videorate name={LEFT_OUT}{number} drop-only=true skip-to-first=true", slow, f"capssetter caps={own}")


def cut(plan: Plan) -> tuple[tuple[Element, ...], tuple[Element, ...]]:
    """The live line without its wire, divided at the encoder, which begins the second part."""
    vehicle = plan.vehicle if plan.serves else plan.vehicle[:-1]
    at = next(i for i, element in enumerate(vehicle) if element.name == encoder(plan))
    operator = plan.operator[1:-1]
    taken = {element.name for element in vehicle}
    named = tuple(replace(e, name=f"{e.name}_received") if e.name in taken else e for e in operator)
    return vehicle[:at], (*vehicle[at:], *named)


def encoder(plan: Plan) -> str:
    """Name of the element whose bitrate is set."""
    names = [target.element for target in plan.camera.graph.knobs.get("bitrate", ())]
    for element in plan.vehicle:
        if element.name in names:
            return element.name
    raise ModelError("graph.knobs.bitrate", repr(names), "must set an element that frames pass")


def _counter(plan: Plan) -> str:
    """The identity that counts encoded bytes: the one after the encoder, otherwise the operator's."""
    return "sent" if any(element.name == "sent" for element in plan.vehicle) else "received"


def _turned(
    plan: Plan, elements: Iterable[Element], knobs: Mapping[str, KnobValue], suffix: str, nth: int = 1
) -> tuple[Element, ...]:
    turned = turn_elements(plan.camera, elements, knobs, nth)
    return tuple(replace(element, name=element.name + suffix) for element in turned)
