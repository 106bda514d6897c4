"""A check that comes late judges nothing, once."""

from runner.system.held_up import LateCheck


def test_a_late_check_is_excused_once() -> None:
    late = LateCheck()
    assert late.is_excused(10.0)  # nothing was checked before
    assert not late.is_excused(10.25)
    assert not late.is_excused(11.0)
    assert late.is_excused(12.0)
    assert not late.is_excused(12.25)


def test_a_process_that_is_always_late_judges_every_other_time() -> None:
    late = LateCheck()
    assert [late.is_excused(2.0 * number) for number in range(6)] == [True, False] * 3
