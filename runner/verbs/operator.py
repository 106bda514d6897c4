"""usage: tod-runner operator [OVERRIDE ...] [duration_s=N]

The operator's side: receives every camera by the operator graph of the configuration, decodes it, and shows frames a
second, kbit/s, size and the measured latency from capture to decode beside what the vehicle has decided. Ends with
Ctrl-C or after duration_s, with a summary of how well what came followed what was decided.

  tod-runner operator                      everything from the vehicle at media.host
  tod-runner operator vehicle=delivery_robot media.host=192.0.2.7 control.host=192.0.2.7
"""

from __future__ import annotations

import json
import signal
import threading
import time
import uuid
from collections.abc import Mapping
from typing import Any

from runner.config import load
from runner.control import OPERATOR_GONE, Link
from runner.model import Vehicle
from runner.sources import compile_plans
from runner.telemetry import Decided, Meter
from runner.verbs import Arguments
from runner.verbs.screen import streaming
from runner.verbs.table import Row, Table, show_summary

SAMPLE_S = 0.25


def run(arguments: Arguments) -> int:
    apply = streaming()
    duration = arguments.number("duration_s")
    vehicle = load(arguments.overrides, arguments.conf, runnable=False, check=apply.check_plan)
    station = Station(vehicle)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with Table(vehicle) as table:
        side = apply.OperatorSide(compile_plans(vehicle), lambda camera, what: table.note(f"{camera}: {what}"))
        began = time.monotonic()
        try:
            while not stop.wait(SAMPLE_S) and (duration is None or time.monotonic() - began < duration):
                station.take(side.sample(station.sending()))
                table.show(station.rows(), station.headline())
        finally:
            station.close()
            side.stop()
    show_summary(station.meters, station.samples)
    return 0


class Station:
    """What the operator knows: the vehicle's last state, and what comes of each camera."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._state: Mapping[str, Any] = {"online": False}
        self.meters = {name: Meter(float(camera.fps)) for name, camera in vehicle.cameras.items()}
        self.samples: Mapping[str, Any] = {}
        self._rates: dict[str, Any] = {}
        self._told = 0.0
        listen = {"state": self._on_state, "reply": lambda _: None}
        self._link = Link(vehicle.name, vehicle.control, ("request", OPERATOR_GONE), listen, self._on_connected)
        self._link.connect()

    def sending(self) -> dict[str, bool]:
        """Which cameras should send, by the vehicle's word."""
        return {name: bool(setting["sending"]) for name, setting in self._state.get("cameras", {}).items()}

    def take(self, samples: Mapping[str, Any]) -> None:
        """A sample of every camera's counters; once a second the vehicle is told what arrives."""
        now, self.samples = time.monotonic(), samples
        for name, received in samples.items():
            self._rates[name] = self.meters[name].add(now, received, self._decided(name))
        if now - self._told >= 1:
            self._told = now
            for name, rates in self._rates.items():
                self._request({"event": "link_measured", "camera": name, "kbps": round(rates.kbps, 1)})

    def rows(self) -> list[Row]:
        rows = []
        for name, received in self.samples.items():
            setting = self._state.get("cameras", {}).get(name, {})
            rows.append(Row(name, self._rates[name], received, self._decided(name), setting))
        return rows

    def headline(self) -> str:
        if not self._state["online"]:
            return f"{self._vehicle.name}: not there"
        total = self._state["total_kbps"]
        return f"{self._vehicle.name}, mode {self._state['mode']}, total {total} kbit/s"

    def close(self) -> None:
        self._link.close("request", OPERATOR_GONE)

    def _decided(self, name: str) -> Decided | None:
        setting = self._state.get("cameras", {}).get(name)
        if setting is None:
            return None
        return Decided(setting["sending"], setting["kbps"], setting["width"], setting["height"])

    def _on_state(self, payload: bytes) -> None:
        state = json.loads(payload)
        came = state["online"] and not self._state["online"]
        self._state = state
        if came:
            self._request({"event": "operator_connected"})

    def _on_connected(self, here: bool) -> None:
        if not here:
            self._state = {"online": False}

    def _request(self, event: Mapping[str, Any]) -> None:
        self._link.publish("request", {"id": uuid.uuid4().hex, **event})
