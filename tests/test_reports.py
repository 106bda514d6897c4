"""Reports of what peers can cause in any number."""

from __future__ import annotations

from runner.system.reports import LONGEST, MOST, MOST_OF_PEER, PERIOD_S, LimitedReports


def test_each_text_is_reported_once_and_only_so_many_in_a_period() -> None:
    lines: list[str] = []
    now = [0.0]
    report = LimitedReports(lines.append, lambda: now[0])
    for _ in range(1000):
        report("from 10.0.0.9: wrong token", "10.0.0.9")
    assert lines == ["from 10.0.0.9: wrong token"]
    for port in range(1000):
        report(f"from port {port}", "10.0.0.9")
    assert lines[1:] == [f"from port {port}" for port in range(MOST_OF_PEER - 1)]
    for peer in range(1000):
        report(f"from {peer}", str(peer))
    assert lines[MOST_OF_PEER:] == [f"from {peer}" for peer in range(MOST - MOST_OF_PEER)]


def test_what_goes_on_stays_visible_with_the_number_of_those_left_out() -> None:
    lines: list[str] = []
    now = [0.0]
    report = LimitedReports(lines.append, lambda: now[0])
    for _ in range(5):
        report("again", "peer")
    now[0] = PERIOD_S - 1
    report("again", "peer")
    now[0] = PERIOD_S
    report("again", "peer")
    assert lines == ["again", "5 similar reports were suppressed before this one", "again"]
    now[0] = 2 * PERIOD_S
    report("another", "peer")
    assert lines[3:] == ["another"]


def test_a_long_text_is_cut() -> None:
    lines: list[str] = []
    LimitedReports(lines.append)("x" * 100_000, "peer")
    assert [len(line) for line in lines] == [LONGEST]
