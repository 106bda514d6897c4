"""What a station receives while pages come and go."""

from __future__ import annotations

from runner.operator.demand import LINGER_S, Demand
from runner.operator.station import Presence


def shown(demand: Demand, t: float, *, holds_control: bool = False) -> tuple[set[str], Presence]:
    return set(demand.cameras(t)), demand.presence(t, holds_control=holds_control)


def test_nothing_is_received_until_somebody_looks() -> None:
    assert shown(Demand(), 0.0) == (set(), Presence.ABSENT)
    assert shown(Demand(), 0.0, holds_control=True) == (set(), Presence.ABSENT)  # from an earlier run


def test_a_picture_is_watched_and_a_page_drives() -> None:
    demand = Demand()
    demand.ask(["front"], is_open=False, now=1.0)
    assert shown(demand, 60.0) == ({"front"}, Presence.WATCHING)
    demand.ask(["front", "rear"], is_open=True, now=61.0)
    assert shown(demand, 61.0) == ({"front", "rear"}, Presence.DRIVING)


def test_a_page_that_loads_again_interrupts_nothing() -> None:
    demand = Demand()
    demand.ask(["front", "rear"], is_open=True, now=0.0)
    demand.ask([], is_open=False, now=100.0)
    assert shown(demand, 100.0 + LINGER_S / 2) == ({"front", "rear"}, Presence.DRIVING)
    assert shown(demand, 100.0 + LINGER_S) == (set(), Presence.ABSENT)


def test_a_picture_beside_stays_when_the_page_is_closed() -> None:
    demand = Demand()
    demand.ask(["front", "rear"], is_open=True, now=0.0)
    demand.ask(["rear"], is_open=False, now=10.0)
    assert shown(demand, 10.0 + LINGER_S) == ({"rear"}, Presence.WATCHING)


def test_who_is_holds_control_does_not_leave_by_closing_the_page() -> None:
    demand = Demand()
    demand.ask(["front"], is_open=True, now=0.0)
    demand.ask([], is_open=False, now=1.0)
    assert shown(demand, 60.0, holds_control=True) == (set(), Presence.DRIVING)
    assert shown(demand, 61.0) == (set(), Presence.ABSENT)
