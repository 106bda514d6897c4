"""What the operator's side knows: what the vehicle says and what comes of each camera. Feeds table and page."""

from __future__ import annotations

import json
import threading
import time
import uuid
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from runner.control import OFFLINE, OPERATOR_GONE, Document, Link
from runner.model import Vehicle
from runner.telemetry import Counters, Decided, Meter, Rates

ANSWER_S = 2.0  # a request without an answer by then has timed out
SILENT_S = 0.7  # a vehicle that says nothing for so long is not there; it speaks five times a second
TOLD_EVERY_S = 1.0  # how often the vehicle is told what arrives

Tell = Callable[[str, Document], object]


class Row(NamedTuple):
    """One camera: its rates and counters, what is decided, and all that the vehicle says of it."""

    name: str
    rates: Rates
    received: Any
    decided: Decided | None
    setting: Mapping[str, Any]


class _Asked(NamedTuple):
    answer: Tell | None
    event: str
    until: float


class Station:
    """One operator's end of the control link, and the measurements of what arrives.

    listeners  told, from any thread, what is new: "state" (as the vehicle publishes it), "sample" (see `_sample`, a few
               times a second), "note" (time, text); to be added before `connect`

    Requests go out by `ask`; samples of the cameras' counters come in by `take`.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self.listeners: list[Tell] = []
        self.state: Document = OFFLINE  # what the vehicle says, as long as it is heard
        self._said: Document = OFFLINE  # what it said last
        self._telemetry: Mapping[str, Any] = {}
        self._heard = 0.0
        self._asked: dict[str, _Asked] = {}
        self._lock = threading.Lock()
        self.meters = {name: Meter(float(camera.fps)) for name, camera in vehicle.cameras.items()}
        self.samples: Mapping[str, Any] = {}
        self._rates: dict[str, Rates] = {}
        self._told = 0.0
        listen = {"state": self._on_state, "reply": self._on_reply, "telemetry": self._on_telemetry}
        self._link = Link(vehicle.name, vehicle.control, ("request", OPERATOR_GONE), listen, self._on_connected)

    def connect(self) -> None:
        """raises RunError where no broker is"""
        self._link.connect()

    def close(self) -> None:
        self.state = OFFLINE  # a goodbye is no loss
        self._link.close("request", OPERATOR_GONE)

    def ask(self, event: Document, answer: Tell | None = None) -> None:
        """Send a request to the vehicle.

        answer  told "reply" with {result, reason}: applied (read back from the elements), refused or timed out
        """
        if not self.state["online"]:
            if answer:
                answer("reply", {"result": "refused", "reason": "the vehicle is not there"})
            return
        identity = uuid.uuid4().hex
        with self._lock:
            self._asked[identity] = _Asked(answer, event["event"], time.monotonic() + ANSWER_S)
        self._link.publish("request", {**event, "id": identity})

    def tell(self, kind: str, message: Document) -> None:
        for listener in self.listeners:
            listener(kind, message)

    def note(self, text: str) -> None:
        self.tell("note", {"time": time.time(), "text": text})

    def report(self, camera: str, what: str) -> None:
        """What happened to a camera, as `OperatorSide` reports it."""
        self.note(f"{camera}: {what}")

    def sending(self) -> dict[str, bool]:
        """Which cameras should send, by the vehicle's word."""
        return {name: bool(setting["sending"]) for name, setting in self.state.get("cameras", {}).items()}

    def take(self, samples: Mapping[str, Counters]) -> None:
        """A sample of every camera's counters; to be called a few times a second, since time is judged here too."""
        now = time.monotonic()
        if self.state["online"] and now - self._heard > SILENT_S:
            self._lose(f"the vehicle has said nothing for {SILENT_S:g} s")
        self._time_out(now)
        for name, received in samples.items():
            self._rates[name] = self.meters[name].add(now, received, self._decided(name))
        self.samples = samples
        if now - self._told >= TOLD_EVERY_S:
            self._told = now
            for name, rates in self._rates.items():
                self.ask({"event": "link_measured", "camera": name, "kbps": round(rates.kbps, 1)})
        self.tell("sample", self._sample())

    def rows(self) -> list[Row]:
        return [
            Row(name, self._rates[name], received, self._decided(name), self._setting(name))
            for name, received in self.samples.items()
        ]

    def headline(self) -> str:
        if not self.state["online"]:
            return f"{self._vehicle.name}: not there"
        return f"{self._vehicle.name}, mode {self.state['mode']}, total {self.state['total_kbps']} kbit/s"

    def _sample(self) -> dict[str, Any]:
        """What the charts show of this moment. Rates are those of the last second."""
        cameras = {
            row.name: {
                "fps": round(row.rates.fps, 1),
                "kbps": round(row.rates.kbps, 1),
                "allocated_kbps": row.setting.get("kbps", 0),
                "demand_kbps": row.setting.get("demand_kbps", 0),
                "scaling": row.setting.get("scaling"),
                "width": row.received.width,
                "height": row.received.height,
                "latency_ms": row.received.latency_ms,
                "lost": row.received.lost,
                "rebuilt": row.received.rebuilt,
            }
            for row in self.rows()
        }
        told = self._telemetry if self.state["online"] else {}
        return {
            "time": time.time(),
            "predicted_kbps": told.get("predicted_kbps"),
            "allocated_kbps": sum(camera["allocated_kbps"] for camera in cameras.values()),
            "actual_kbps": round(sum(camera["kbps"] for camera in cameras.values()), 1),
            "position": told.get("position"),
            "refused": told.get("refused", 0),
            "cameras": cameras,
        }

    def _setting(self, name: str) -> Mapping[str, Any]:
        setting: Mapping[str, Any] = self.state.get("cameras", {}).get(name, {})
        return setting

    def _decided(self, name: str) -> Decided | None:
        setting = self._setting(name)
        if not setting:
            return None
        return Decided(setting["sending"], setting["kbps"], setting["width"], setting["height"])

    def _on_state(self, payload: bytes) -> None:
        self._said = json.loads(payload)
        if self._said["online"]:
            self._hear()
        else:
            self._lose("the vehicle is gone")

    def _hear(self) -> None:
        before, state = self.state, self._said
        self._heard = time.monotonic()
        if before is state:
            return
        self.state = state
        self.tell("state", state)
        if before["online"]:
            self._note_changes(before, state)
        else:
            self.note(f"the vehicle is there, mode {state['mode']}")
            self.ask({"event": "operator_connected"})

    def _note_changes(self, before: Document, state: Document) -> None:
        if before["mode"] != state["mode"]:
            self.note(f"mode {state['mode']}, total {state['total_kbps']} kbit/s")
        for name, now in state["cameras"].items():
            was = before["cameras"][name]
            if any(was[key] != now[key] for key in ("on", "sending", "scaling", "roi")):
                self.note(f"{state['cause']} -> {name}: {now['reason']}")

    def _on_telemetry(self, payload: bytes) -> None:
        self._telemetry = json.loads(payload)
        if self._said["online"]:  # else it is the retained telemetry of a vehicle that is gone
            self._hear()

    def _on_reply(self, payload: bytes) -> None:
        said = json.loads(payload)
        with self._lock:
            asked = self._asked.pop(said["id"], None)
        if asked is None:
            return
        if asked.answer:
            asked.answer("reply", {"result": said["result"], "reason": said["reason"]})
        elif said["result"] == "refused":
            self.note(f"{asked.event} refused: {said['reason']}")

    def _time_out(self, now: float) -> None:
        with self._lock:
            late = {identity: asked for identity, asked in self._asked.items() if now > asked.until}
            for identity in late:
                del self._asked[identity]
        for asked in late.values():
            if asked.answer:
                reason = f"no answer from the vehicle within {ANSWER_S:g} s"
                asked.answer("reply", {"result": "timed out", "reason": reason})

    def _on_connected(self, here: bool) -> None:
        if not here:
            self._said = OFFLINE
            self._lose("the control link is lost")

    def _lose(self, why: str) -> None:
        if self.state["online"]:
            self.note(why)
        self.state = OFFLINE
        self.tell("state", OFFLINE)
