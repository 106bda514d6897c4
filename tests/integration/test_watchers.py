"""Ten people watch at the page of one operator, over the network, and the vehicle sends no more than without them."""

from __future__ import annotations

import threading
from contextlib import ExitStack

import pytest
from visitors import OPERATOR, driver, issue, page, uplink_bytes, vehicle, watching

from rig import needs_root, small_robot, until
from runner.core.roles import Role
from runner.operator.live import live_operator
from runner.operator.station import Listener
from runner.security.page_people import change_people

pytestmark = [pytest.mark.gst, needs_root]
CAMERAS = ("front", "rear", "mast")
TEN = [f"watcher{number}" for number in range(10)]
WORDS = (*small_robot(*CAMERAS), "source=test", "fps_max=10", "modes=open_loop", "pqos=constant", "pqos.kbps=900")
UNITS = 50  # of each camera, over which the uplink is measured


@pytest.fixture
def keys(tmp_path):
    return issue(tmp_path / "keys")


class Notes(Listener):
    """What an operator is told."""

    def __init__(self, texts):
        self._texts = texts

    def on_note(self, note):
        self._texts.append(note.text)


def bytes_for_each_unit(watcher, words):
    """What the uplink carries for each unit that reaches the driver, whose number depends on the machine's load."""

    def units():
        return sum(seen.units for seen in watcher.seen().values())

    first, before = units(), uplink_bytes(words)
    until(lambda: units() > first + UNITS * len(CAMERAS), every_s=0.1)
    return (uplink_bytes(words) - before) / (units() - first)


def test_ten_watchers_load_the_uplink_no_more_than_none_and_nobodys_pictures_stop(keys, tmp_path):
    people = change_people(tmp_path / "people", dict.fromkeys(TEN, Role.WATCHER))
    with vehicle(keys, *WORDS) as (words, _), page(keys, tmp_path / "people", words) as at, driver(at) as watcher:
        until(lambda: len(watcher.seen()) == len(CAMERAS), seconds=60)
        without = bytes_for_each_unit(watcher, words)
        with watching(at, people) as ten:

            def counted():
                seen = ten.lines[-1] if ten.lines else {}
                return {(name, camera): each.units for name, of in seen.items() for camera, each in of.items()}

            until(lambda: len(counted()) == len(TEN) * len(CAMERAS), seconds=60)
            before = counted()
            while_they_watch = bytes_for_each_unit(watcher, words)
            until(lambda: all(counted()[one] > units + UNITS / 2 for one, units in before.items()))
        assert while_they_watch < 1.1 * without


def test_who_is_refused_pictures_is_told_why_and_sees_them_once_there_is_room(keys):
    """Their pages and tables show the same words, and no failure of the network."""
    notes, output = {name: [] for name in ("bob", "carol")}, []
    with vehicle(keys, *WORDS) as (words, child), ExitStack() as others:
        threading.Thread(target=lambda: output.extend(child.stdout), daemon=True).start()

        def operating(name, stack):
            operator = stack.enter_context(live_operator([*words, f"keys={keys / name}"]))
            operator.station.listeners.append(Notes(notes.setdefault(name, [])))
            operator.start()
            return operator.station

        def refused(station):
            return {row.refused for row in station.rows()}

        def sees(station):
            return refused(station) == {""} and all(row.received.frames for row in station.rows())

        def told(station, name, why):
            until(lambda: any("refused by the vehicle: " in note for note in notes[name]), seconds=60)
            assert not [note for note in notes[name] if "Could not write" in note or "no frame" in note]
            until(lambda: refused(station) == {why}, seconds=60)  # of all cameras, not only the first that was noted

        with ExitStack() as first:
            alice = operating(OPERATOR, first)
            until(lambda: sees(alice), seconds=60)
            bob, carol = (operating(name, others) for name in ("bob", "carol"))
            told(bob, "bob", "a watcher gets no copy over the uplink: media.watcher_copies")
            told(carol, "carol", "one viewer per camera: media.max_viewers; alice watches")
            assert any("refused the viewer at" in line and "(carol): one viewer" in line for line in output)
            assert sees(alice)
        until(lambda: sees(carol), seconds=60)
        assert "a watcher" in min(refused(bob))
