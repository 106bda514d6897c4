"""A drive that anyone can repeat: its length, runs and link; the `experiment` and `link` sections."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from runner.core.events import ClockAdvanced, Event
from runner.core.model import Kbps, ModelError, exact
from runner.errors import suggest
from runner.pqos import Pqos, build_pqos, build_track, trace
from runner.pqos.settings import find_file, within
from runner.schema import event_problem

if TYPE_CHECKING:  # a side that drives loads no evaluation tool
    from runner.link.limit import Cut, Limit, OneWay, Policing, TcpFlows
    from runner.pqos.track import Track

RateAtTime = Callable[[float], Kbps]  # rate in force at a time of the drive (s), kbit/s
STEP_S = 0.1  # interval at which the rate of a link follows a map


class TimedRequest(NamedTuple):
    """A request of the operator, `at_s` after it sees the vehicle online: an event in JSON without its time."""

    at_s: float
    event: Mapping[str, Any]


@dataclass(frozen=True)
class Experiment:
    """The drive of the demo.

    about       its purpose, in a sentence, or ""
    duration_s  length of each drive, s
    claims      name of a publication's claims about such a drive, or ""
    runs        by name, the overrides that each of several drives adds; empty: one drive
    requests    in the order of their times
    """

    about: str = ""
    duration_s: float = 60
    claims: str = ""
    runs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    requests: tuple[TimedRequest, ...] = ()


@dataclass(frozen=True)
class LinkSettings:
    """A link of limited rate between the two sides: its kind, netns or relay, and how it limits packets.

    limit  that of the first lane, if it has lanes
    lanes  by name of the vehicle's device; empty: it has none
    """

    kind: str
    limit: Limit
    lanes: Mapping[str, Limit] = field(default_factory=dict)


def read_experiment(data: Mapping[str, Any]) -> Experiment:
    """The `experiment` section. raises ModelError with the key, the value found and the rule"""
    runs = {name: tuple(words) for name, words in (data.get("runs") or {}).items()}
    requests = [_request(*numbered) for numbered in enumerate(data.get("requests") or ())]
    in_order = tuple(sorted(requests, key=lambda request: request.at_s))
    return Experiment(data["about"], float(data["duration_s"]), data.get("claims") or "", runs, in_order)


def _request(index: int, data: Mapping[str, Any]) -> TimedRequest:
    event = dict(data["request"])
    if "t" in event:
        raise ModelError(f"requests[{index}].request.t", event["t"], "must not be given: at_s is the time")
    if problem := event_problem({"t": 0, **event}):
        raise ModelError(f"requests[{index}].request", event, problem)
    return TimedRequest(float(data["at_s"]), event)


def read_link(
    data: Mapping[str, Any], predicted: RateAtTime, bases: Sequence[Path], by_lane: Mapping[str, RateAtTime]
) -> LinkSettings:
    """The link that the `link` section describes.

    predicted  rates to follow if it names no file, see `true_rates`
    by_lane    likewise, for lanes of uplinks that have predictions of their own
    bases      directories in which a relative file is looked up
    raises     ModelError with the key, the value found and the rule
    """
    lanes = {}
    for name, own in (data.get("lanes") or {}).items():
        with within(f"lanes.{name}"):
            lanes[name] = _limit({**data, **_alone(own)}, by_lane.get(name, predicted), bases, _cuts(data, name))
    limit = next(iter(lanes.values())) if lanes else _limit(data, predicted, bases, ())
    return LinkSettings(data["kind"], limit, lanes)


def _alone(own: Mapping[str, Any]) -> Mapping[str, Any]:
    """What a lane states, with its rate alone: the link may state one in another form."""
    return {"file": None, "kbps": None, **own} if own.get("file") or own.get("kbps") else own


def _cuts(data: Mapping[str, Any], lane: str) -> tuple[Cut, ...]:
    from runner.link.limit import Cut

    cuts = [cut for cut in data.get("cuts") or () if cut["lane"] == lane]
    return tuple(Cut(float(cut["at_s"]), float(cut.get("for_s", 0)), cut["how"]) for cut in cuts)


def lane_of(document: Mapping[str, Any], uplink: str) -> str | None:
    """The lane that an uplink sends by: its interface, or for a relay its address; None: it uses none."""
    from runner.link.relayed import lane_addresses

    link, way = document["link"], document["uplinks"][uplink]
    lanes = link.get("lanes") or {}
    if link["kind"] == "relay" and "address" in way:
        return next((lane for lane, at in lane_addresses(lanes).items() if at == way["address"]), None)
    return way["interface"] if way.get("interface") in lanes else None


def lane_overrides(document: Mapping[str, Any]) -> tuple[str, ...]:
    """Overrides of the vehicle for a relay, whose lanes are addresses and no devices."""
    from runner.link.relayed import lane_addresses

    if document["link"]["kind"] != "relay":
        return ()
    addresses = lane_addresses(document["link"].get("lanes") or {})
    ways = {name: addresses.get(way.get("interface")) for name, way in document["uplinks"].items()}
    words = ((f"~uplinks.{name}.interface", f"+uplinks.{name}.address={at}") for name, at in ways.items() if at)
    return tuple(word for each in words for word in each)


def unreachable_uplinks(document: Mapping[str, Any]) -> Iterator[ModelError]:
    """Uplinks that would not use a lane of the limited link."""
    from runner.link.netns import LINK
    from runner.link.relayed import lane_addresses

    link = document["link"]
    lanes, is_relay = link.get("lanes") or {}, link["kind"] == "relay"
    by_name = f"no such lane: link.lanes has {', '.join(lanes)}" if lanes else "no such lane: link.lanes is null"
    by_address = f"no such lane: {', '.join(f'{at} is {lane}' for lane, at in lane_addresses(lanes).items())}"
    for name, way in (document.get("uplinks") or {}).items():
        if "address" in way and not is_relay:
            rule = "must not be given: link=netns takes new addresses for each drive; interface names the lane"
            yield ModelError(f"{name}.address", way["address"], rule)
        elif lane_of(document, name) is None and (lanes or way.get("interface", LINK) != LINK):
            key = "address" if "address" in way else "interface"
            yield ModelError(f"{name}.{key}", way[key], by_address if key == "address" else by_name)


def lane_problems(data: Mapping[str, Any]) -> Iterator[ModelError]:
    """What the schema does not see in the lanes of a `link` section and in their cuts."""
    from runner.link.limit import MOST_ADDRESSES

    lanes, cuts = data.get("lanes") or {}, data.get("cuts") or ()
    needed = len(lanes) + sum(cut["how"] == "address" for cut in cuts)
    if needed > MOST_ADDRESSES:
        rule = f"need {needed} addresses, one each and one for each change: must be at most {MOST_ADDRESSES}"
        yield ModelError("lanes", ", ".join(lanes), rule)
    for index, cut in enumerate(cuts):
        if cut["lane"] not in lanes:
            hint = suggest(cut["lane"], lanes) if lanes else ": link.lanes names none"
            yield ModelError(f"cuts[{index}].lane", cut["lane"], f"unknown lane{hint}")
        if data["kind"] == "relay" and cut["how"] not in ("silence", "hold"):
            rule = "must be silence or hold: link=relay has no devices; choose link=netns"
            yield ModelError(f"cuts[{index}].how", cut["how"], rule, "kind")
        if cut["how"] == "address" and "for_s" in cut:
            yield ModelError(f"cuts[{index}].for_s", cut["for_s"], "must not be given: the address changes for good")
        if cut["how"] != "address" and "for_s" not in cut:
            yield ModelError(f"cuts[{index}].for_s", None, "must be given: how long it lasts, s")
    for (first, one), (second, other) in combinations(enumerate(cuts), 2):
        if one["lane"] == other["lane"] and _overlap(one, other):
            rule = f"must not overlap cuts[{first}] of the same lane, {_span(one)}"
            yield ModelError(f"cuts[{second}]", _span(other), rule)


def _overlap(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two cuts share some time; the moment of a new address may be within another cut."""
    if "address" in (one["how"], other["how"]):
        return False
    ends = [cut["at_s"] + cut.get("for_s", 0) for cut in (one, other)]
    return bool(max(one["at_s"], other["at_s"]) < min(ends))


def _span(cut: Mapping[str, Any]) -> str:
    return f"from {cut['at_s']:g} to {cut['at_s'] + cut['for_s']:g} s"


def _limit(data: Mapping[str, Any], predicted: RateAtTime, bases: Sequence[Path], cuts: tuple[Cut, ...]) -> Limit:
    from runner.link.limit import Limit

    rates, share = _rates(data, predicted, bases), float(data["share"])

    def kbps_at(t: float) -> float:
        return share * float(rates(t))

    back = data.get("reverse")
    reverse = _reverse(back, data["loop"], bases) if back else None
    tcp = _tcp(data["tcp"]) if data.get("tcp") else None
    delay_at = _delays(data, data["loop"], bases)
    policer = _policer(data["policer"]) if data.get("policer") else None
    return Limit(kbps_at, **_path(data), delay_at=delay_at, policer=policer, reverse=reverse, tcp=tcp, cuts=cuts)


def _rates(data: Mapping[str, Any], predicted: RateAtTime, bases: Sequence[Path]) -> RateAtTime:
    """The rate of the link, or of a lane: a file's, constant, or else the predicted one."""
    kbps, file = data.get("kbps"), data["file"]
    if kbps and file:
        raise ModelError("kbps", kbps, "must not be given beside file", "file")
    if kbps:
        constant = exact(kbps)
        return lambda _: constant
    if predicted is no_rates and not file:
        raise ModelError("file", None, "must be given: live predictions give no rate for the link to follow")
    return _recorded(data, data["loop"], bases) if file else predicted


def _recorded(data: Mapping[str, Any], loop: bool, bases: Sequence[Path]) -> RateAtTime:
    return trace(find_file(data, "file", bases), loop, None)


def _reverse(data: Mapping[str, Any], loop: bool, bases: Sequence[Path]) -> OneWay:
    """The reverse direction: its rate is a file's, or constant."""
    from runner.link.limit import OneWay

    kbps, file = data.get("kbps"), data.get("file")
    if (kbps is None) == (file is None):
        raise ModelError("reverse", dict(data), "must give either kbps or file")
    constant = exact(kbps or 0)
    with within("reverse"):
        rates = _recorded(data, loop, bases) if file else lambda _: constant
        delay_at = _delays(data, loop, bases)
    return OneWay(lambda t: float(rates(t)), **_path(data), delay_at=delay_at)


def _delays(data: Mapping[str, Any], loop: bool, bases: Sequence[Path]) -> Callable[[float], float] | None:
    """The delay over time that a file states, ms: `delay_ms`, or half of `rtt_ms`."""
    if not data.get("delay_file"):
        return None
    from runner.pqos.table import DELAY, header

    path = find_file(data, "delay_file", bases)
    try:
        delays, share = trace(path, loop, None, DELAY), 1.0 if "delay_ms" in header(path) else 0.5
    except ModelError as error:
        raise ModelError("delay_file", error.found, error.rule) from None
    return lambda t: share * float(delays(t))


def _tcp(data: Mapping[str, Any]) -> TcpFlows:
    from runner.link.limit import TcpFlows

    sizes = data.get("bytes")
    if sizes and sizes[0] > sizes[1]:
        raise ModelError("tcp.bytes", sizes, "must be [smallest, largest]")
    return TcpFlows(
        data["flows"], (sizes[0], sizes[1]) if sizes else None, data.get("pause_s", 10), data.get("start_s", 0)
    )


def _policer(data: Mapping[str, Any]) -> Policing:
    from runner.link.limit import Policing

    return Policing(float(data["kbps"]), float(data["depth_ms"]))


def _path(data: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters of one direction of the link other than its rate."""
    lost = {"loss": float(data.get("loss", 0)), "burst": float(data.get("loss_burst", 1))}
    return {"queue_ms": float(data["queue_ms"]), "delay_ms": float(data["delay_ms"])} | lost


def no_rates(_t: float) -> Kbps:
    """Nothing states the rate of the link."""
    return exact(0)


def true_rates(pqos: Mapping[str, Any], bases: Sequence[Path]) -> RateAtTime:
    """The rate that the source of the `pqos` section states for each time and place, without look-ahead or `wrong`.

    returns  `no_rates` if predictions, or the positions that they depend on, come from outside
    raises   ModelError with the key, the value found and the rule
    """
    position = pqos.get("position") or {"kind": "live"}  # as in build_track
    if pqos["kind"] == "live" or (pqos["kind"] == "map" and position["kind"] == "live"):
        return no_rates
    return _recorded_rates(build_pqos({**pqos, "look_ahead_s": 0, "wrong": None}, bases), build_track(pqos, bases))


def _recorded_rates(source: Pqos, track: Track | None) -> RateAtTime:
    """The rate that a prediction source states for each time of a drive; 0 if it states none."""
    rates: list[Kbps] = []

    def kbps_at(t: float) -> Kbps:
        step = int(t / STEP_S + 1e-6)
        while len(rates) <= step:
            now = len(rates) * STEP_S
            event: Event = ClockAdvanced(t=now) if track is None else track.at(now)
            prediction = source.observe(event)
            rates.append(prediction.kbps if prediction else rates[-1] if rates else exact(0))
        return rates[step]

    return kbps_at
