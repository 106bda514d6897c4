"""Who drives: two controllers, a watcher and a supervisor in every order, in a table and at random."""

from __future__ import annotations

import random
from itertools import permutations
from typing import Any

import pytest
from helpers import vehicle

from runner.core.driving import KNOWN_S, OFFER_S, SLOW_S, Control, Driving
from runner.core.events import parse, to_json
from runner.core.roles import Role
from runner.core.step import Run, start, step

VEHICLE = vehicle("vehicle=delivery_robot", "modes=paper")
CAMERAS = list(VEHICLE.cameras)
LEAVES = {
    "silent": "has been silent for 1 s",
    "quits": "signed off",
    "expelled": "its keys were withdrawn",
}
ROLES = {"ann": "controller", "bob": "controller", "eve": "watcher", "sue": "supervisor"}


class Drive:
    """A vehicle's core, told in words what happens.

    tick_s  between two reports of speed and clock, s
    """

    def __init__(self, former: str = "", tick_s: float = 0.1, stop: str | None = None) -> None:
        self.run, self.t, self.events, self.tick_s = start(VEHICLE), 0.0, list[dict[str, Any]](), tick_s
        self.speed: float | None = None  # as it is reported with every tick; None: not at all
        if former or stop:
            self.take("control_restored", operator=former, **({"stop": stop} if stop else {}))

    @property
    def driving(self) -> Driving:
        return self.run.state.driving

    def take(self, event: str, **values: Any) -> str | None:
        """Why the event was refused; None: it was accepted."""
        document = {"t": round(self.t, 3), "event": event, **values}
        self.events.append(document)
        self.run = step(VEHICLE, self.run, parse(document))
        return self.run.refused

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / self.tick_s)):
            self.t += self.tick_s
            if self.speed is not None:
                self.take("position_reported", lat=48.26, lon=11.66, speed_mps=self.speed)
            self.take("clock_advanced")

    def does(self, words: str) -> str | None:  # noqa: PLR0911
        """`ann connects`, `ann offers bob`, `3 s`, `stands`, `moves`: why it was refused, or None."""
        match words.split():
            case [seconds, "s"]:
                self.wait(float(seconds))
            case ["stands" | "moves" | "hides" as how]:
                self.speed = {"stands": 0.0, "moves": 8.0, "hides": None}[how]
                self.wait(SLOW_S + 0.1 if how == "stands" else KNOWN_S)
            case [name, "connects"]:
                return self.take("operator_connected", operator=name, role=ROLES[name])
            case [name, ("silent" | "quits" | "expelled") as how]:
                return self.take("operator_disconnected", operator=name, departure=LEAVES[how])
            case [name, "offers", other]:
                return self.take("control_offered", operator=name, to=other)
            case [name, "withdraws"]:
                return self.take("control_offered", operator=name, to="")
            case [name, "denies", other]:
                return self.take("control_denied", operator=name, to=other)
            case [name, "accepts"]:
                return self.take("control_accepted", operator=name, live=CAMERAS)
            case [name, "accepts", "blind"]:
                return self.take("control_accepted", operator=name, live=CAMERAS[1:])
            case [name, ("stops" | "lifts") as what]:
                return self.take({"stops": "stop_requested", "lifts": "stop_lifted"}[what], operator=name)
            case [name, ("asks" | "releases" | "takes") as what]:
                event = {"asks": "requested", "releases": "released", "takes": "taken"}[what]
                return self.take(f"control_{event}", operator=name)
            case _:
                raise AssertionError(words)
        return None

    def words(self) -> str:
        """The state: `held by ann, offered to bob, requested by sue, stop by eve`."""
        now = self.driving
        parts = [f"{now.state} by {now.holder}" if now.holder else str(now.state)]
        parts += [f"offered to {now.offered}"] if now.offered else []
        parts += [f"requested by {' '.join(now.requested)}"] if now.requested else []
        return ", ".join(parts + ([f"stop by {now.stop}"] if now.stop else []))


THREE = "ann connects; bob connects; sue connects"


@pytest.mark.parametrize(
    ("story", "ends"),
    [
        # a lone operator
        ("ann connects", "held by ann"),
        ("eve connects", "free"),
        ("eve connects; ann connects", "held by ann"),
        ("ann connects; bob connects", "held by ann"),
        ("moves; ann connects", "held by ann"),  # never driven
        # a restart of the vehicle, and of the broker, after which all are silent
        ("@ann", "lost by ann"),
        ("@ann; ann connects", "held by ann"),
        ("@ann; bob connects", "lost by ann"),
        ("@ann; bob connects; stands; 2 s", "held by bob"),
        ("@ann; bob connects; moves; 60 s", "lost by ann"),
        ("@ann; sue connects; sue takes", "held by sue"),
        ("ann connects; bob connects; ann silent; bob silent; bob connects; ann connects", "held by ann"),
        ("ann connects; bob connects; ann silent; bob silent; ann connects; bob connects", "held by ann"),
        # the holder is lost: it crashes, reloads its side, or its network is cut
        ("ann connects; moves; ann silent", "lost by ann"),
        ("ann connects; moves; ann silent; 60 s", "lost by ann"),
        ("ann connects; moves; ann silent; 60 s; ann connects", "held by ann"),
        ("ann connects; moves; ann quits", "lost by ann"),
        ("ann connects; moves; ann quits; bob connects; 9 s", "lost by ann"),
        ("ann connects; hides; ann silent; bob connects; 9 s", "lost by ann"),  # a speed that is not known is none
        ("ann connects; hides; ann quits; bob connects; 9 s", "lost by ann"),
        ("ann connects; stands; ann quits", "free"),
        ("ann connects; stands; ann quits; bob connects", "held by bob"),
        ("ann connects; stands; ann silent", "lost by ann"),
        ("ann connects; stands; ann silent; 1.8 s; ann connects", "held by ann"),
        ("ann connects; stands; ann silent; 2.1 s", "free"),
        ("ann connects; stands; bob connects; ann silent; 2.1 s", "held by bob"),  # alone now
        ("ann connects; moves; bob connects; sue connects; ann silent; stands; 1 s", "free"),
        ("ann connects; moves; bob connects; sue connects; bob asks; ann silent; stands; 1 s", "held by bob"),
        ("ann connects; moves; bob connects; bob asks; ann silent; 9 s", "lost by ann, requested by bob"),
        ("ann connects; moves; bob connects; bob asks; ann silent; ann connects", "held by ann, requested by bob"),
        ("ann connects; moves; ann expelled", "lost by ann"),
        ("ann connects; stands; bob connects; ann expelled; 2.1 s", "held by bob"),
        # released
        ("ann connects; stands; ann releases", "free"),
        ("ann connects; stands; ann releases; 9 s", "free"),  # not given back unasked
        ("ann connects; stands; ann releases; ann silent; ann connects", "free"),
        ("ann connects; stands; ann releases; ann quits; ann connects", "held by ann"),
        ("ann connects; stands; ann releases; ann asks", "held by ann"),
        ("ann connects; stands; bob connects; ann releases", "free"),
        ("ann connects; stands; bob connects; bob asks; ann releases", "held by bob"),
        ("ann connects; stands; bob connects; ann releases; bob asks", "held by bob"),
        ("ann connects; stands; bob connects; ann releases; bob asks; bob quits", "free"),
        ("ann connects; stands; bob connects; bob asks; ann releases; bob quits; ann asks", "held by ann"),
        ("ann connects; stands; bob connects; ann releases; ann quits", "held by bob"),
        ("ann connects; stands; ann releases; moves", "free"),
        ("sue connects; hides; sue releases", "free"),  # she vouches that it stands
        ("ann connects; hides; ann silent; sue connects; sue releases", "free"),
        # requested
        ("ann connects; bob connects; bob asks", "held by ann, requested by bob"),
        ("ann connects; bob connects; sue connects; sue asks; bob asks; sue asks", "held by ann, requested by sue bob"),
        ("ann connects; bob connects; bob asks; bob releases", "held by ann"),
        ("ann connects; bob connects; bob asks; bob silent", "held by ann"),
        ("ann connects; bob connects; bob asks; ann denies bob", "held by ann"),
        ("ann connects; bob connects; bob asks; ann denies bob; bob asks", "held by ann, requested by bob"),
        ("ann connects; bob connects; bob asks; ann offers bob; ann denies bob", "held by ann"),
        (f"{THREE}; sue asks; bob asks; ann denies sue", "held by ann, requested by bob"),
        # offered
        ("ann connects; bob connects; moves; ann offers bob", "held by ann, offered to bob"),
        ("ann connects; bob connects; moves; ann offers bob; bob accepts", "held by bob"),
        ("ann connects; bob connects; bob asks; moves; ann offers bob; bob accepts", "held by bob"),
        ("ann connects; bob connects; stands; ann offers bob; bob accepts blind", "held by bob"),
        ("ann connects; bob connects; ann offers bob; ann withdraws", "held by ann"),
        ("ann connects; bob connects; ann offers bob; bob releases", "held by ann"),
        ("ann connects; bob connects; ann offers bob; bob silent", "held by ann"),
        ("ann connects; bob connects; ann offers bob; bob quits; bob connects", "held by ann"),
        ("ann connects; bob connects; sue connects; ann offers bob; ann offers sue", "held by ann, offered to sue"),
        ("ann connects; bob connects; moves; ann offers bob; 59 s", "held by ann, offered to bob"),
        ("ann connects; bob connects; moves; ann offers bob; 61 s", "held by ann"),
        ("ann connects; bob connects; moves; ann offers bob; ann silent", "lost by ann, offered to bob"),
        ("ann connects; bob connects; moves; ann offers bob; ann silent; bob accepts", "held by bob"),
        ("ann connects; bob connects; moves; ann offers bob; ann silent; 61 s", "lost by ann"),
        ("ann connects; bob connects; moves; ann offers bob; ann silent; bob silent", "lost by ann"),
        ("ann connects; bob connects; moves; ann offers bob; bob accepts; ann silent", "held by bob"),
        ("ann connects; bob connects; moves; ann offers bob; bob accepts; bob silent", "lost by bob"),
        ("ann connects; bob connects; ann offers bob; bob accepts; ann asks", "held by bob, requested by ann"),
        ("ann connects; sue connects; moves; ann offers sue; sue takes", "held by sue"),
        # taken
        ("ann connects; sue connects; moves; sue takes", "held by sue"),
        ("ann connects; sue connects; moves; sue takes; sue silent", "lost by sue"),
        ("ann connects; moves; ann silent; sue connects; sue takes", "held by sue"),
        ("ann connects; moves; ann silent; sue connects; sue takes; ann connects", "held by sue"),
        ("ann connects; bob connects; sue connects; moves; ann offers bob; sue takes", "held by sue"),
        ("ann connects; bob connects; sue connects; moves; sue takes; sue offers bob; bob accepts", "held by bob"),
        # a request to stop
        ("ann connects; eve connects; moves; eve stops", "held by ann, stop by eve"),
        ("ann connects; eve connects; bob connects; eve stops; bob stops; ann stops", "held by ann, stop by eve"),
        ("ann connects; ann stops", "held by ann, stop by ann"),
        ("eve connects; eve stops", "free, stop by eve"),
        ("ann connects; eve connects; eve stops; ann lifts", "held by ann"),
        ("ann connects; eve connects; sue connects; eve stops; sue lifts", "held by ann"),
        ("ann connects; eve connects; eve stops; ann lifts; eve stops", "held by ann, stop by eve"),
        ("ann connects; eve connects; eve stops; eve silent; 60 s", "held by ann, stop by eve"),
        ("ann connects; eve connects; moves; eve stops; ann silent; ann connects", "held by ann, stop by eve"),
        ("ann connects; eve connects; stands; eve stops; ann releases; 9 s", "free, stop by eve"),
        ("ann connects; bob connects; bob stops; ann offers bob; bob accepts", "held by bob, stop by bob"),
        ("ann connects; sue connects; moves; sue stops; sue takes", "held by sue, stop by sue"),
        ("@ann stop eve", "lost by ann, stop by eve"),
        ("@ann stop eve; ann connects; ann lifts", "held by ann"),
        ("@ stop eve; ann connects", "held by ann, stop by eve"),
    ],
)  # fmt: skip
def test_control_passes_only_as_it_may(story: str, ends: str) -> None:
    first, *words = story.split("; ")
    former, _, stop = first.removeprefix("@").partition("stop ")
    drive = Drive(former.strip(), stop=stop or None) if first.startswith("@") else Drive()
    for each in words if first.startswith("@") else (first, *words):
        assert drive.does(each) is None, each
    assert drive.words() == ends
    assert replayed(drive) == drive.run


BOTH = "ann connects; bob connects; eve connects; sue connects"


@pytest.mark.parametrize(
    ("story", "request_", "why"),
    [
        ("ann connects", "bob asks", "bob is not connected: an operator's side announces itself by operator_connected"),
        (BOTH, "eve asks", "a watcher may not request control_requested; only controller or supervisor may"),
        (BOTH, "bob takes", "a controller may not request control_taken; only supervisor may"),
        (BOTH, "bob offers sue", "only the operator in control may offer it: ann is in control"),
        (BOTH, "ann offers ann", "ann is in control already"),
        (BOTH, "ann offers eve", "eve is a watcher, control needs a controller or supervisor"),
        (BOTH, "ann offers max", "max is not connected"),
        (BOTH, "bob accepts", "control is not offered to bob: ann is in control"),
        (f"{BOTH}; ann offers bob", "sue accepts", "control is not offered to sue: ann is in control"),
        (f"{BOTH}; moves; ann offers bob", "bob accepts blind", f"live for 1 s at the station of bob: {CAMERAS[0]}"),
        (BOTH, "ann denies bob", "bob does not ask for control"),
        (f"{BOTH}; sue asks", "bob denies sue", "the operator in control may decline a request: ann is in control"),
        (BOTH, "bob releases", "bob has nothing to release: ann is in control"),
        (f"{BOTH}; moves; ann silent", "bob releases", "bob has nothing to release: ann is lost"),
        (f"{BOTH}; moves", "ann releases", "before its control is released: it moves at 29 km/h"),
        (f"{BOTH}; hides", "ann releases", "its speed is not known, which counts as moving"),
        (f"{BOTH}; moves; sue takes", "sue releases", "it moves at 29 km/h; or offer control"),
        (f"{BOTH}; moves; ann silent", "sue releases", "it moves at 29 km/h; or offer control"),
        (f"{BOTH}; moves; stands; moves; ann silent; bob asks", "bob offers ann", "may offer it: ann is lost"),
        ("eve connects; ann connects; stands; ann releases", "ann offers eve", "may offer it: nobody is in control"),
        ("ann connects", "eve stops", "eve is not connected"),
        (f"{BOTH}; eve stops", "eve lifts", "a watcher may not request stop_lifted; only controller or supervisor may"),
        (f"{BOTH}; bob stops", "bob lifts", "only the operator in control or a supervisor may lift it: ann"),
        (f"{BOTH}; ann stops; ann silent", "bob lifts", "or a supervisor may lift it: ann is lost"),
        (BOTH, "ann lifts", "nobody has asked the vehicle to stop"),
    ],
)  # fmt: skip
def test_a_request_that_may_not_be_is_refused_with_the_reason(story: str, request_: str, why: str) -> None:
    drive = Drive()
    for each in story.split("; "):
        assert drive.does(each) is None, each
    before = drive.driving
    assert why in (drive.does(request_) or "")
    assert drive.driving == before


def test_every_order_in_which_four_come_and_the_holder_goes() -> None:
    """The first that may drive does; once it is lost while moving, nobody does until a supervisor takes control."""
    for order in permutations(ROLES):
        drive = Drive()
        for name in order:
            drive.does(f"{name} connects")
        first, *others = (name for name in order if name != "eve")
        assert drive.words() == f"held by {first}"
        for words in ("moves", f"{first} silent", *(f"{name} asks" for name in others), "60 s"):
            drive.does(words)
        assert drive.words() == f"lost by {first}, requested by {' '.join(others)}"
        if first == "sue":
            continue
        drive.does("sue takes")
        assert drive.driving.in_control == "sue"


def test_a_vehicle_is_known_to_stand_only_by_fresh_reports() -> None:
    drive = Drive()
    drive.does("ann connects")
    assert not drive.driving.standing
    drive.speed = 0.29
    drive.wait(SLOW_S)
    assert not drive.driving.standing
    drive.wait(0.2)
    assert drive.driving.standing
    drive.speed = None
    drive.wait(KNOWN_S - 0.2)
    drive.take("position_reported", lat=48.26, lon=11.66)  # without a speed
    assert drive.driving.standing
    drive.wait(0.3)
    assert not drive.driving.standing
    drive.take("position_reported", lat=48.26, lon=11.66, speed_mps=0)
    assert drive.driving.standing, "as in all reports of the last seconds"
    drive.wait(SLOW_S)
    drive.take("position_reported", lat=48.26, lon=11.66, speed_mps=0)
    assert not drive.driving.standing, "it may have moved meanwhile"
    for speed in (0.3, 0.0, 0.3, 0.0):
        drive.speed = speed
        drive.wait(SLOW_S - 0.1)
        assert not drive.driving.standing


def test_an_offer_states_when_it_ends() -> None:
    drive = Drive()
    for words in ("ann connects", "bob connects", "5 s", "ann offers bob"):
        drive.does(words)
    assert drive.driving.offer_ends == pytest.approx(5 + OFFER_S)
    assert drive.driving.drivers == ("ann", "bob")


# --- at random --------------------------------------------------------------------------------------------------------

SEQUENCES, LENGTH = range(10_000), 24
FEWER = 1000  # of them without `make soak`
NAMES = tuple(ROLES)
DEEDS = (*["connects"] * 4, "silent", "quits", "expelled", "asks", "releases", "takes", "withdraws", *["stops"] * 2)


def replayed(drive: Drive) -> Run:
    """The run that results from the events as they are logged."""
    run = start(VEHICLE)
    for document in drive.events:
        run = step(VEHICLE, run, parse(to_json(parse(document))))
    return run


def happens(drive: Drive, chance: random.Random) -> tuple[str, str | None]:
    """Something, in words, and why it was refused."""
    kind, name = chance.random(), chance.choice(NAMES)
    if kind < 0.02 and drive.driving.requested:
        words = f"{drive.driving.holder or name} denies {drive.driving.requested[0]}"
    elif kind < 0.15:
        words = chance.choice(("0.5 s", "1 s", "3 s"))
    elif kind < 0.2 and drive.driving.stop:
        words = f"{chance.choice((name, drive.driving.in_control or name))} lifts"
    elif kind < 0.3:
        drive.speed = chance.choice((0.0, 0.1, 8.0, None))
        words = "0.5 s"
    elif kind < 0.45:
        words = f"{chance.choice((name, drive.driving.in_control or name))} offers {chance.choice(NAMES)}"
    elif kind < (0.8 if drive.driving.offered else 0.5):
        words = f"{chance.choice((name, drive.driving.offered or name))} accepts"
    else:
        words = f"{name} {chance.choice(DEEDS)}"
    return words, drive.does(words)


def restarted(drive: Drive) -> Drive:
    """The vehicle's next process: everybody has to connect again."""
    anew = Drive(drive.driving.holder or "", drive.tick_s, drive.driving.stop)
    anew.speed = drive.speed
    return anew


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [SEQUENCES[:FEWER], pytest.param(SEQUENCES[FEWER:], marks=pytest.mark.soak)], ids=len)
def test_random_sequences_keep_the_rules(seeds: range) -> None:
    """One holder; never made free while moving, but for a supervisor's word; every request answered; replays equal.

    A stop stands until its holder or a supervisor lifts it.
    """
    held, lost, freed, accepted, lifted = 0, 0, 0, 0, 0
    for seed in seeds:
        chance = random.Random(seed)
        drive = Drive(chance.choice(("", "", "ann")), tick_s=0.5)
        for _ in range(LENGTH):
            if chance.random() < 0.03:
                assert replayed(drive) == drive.run
                stop = drive.driving.stop
                drive = restarted(drive)
                assert drive.driving.stop == stop
                continue
            before = drive.driving
            words, refused = happens(drive, chance)
            check(before, drive, words, refused)
            now = drive.driving
            held, lost = held + (now.state is Control.HELD), lost + (now.state is Control.LOST)
            freed += before.state is not Control.FREE and now.state is Control.FREE
            accepted += words.endswith("accepts") and refused is None
            lifted += words.endswith("lifts") and refused is None
        assert replayed(drive) == drive.run, seed
    assert min(held, lost, freed, accepted, lifted) > len(seeds) / 25, "the sequences reach every state"


def check(before: Driving, drive: Drive, words: str, refused: str | None) -> None:
    now, motion, t = drive.driving, drive.run.state.motion, drive.run.state.t
    name, _, deed = words.partition(" ")
    if refused is not None:
        assert refused and now == before, words
    assert (now.holder is None) == (now.state is Control.FREE), words
    assert now.in_control in ("", *now.present), words
    if now.in_control:
        assert now.present[now.in_control] is not Role.WATCHER, words
    assert now.in_control not in now.requested and len(set(now.requested)) == len(now.requested), words
    assert (now.offered is None) == (now.offer_ends is None) and now.offered not in ("", now.in_control), words
    assert {now.offered, *now.requested} - {None} <= now.present.keys(), words
    assert (now.stop is None) == (now.stop_since is None), words
    if now.stop != before.stop:
        assert deed == ("stops" if before.stop is None else "lifts") and now.stop in (None, name), words
    if now.stop != before.stop and now.stop is None:
        assert name == before.in_control or now.present[name] is Role.SUPERVISOR, words
    changed = (now.state, now.holder) != (before.state, before.holder)
    if now.state is Control.FREE and before.state is not Control.FREE:
        vouches = deed == "releases" and now.present.get(name) is Role.SUPERVISOR and not motion.is_known(t)
        assert motion.stands(t) or vouches, words
    if changed and now.in_control and before.state is not Control.FREE and not motion.stands(t):
        assert deed in ("accepts", "takes", "connects", "releases"), words
        assert now.in_control == name or deed == "releases", words
        if deed == "connects":
            assert (before.state, before.holder) == (Control.LOST, name), words
        if deed == "accepts":
            assert before.offered == name, words
        if deed == "takes":
            assert now.present[name] is Role.SUPERVISOR, words
