"""Control link between operators and vehicle over MQTT: requests, replies, applied state, telemetry.

Topics of a vehicle, below tod/<vehicle>/ (`control.prefix` replaces tod, on the way to the broker):

    request/<operator>   to the vehicle: an event of schemas/event.schema.json with `id` and `as_of`, without `t`; never
                         retained. The vehicle stamps it on receipt.
    reply/<operator>     to that operator: the same id, and applied (read back from the elements), refused, expired or
                         timed out
    reception/<operator> to the vehicle, 25 times a second: what has arrived from every camera; never retained
    clock/<operator>     to that operator, five times a second: when a report arrived, by the vehicle's clock
    advice               from the vehicle, ten times a second, if it knows `latency.fixed_ms`: speed by latency
    steering             from the vehicle, up to 20 times a second: the reported steering angle
    state, telemetry     from the vehicle, retained, so that late subscribers receive them
    configuration        from the vehicle, retained: what both sides must agree on

Last wills announce that a side is offline: the vehicle's state is {"online": false}, the operator's request is
operator_disconnected. A vehicle with several uplinks has a connection by each of them, and sends and receives
everything by all of them; the will of each names it: {"online": false, "uplink": NAME}.
schemas/control.schema.json describes the vehicle's messages and reception reports.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from runner.records import from_json
from runner.records.reception import ReceptionReport
from runner.records.vehicle import (
    ClockAnswer,
    Reply,
    Settings,
    SteeringAngle,
    Telemetry,
    UplinkLost,
    VehicleState,
)
from runner.schema import message_problem, read_json, shortened
from runner.settings import PREFIX

OFFLINE = {"online": False}
OPERATOR_GONE = {"id": "will", "event": "operator_disconnected"}  # by the broker, when the connection has broken
SIGNED_OFF = {**OPERATOR_GONE, "id": "signed off"}  # by the operator itself
OPERATOR = re.compile(r"[A-Za-z0-9_-]{1,64}")  # shown to operators and logged
_SURROGATE = re.compile(rb"\\u[dD]")  # perhaps half of a pair
OPERATOR_RULE = "topic: an operator's id must be 1 to 64 letters, digits, _ and -"
LARGEST = {"kbps": 1e9, "lower_kbps": 1e9, "valid_s": 3600.0}  # a larger number could not be read back by operators ...
LARGEST_WEIGHT = 1e6  # ... or would outlast its sender
STATED_BY_VEHICLE = ("operator", "role", "departure")  # keys of events, which follow from the sender
MAX_ID = 128  # characters of a request's id, which its reply repeats
MAX_REQUEST_BYTES = 65_536  # the longest event is a hundredth of it
MAX_OFFLINE_BYTES = 256  # a longer state is of a vehicle that is online
MAX_MESSAGE_BYTES = 1_048_576  # state and configuration grow with the number of cameras
APPLY_S = 1.0  # a request whose commands are not read back from the elements by then has timed out
SILENT_S = 0.7  # a vehicle that sends nothing for this long is offline; it sends telemetry five times a second
SLACK_S = 0.5  # extra time for the answer to a request that was executed at the last moment
MAX_ROUND_TRIP_S = 0.5  # allowed for an old request; a longer round trip is too long for driving

JsonObject = Mapping[str, Any]


def of_run(goodbye: JsonObject, run: int) -> JsonObject:
    """A will, or signing off, of one process: another one with the same keys goes on."""
    return {**goodbye, "id": f"{goodbye['id']} {run}"}


def is_will(identity: str) -> bool:
    """Whether the broker sent a goodbye, by its id."""
    return identity.partition(" ")[0] == OPERATOR_GONE["id"]


def run_of(identity: str) -> int | None:
    """The process that a goodbye is of, by its id; None: not stated."""
    run = identity.rpartition(" ")[2]
    return int(run) if run.isdecimal() and run.isascii() else None


def topic(vehicle: str, *parts: str) -> str:
    """A topic of a vehicle, or a filter if a part is +."""
    return "/".join((PREFIX, vehicle, *parts))


def answer_s(expires_s: float) -> float:
    """Timeout for the vehicle's answer to a request, s.

    expires_s  age from which the vehicle drops a request
    """
    return expires_s + MAX_ROUND_TRIP_S + APPLY_S + SLACK_S


class MqttMessage(NamedTuple):
    """A message as received.

    retained  whether it is the broker's stored copy
    """

    topic: str
    payload: bytes
    retained: bool

    @property
    def sender(self) -> str:
        """The operator's id, last part of the topic of a request."""
        return self.topic.rpartition("/")[2]


def read_message(payload: bytes, limit: int = MAX_REQUEST_BYTES) -> dict[str, Any]:
    """Parse a mapping from untrusted JSON.

    raises  ValueError with the problem
    """
    if len(payload) > limit:
        raise ValueError(f"{len(payload)} bytes: must be at most {limit}")
    try:
        document = read_json(payload.decode())  # bytes might be UTF-16, or hold surrogates
    except ValueError as error:
        raise ValueError(f"not JSON: {error}") from None
    if not isinstance(document, dict):
        raise ValueError("must be a mapping with id and event")
    if _SURROGATE.search(payload):
        try:
            json.dumps(document, ensure_ascii=False).encode()
        except UnicodeEncodeError:  # it could not be printed
            raise ValueError("contains half of a surrogate pair") from None
    return document


def is_online(payload: bytes) -> bool:
    """Whether a vehicle's state says that it is online. Nothing else of it is read: the vehicle may be hostile.

    raises  ValueError with the problem
    """
    return len(payload) > MAX_OFFLINE_BYTES or read_message(payload).get("online") is not False


def read_state(payload: bytes) -> VehicleState | UplinkLost | None:
    """A vehicle's state; None: it is offline. Like the five below, raises ValueError with the problem."""
    document = _checked("state", payload)
    if document["online"]:
        return from_json(VehicleState, document)
    return from_json(UplinkLost, document) if "uplink" in document else None


def read_telemetry(payload: bytes) -> Telemetry:
    return from_json(Telemetry, _checked("telemetry", payload))


def read_settings(payload: bytes) -> Settings:
    return from_json(Settings, _checked("configuration", payload))


def read_steering(payload: bytes) -> SteeringAngle:
    return from_json(SteeringAngle, _checked("steering", payload, MAX_REQUEST_BYTES))


def read_reply(payload: bytes) -> Reply:
    return from_json(Reply, _checked("reply", payload))


def read_clock(payload: bytes) -> ClockAnswer:
    return from_json(ClockAnswer, _checked("clock", payload, MAX_REQUEST_BYTES))


def read_reception(message: MqttMessage) -> ReceptionReport:
    """What an operator's side has received. Like the readers above, raises ValueError with the problem."""
    if not OPERATOR.fullmatch(message.sender):
        raise ValueError(OPERATOR_RULE)
    if message.retained:
        raise ValueError("must not be retained: a report is for now")
    return from_json(ReceptionReport, _checked("reception", message.payload, MAX_REQUEST_BYTES))


def _checked(kind: str, payload: bytes, limit: int = MAX_MESSAGE_BYTES) -> dict[str, Any]:
    """A message that satisfies schemas/control.schema.json."""
    document = read_message(payload, limit)
    if problem := message_problem(kind, document):
        raise ValueError(problem)
    return document


class ParsedRequest(NamedTuple):
    """A request as received.

    document  the event without id and as_of, not yet checked
    identity  its id, "" for none
    as_of     see `runner.vehicle.operators`; None if it is not needed
    problem   why the request is invalid; None if it is valid
    """

    document: dict[str, Any]
    identity: str = ""
    as_of: float | None = None
    problem: str | None = None


def read_request(message: MqttMessage) -> ParsedRequest:
    """The request as received. The event itself is checked when its time is known.

    raises  ValueError for an invalid sender, whom nothing may be sent to: "" is this process
    """
    if not OPERATOR.fullmatch(message.sender):
        raise ValueError(OPERATOR_RULE)
    try:
        document = read_message(message.payload)
    except ValueError as error:
        return ParsedRequest({}, problem=str(error))
    identity, as_of = document.pop("id", None), document.pop("as_of", None)
    if not isinstance(identity, str) or not 0 < len(identity) <= MAX_ID:
        return ParsedRequest(document, problem=f"id: must be given, as text of 1 to {MAX_ID} characters")
    problem = _too_large(document)
    if message.retained:
        problem = "must not be retained: a request is for now"
    elif "t" in document:
        problem = "t: must not be given, the vehicle stamps events on receipt"
    elif stated := [key for key in STATED_BY_VEHICLE if key in document]:
        problem = f"{stated[0]}: must not be given, the vehicle takes it from the topic"
    elif document == {"event": OPERATOR_GONE["event"]}:
        return ParsedRequest(document, identity)  # a last will cannot know when it is published
    elif isinstance(as_of, bool) or not isinstance(as_of, int | float) or not math.isfinite(as_of):
        problem = "as_of: must be given: the vehicle's t in the newest telemetry, plus the time since, s"
    return ParsedRequest(document, identity, None if problem else float(as_of), problem)


def _too_large(document: JsonObject) -> str | None:
    """Which number of a request is too large; None: none is. Logged events, and the vehicle's own, are not bounded."""
    bounds = [(key, document.get(key), most) for key, most in LARGEST.items()]
    if isinstance(weights := document.get("weights"), dict):
        bounds += [(f"weights.{name}", weight, LARGEST_WEIGHT) for name, weight in weights.items()]
    for key, value, most in bounds:
        if isinstance(value, int | float) and value > most:
            return f"{shortened(key)}: {value:g}: must be at most {most:g}"
    return None
