"""Reports of what peers can cause in any number."""

from __future__ import annotations

from runner.system.reports import LONGEST, MOST, PERIOD_S, LimitedReports


def test_each_text_is_reported_once_and_only_so_many_in_a_period() -> None:
    lines: list[str] = []
    now = [0.0]
    report = LimitedReports(lines.append, lambda: now[0])
    for _ in range(1000):
        report("from 10.0.0.9: wrong token")
    assert lines == ["from 10.0.0.9: wrong token"]
    for port in range(1000):
        report(f"from port {port}")
    assert lines[1:] == [f"from port {port}" for port in range(MOST - 1)]


def test_what_goes_on_stays_visible_with_the_number_of_those_left_out() -> None:
    lines: list[str] = []
    now = [0.0]
    report = LimitedReports(lines.append, lambda: now[0])
    for _ in range(5):
        report("again")
    now[0] = PERIOD_S - 1
    report("again")
    now[0] = PERIOD_S
    report("again")
    assert lines == ["again", "5 more such reports were left out before this one", "again"]
    now[0] = 2 * PERIOD_S
    report("another")
    assert lines[3:] == ["another"]


def test_a_long_text_is_cut() -> None:
    lines: list[str] = []
    LimitedReports(lines.append)("x" * 100_000)
    assert [len(line) for line in lines] == [LONGEST]
