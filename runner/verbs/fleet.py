"""`tod-runner operator vehicles=...`: one page for several vehicles, each with a station in a process of its own."""

from __future__ import annotations

import json
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from runner.configuration.config import configuration
from runner.configuration.yaml_file import label, load_file
from runner.errors import ArgumentError, ConfigError, Problem
from runner.mqtt.embedded import embedded_broker
from runner.mqtt.link import ControlLink, login_of
from runner.mqtt.messages import MqttMessage, is_online, topic
from runner.page.fleet import FleetServer
from runner.redact import printable
from runner.security.exposure import page_keyring, viewer_keyring
from runner.settings import Setup
from runner.system import signals
from runner.system.restarted import RestartedProcess
from runner.verbs import Arguments
from runner.verbs.screen import forgiving, say

ALL = "all"
NAME = re.compile(r"[A-Za-z0-9_-]+")  # as `name` in schemas/vehicle.schema.json
LOOK_S = 0.2
STATION_END_S = signals.END_S + 0.2  # a station ends itself by force before it is killed
END_S = STATION_END_S + 1.2  # all stations, and the page
Words = tuple[str, ...]
MOST = 100  # vehicles that a broker may make this side start stations for


class Fleet:
    """The stations of all vehicles, behind one page.

    arguments  of the verb, the same for every station
    directory  of their sockets
    """

    def __init__(self, arguments: Arguments, page: FleetServer, directory: Path) -> None:
        self._arguments, self._page, self._directory = arguments, page, directory
        self._stations: dict[str, RestartedProcess] = {}
        self._faults: dict[str, str | None] = {}  # as last stated to the page

    def __contains__(self, name: str) -> bool:
        return name in self._faults

    def add(self, name: str, own: Words) -> None:
        """Add a vehicle with overrides of its own."""
        socket = self._directory / str(len(self._stations))  # short: a socket's name has 107 bytes at most
        # All share a broker that this side starts.
        words = [*own, *self._arguments.overrides, "control.broker=null", f"socket={socket}"]
        words += [f"conf={self._arguments.conf}"] if self._arguments.conf else []
        drives = self._arguments.path("drives")
        words += [f"drives={drives / name}"] if drives else []
        self._stations[name] = RestartedProcess(
            f"the station of {name}", "operator", words, lambda line: show(name, line)
        )
        self._faults[name] = ""
        self._page.add(name, socket)

    def refuse(self, name: str, why: str) -> None:
        """List a vehicle that has no station, for a reason."""
        self._faults[name] = why
        self._page.add(name, None, why)
        show(name, why)

    def look(self) -> None:
        now = time.monotonic()
        for name, station in self._stations.items():
            station.look(now)
            if station.fault != self._faults[name]:
                self._faults[name] = station.fault
                self._page.report(name, station.fault)
                if station.fault:
                    show(name, station.fault)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Within the block stations run; at its end all of them end."""
        try:
            with signals.urgent(self._kill):
                yield
        finally:
            until = time.monotonic() + STATION_END_S
            for station in self._stations.values():
                station.request_end()
            for name, station in self._stations.items():
                if not station.end(max(0.0, until - time.monotonic())):
                    show(name, f"its station did not end within {STATION_END_S:g} s and was killed")

    def _kill(self) -> None:
        for station in self._stations.values():
            station.kill()


def run(arguments: Arguments) -> int:
    given = vehicles_of(arguments.values["vehicles"])
    if "log" in arguments.values:
        raise ArgumentError("log", arguments.values["log"], "is for one vehicle: give drives=DIR")
    if both := next((word for word in arguments.overrides if word.partition("=")[0] in ("vehicle", "name")), None):
        raise ArgumentError("vehicles", arguments.values["vehicles"], f"states what {both} does: give one of them")
    setup = _composed(arguments, given)
    duration = arguments.number("duration_s")
    with signals.stopping(END_S) as stop, ExitStack() as stack:
        directory = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tod-runner-")))
        page = FleetServer(setup.page.endpoint, page_keyring(setup), setup.page.people, say)
        page.start()
        stack.callback(page.stop)
        if setup.control.embedded:
            stack.enter_context(embedded_broker(setup, say))
        fleet = Fleet(arguments, page, directory)
        stack.enter_context(fleet.running())
        for name, words in (given or {}).items():
            fleet.add(name, words)
        found = stack.enter_context(_known(setup)) if given is None else list
        say(f"page: {page.url}")
        end = None if duration is None else time.monotonic() + duration
        while not stop.is_set() and (end is None or time.monotonic() < end):
            for name in found():
                if name not in fleet:
                    _add(fleet, arguments, name)
            fleet.look()
            stop.wait(LOOK_S)
    return stop.status


def vehicles_of(text: str) -> Mapping[str, Words] | None:
    """By vehicle, the overrides that are its own; None: all vehicles that the broker knows, without overrides.

    text    all, names as [a, b] or a,b, or a file of vehicles
    raises  UserError
    """
    if text == ALL:
        return None
    if text.endswith((".yaml", ".yml")):
        return _of_file(Path(text))
    inner = text.removeprefix("[").removesuffix("]") if text.startswith("[") and text.endswith("]") else text
    names = [name.strip() for name in inner.split(",")]
    if wrong := [name for name in names if not NAME.fullmatch(name)]:
        rule = f"must be names of vehicles, such as [courier-1, courier-2], a file that ends in .yaml, or {ALL}"
        raise ArgumentError("vehicles", repr(wrong[0]), rule)
    if len(set(names)) < len(names):
        raise ArgumentError("vehicles", text, "names a vehicle twice")
    return {name: (f"vehicle={name}",) for name in names}


def _of_file(path: Path) -> Mapping[str, Words]:
    """Those of a file: by name of a vehicle, the part of a configuration that is its own; null: nothing.

    raises  ConfigError
    """
    document = load_file(path)
    if not isinstance(document, dict) or not document:
        raise ConfigError([Problem(label(path), "", None, "must state by name of a vehicle what is its own")])
    problems = [
        Problem(label(path), str(name), None, rule)
        for name, own in document.items()
        for rule in [_rule_of(name, own)]
        if rule
    ]
    if problems:
        raise ConfigError(problems)
    return {name: tuple(_words(name, own or {})) for name, own in document.items()}


def _rule_of(name: object, own: object) -> str | None:
    """What is wrong with an entry of a file of vehicles; None: nothing."""
    if not isinstance(name, str) or not NAME.fullmatch(name):
        return "must be the name of a vehicle: letters, digits, _ and -"
    return None if own is None or isinstance(own, dict) else "must be a part of a configuration, by its keys"


def _words(name: str, own: Mapping[str, Any]) -> Iterator[str]:
    """The overrides of a vehicle: one that has no file of its own is named here."""
    kind = own.get("vehicle")
    yield from (f"vehicle={kind}", f"name={name}") if kind else (f"vehicle={name}",)
    yield from _flat({key: value for key, value in own.items() if key != "vehicle"})


def _flat(own: Mapping[str, Any], above: str = "") -> Iterator[str]:
    for key, value in own.items():
        if isinstance(value, dict) and value:
            yield from _flat(value, f"{above}{key}.")
        else:
            yield f"{above}{key}={json.dumps(value, ensure_ascii=False)}"


def show(name: str, line: str) -> None:
    """Print a line about a vehicle, under its name."""
    print(f"{name}: {printable(line)}", file=forgiving(sys.stderr), flush=True)


def _composed(arguments: Arguments, vehicles: Mapping[str, Words] | None) -> Setup:
    """The settings of the page and the broker, those of the first vehicle.

    raises  ConfigError with the problems of all vehicles
    """
    problems = list[Problem]()
    setups = list[Setup]()
    for name, words in (vehicles or {}).items():
        try:
            setups.append(setup_of(arguments, name, words))
        except ConfigError as error:
            problems += [problem for problem in error.problems if problem not in problems]
    if problems:
        raise ConfigError(problems)
    setup = setups[0] if setups else _composed_of(arguments, ())
    if not setup.page.serve:
        raise ArgumentError("page.serve", "false", "vehicles= is for the page")
    ports = [each.metrics.operator_port for each in setups if each.metrics.operator_port]
    if len(set(ports)) < len(ports):
        rule = "must differ: state one for each vehicle in a file of vehicles"
        raise ArgumentError("metrics.operator_port", str(ports[0]), rule)
    for each in setups or [setup]:
        viewer_keyring(each)
    return setup


def setup_of(arguments: Arguments, name: str, words: Words) -> Setup:
    """The setup of one vehicle.

    raises  ConfigError, also if its file describes a vehicle of another name
    """
    setup = _composed_of(arguments, words)
    if setup.vehicle.name != name:
        rule = f"must be {name}, as its file is named: the page and the broker know the vehicle by it"
        raise ConfigError([Problem(f"vehicle={name}", "name", repr(setup.vehicle.name), rule)])
    return setup


def _composed_of(arguments: Arguments, own: Words) -> Setup:
    words = (*own, *arguments.overrides)
    return configuration(words, arguments.conf, runnable=False, site=arguments.site).setup()


def _add(fleet: Fleet, arguments: Arguments, name: str) -> None:
    """Add a vehicle that the broker knows; it may have no file here."""
    try:
        setup_of(arguments, name, words := (f"vehicle={name}",))
    except ConfigError as error:
        fleet.refuse(name, f"no station: {error.problems[0]}")
    else:
        fleet.add(name, words)


@contextmanager
def _known(setup: Setup) -> Iterator[Callable[[], list[str]]]:
    """A function that returns the vehicles whose state the broker knows, to be called several times a second."""
    names = dict[str, None]()

    def on_state(message: MqttMessage) -> None:
        name = message.topic.split("/")[1]
        is_online(message.payload)  # or it is invalid
        if NAME.fullmatch(name) and len(names) < MOST:
            names[name] = None

    login = login_of(setup.control, viewer_keyring(setup), say)
    listen = {topic("+", "state"): on_state}
    link = ControlLink(setup.control, None, listen, lambda _: None, say, login, prefix=setup.control.prefix)
    link.connect()

    def look() -> list[str]:
        link.check()
        return list(names)

    try:
        yield look
    finally:
        link.close()
