"""The belief about the uplink: what frames tell, what predictions are worth, policers, and the loop."""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, inf, isfinite, isnan, log
from pathlib import Path

import pytest
from helpers import Drive
from hypothesis import given
from hypothesis import strategies as st

from runner.core import belief
from runner.core.events import Evidence
from runner.core.evidence import EvidenceMemory, LinkReport, ReceivedUnit, observe, rounded
from runner.core.learned import Learned
from runner.core.policer import Losses, Policer, police
from runner.drive.predictions import compared, worth
from runner.drive.read import read_drive
from runner.drive.series import series
from runner.simulation.figures import Figures
from runner.simulation.runs import Common, Job, run_job

KBIT = 8 / 1000
PATH_S = 0.03
WORDS = ("modes=safe", "vehicle=delivery_robot", "fps_max=15")


def unit(camera: str, captured: float, arrived: float, size: int = 5000, train_s: float = 0.0) -> ReceivedUnit:
    return ReceivedUnit(camera, captured, arrived, size, train_s=train_s, train=size - 1250 if train_s else 0)


def seen(*units: ReceivedUnit, lost: int = 0) -> Evidence:
    """Evidence of frames that arrive after one of each camera that met no queue."""
    names = dict.fromkeys(one.camera for one in units)
    first = [unit(name, 0.9 + 0.03 * n, 0.9 + 0.03 * n + PATH_S) for n, name in enumerate(names)]
    memory, _ = observe(EvidenceMemory(), LinkReport(0.98, tuple(first), len(first)))
    _, evidence = observe(memory, LinkReport(1.1, units, 4 * len(units), lost))
    assert evidence
    return evidence


def test_a_frame_that_found_the_link_busy_tells_its_rate() -> None:
    """The second was captured before the first had arrived: the link needed 20 ms for its 40 kbit."""
    evidence = seen(unit("front", 1.0, 1.04), unit("rear", 1.005, 1.06))
    assert evidence.busy_kbit / evidence.busy_s == pytest.approx(40 / 0.02)
    assert (evidence.unqueued, evidence.wait_s) == (1, pytest.approx(0.01))


def test_the_packets_of_one_frame_tell_the_rate_without_any_queue() -> None:
    evidence = seen(unit("front", 1.0, 1.0 + PATH_S + 0.015, train_s=0.015))
    assert (evidence.busy_kbit, evidence.idle) == (0.0, 1)
    assert evidence.idle_kbit / evidence.idle_s == pytest.approx(3750 * KBIT / 0.015)


def test_frames_with_missing_packets_are_no_evidence() -> None:
    damaged = ReceivedUnit("rear", 1.005, 1.06, 3000, whole=False)
    evidence = seen(unit("front", 1.0, 1.04), damaged, lost=2)
    assert (evidence.busy_kbit, evidence.unqueued) == (0.0, 1)
    assert evidence.lost_kbit == pytest.approx(2 / 8 * evidence.kbit)


def test_a_frame_that_was_sent_late_does_not_shorten_its_path() -> None:
    """It came 20 ms later than usual, and states 50: the next ones would seem to wait for good."""
    memory, _ = observe(EvidenceMemory(), LinkReport(0.98, (unit("front", 0.9, 0.9 + PATH_S),), 4))
    late = ReceivedUnit("front", 1.0, 1.0 + PATH_S + 0.02, 5000, late=0.05)
    memory, _ = observe(memory, LinkReport(1.06, (late,), 4))
    _, evidence = observe(memory, LinkReport(1.14, (unit("front", 1.1, 1.1 + PATH_S),), 4))
    assert evidence
    assert evidence.wait_s == pytest.approx(0.0)


def test_what_a_stalled_link_releases_is_no_evidence() -> None:
    """Nothing came for a second; then three frames at once."""
    memory, _ = observe(EvidenceMemory(), LinkReport(0.2, (unit("front", 0.0, 0.03),), 4))
    silent, _ = observe(memory, LinkReport(0.96, ()))
    silent, before = observe(silent, LinkReport(1.0, ()))
    assert before
    assert before.silent_s == pytest.approx(1.0 - 0.03 - 0.12)
    burst = tuple(unit("front", 0.1 * n, 1.02 + 0.001 * n) for n in (1, 2, 3))
    _, evidence = observe(silent, LinkReport(1.04, burst, 12))
    assert evidence
    assert (evidence.busy_kbit, evidence.idle_kbit, evidence.backlog) == (0, 0, True)


def test_a_clock_that_is_set_back_starts_anew() -> None:
    memory, _ = observe(EvidenceMemory(), LinkReport(0.2, (unit("front", 5.0, 0.1),), 4))
    _, evidence = observe(memory, LinkReport(0.3, (unit("front", 1.0, 0.2), unit("front", 1.05, 0.25)), 8))
    assert evidence
    assert evidence.wait_s == 0


# --- predictions ------------------------------------------------------------------------------------------------------


def learn(changes: Sequence[tuple[float, float]], level: float = 0.0) -> Learned:
    """What is learned if, each second, the prediction changes by the first and the capacity by the second, ln."""
    known, levels, x, p = Learned(8.0).stated(0.0, 8.0), ((0.0, 8.0 + level),), 8.0 + level, 8.0
    for second, (predicted, came) in enumerate(changes):
        x, p = x + came, p + predicted
        for n in range(25):
            t = second + 1 + 0.04 * n
            if n == 0:
                known = known.stated(t, p)
            levels = (*levels[-30:], (t, x if n > 2 else x - came))
            known = known.judged(t, 0.04, levels)
    return known


def test_changes_that_come_true_are_followed() -> None:
    assert learn([(0.5, 0.5), (-0.5, -0.5)] * 8).gain == pytest.approx(1, abs=0.1)


def test_changes_that_never_come_true_are_not_followed() -> None:
    assert learn([(0.5, 0.0), (-0.5, 0.0)] * 8).gain < 0.1


def test_a_level_that_is_wrong_is_corrected() -> None:
    known = learn([(0.0, 0.0)] * 40, level=0.7)  # twice what was predicted
    assert known.bias == pytest.approx(0.7, abs=0.05)
    assert known.error < 0.02
    m, v = known.followed(8.7, 0.01, 8.1)
    assert m == pytest.approx(8.8, abs=0.03)
    assert v < 0.02  # how far it moved is uncertain


def test_what_a_source_states_of_its_predictions_holds_until_they_have_been_compared() -> None:
    b = belief.begin(0.0, 1500, 30_000, 3000, bias=0.2, error=0.1)
    assert (b.kbps, b.v) == (pytest.approx(3000 * exp(0.2)), pytest.approx(0.01))
    later = belief.predict(belief.begin(0.0, 1500, 30_000, None), 1.0, 3000, bias=0.2, error=0.1)
    assert (later.learned.bias, later.learned.error) == (0.2, pytest.approx(0.01))
    known = learn([(0.0, 0.0)] * 40, level=0.7)
    assert known.starting(0.2, 0.1) == known
    assert known.is_level_known
    assert not known.is_gain_known, "no prediction has changed"


# --- policers ---------------------------------------------------------------------------------------------------------


NONE = Policer()


def sent(rate: float, seconds: float, kbps: float = inf, share: float = 0.0, start: Policer = NONE) -> Policer:
    """What is learned while so much is sent, or less if a policer is assumed, over a link that drops a share, too."""
    policer, recent = start, [(0.0, 0.0)] * 50
    for n in range(int(seconds * 25)):
        now = min(rate, 0.95 * policer.kbps)
        passed = min(now, kbps) * (1 - share)
        recent = [*recent[1:], (passed / 25, (now - passed) / 25)]
        later = [one for at, one in zip(range(n - 49, n + 1), recent, strict=True) if at / 25 > policer.since]
        total, lost = (sum(one[i] for one in later) for i in (0, 1))
        received = sum(one[0] for one in recent[-12:]) * 25 / min(n + 1, 12)
        policer = police(policer, n / 25, Losses(*recent[-1], total, lost, received, False, 0.04))
    return policer


def test_losses_that_end_when_less_is_sent_are_a_policer() -> None:
    policer = sent(3000, 4, kbps=2000)
    assert policer.proven
    assert policer.kbps == pytest.approx(2000, rel=0.1)


@pytest.mark.parametrize("share", [0.01, 0.03, 0.06])
def test_losses_that_do_not_depend_on_the_rate_are_the_paths(share: float) -> None:
    assert sent(3000, 10, share=share).kbps == inf


def test_a_policer_that_has_gone_is_forgotten() -> None:
    policer = sent(3000, 4, kbps=2000)
    assert sent(3000, 4.9, start=policer._replace(since=0.0)).kbps == policer.kbps  # 5 s until more is tried
    assert sent(3000, 15, start=policer._replace(since=0.0)).kbps == inf
    failed = sent(3000, 9, kbps=2000)
    assert sent(3000, 29, start=failed._replace(since=0.0)).kbps == failed.kbps  # then 30 s


# --- the decision -----------------------------------------------------------------------------------------------------


@st.composite
def evidences(draw: st.DrawFn) -> Evidence:
    amount, short = st.floats(0, 1e5), st.floats(0, 10)
    busy, trains, idle = draw(st.booleans()), draw(st.integers(0, 20)), draw(st.integers(0, 20))
    return Evidence(
        busy_kbit=draw(st.floats(1e-3, 1e5)) if busy else 0.0,
        busy_s=draw(st.floats(1e-6, 10)) if busy else 0.0,
        train_kbit=draw(st.floats(1e-3, 1e5)) if trains else 0.0,
        train_s=draw(st.floats(1e-6, 10)) if trains else 0.0,
        trains=trains,
        idle_kbit=draw(st.floats(1e-3, 1e5)) if idle else 0.0,
        idle_s=draw(st.floats(1e-6, 10)) if idle else 0.0,
        idle=idle,
        unqueued=draw(st.integers(0, 20)),
        kbit=draw(amount),
        wait_s=draw(short),
        growth=draw(st.floats(-100, 100)),
        lost_kbit=draw(amount),
        age_s=draw(st.floats(0, 100)),
        silent_s=draw(st.one_of(st.just(0.0), short)),
        backlog=draw(st.booleans()),
    )


@given(st.lists(st.tuples(evidences(), st.floats(0, 3), st.one_of(st.none(), st.floats(0, 1e6))), max_size=60))
def test_no_sequence_of_reports_breaks_the_total(reports: list[tuple[Evidence, float, float | None]]) -> None:
    b, t = belief.begin(0.0, 1000, 30_000, None), 0.0
    for evidence, after_s, prediction in reports:
        t += after_s
        b = belief.decide(
            belief.observe(belief.predict(b, t, prediction), t, evidence, 0.03), t, evidence.silent_s, 200, 9e3
        )
        assert 50 <= b.total <= 9e3
        assert 0 < b.v <= 1
        assert all(isfinite(value) for value in (b.m, b.v, b.noise, b.best, b.queue, b.learned.bias, b.learned.error))


@given(st.lists(st.tuples(evidences(), st.floats(0, 3), st.integers(0, 20_000)), max_size=20))
def test_no_report_takes_the_total_above_an_enforced_prediction(reports: list[tuple[Evidence, float, int]]) -> None:
    drive, t = Drive("vehicle=delivery_robot", "modes.automatic.follow_link.ceiling=prediction"), 0.0
    drive.accept("operator_connected")
    for evidence, after_s, predicted in reports:
        t += after_s
        drive.accept("bitrate_predicted", t=t, kbps=predicted)
        assert 0 <= drive.reports(t, 1000, **rounded(evidence)._asdict()) <= predicted


def test_a_total_is_never_above_its_ceiling_nor_what_cameras_can_use() -> None:
    b = belief.begin(0.0, 30_000, 20_000, None)
    assert belief.decide(b, 0.0, 0.0).total == 20_000
    assert belief.decide(b, 0.0, 0.0, ceiling=4000).total == 4000


def test_while_no_report_comes_the_total_halves_and_is_back_with_the_next() -> None:
    b = belief.observe(belief.begin(0.0, 4000, 20_000, 4000), 1.0, Evidence(kbit=160), 0.03)
    before, after = (belief.decide(b, t, 0.0).total for t in (1.25, 1.7))
    assert after == pytest.approx(before / 4, rel=0.01)
    assert belief.decide(belief.observe(b, 1.8, Evidence(kbit=160), 0.03), 1.8, 0.0).total == pytest.approx(
        before, rel=0.01
    )


# --- the loop ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def constant(tmp_path: Path) -> Path:
    path = tmp_path / "constant.csv"
    path.write_text("t_s,kbps\n0,4000\n100,4000\n")
    return path


def drive(link: Path | str, prediction: str, *words: str, seconds: float = 25) -> Figures:
    return run_job(Common((*WORDS, *words), None), Job(str(link), 0.0, prediction, 1, seconds)).figures


@pytest.mark.slow
@pytest.mark.parametrize("prediction", ["right", "low_50", "high_50", "absent"])
def test_a_steady_link_is_used_whatever_is_predicted(constant: Path, prediction: str) -> None:
    figures = drive(constant, prediction)
    assert figures["use"] >= 0.85
    assert figures["p95"] <= 60


@pytest.mark.slow
def test_a_wrong_prediction_costs_little_against_none() -> None:
    none = drive("gauss_0.5_5", "absent")
    for prediction in ("low_50", "high_50", "noise"):
        figures = drive("gauss_0.5_5", prediction)
        assert figures["use"] >= none["use"] - 0.05, prediction
        assert figures["p95"] <= none["p95"] + 25, prediction


@pytest.mark.slow
def test_a_drive_tells_what_its_predictions_were_worth(tmp_path: Path) -> None:
    place = (tmp_path / "drive", 1.77e9)
    run_job(Common(WORDS, None), Job("saw", 0.0, "high_50", 1, 30), False, place)
    done = series(read_drive(place[0]))
    both = compared(done)
    assert both and done.believed
    found = worth(both)
    assert found.bias == pytest.approx(-log(1.5), abs=0.15)
    assert isnan(done.believed.bias[0])
    assert done.believed.bias[-1] == pytest.approx(found.bias, abs=0.2), "as was known while driving"


@pytest.mark.slow
@pytest.mark.parametrize("depth_ms", [64, 256])
def test_a_policer_is_found_and_kept_below(tmp_path: Path, depth_ms: int) -> None:
    (wide := tmp_path / "wide.csv").write_text("t_s,kbps\n0,20000\n100,20000\n")
    words = (f"+link.policer={{kbps: 2000, depth_ms: {depth_ms}}}",)
    after, whole = (drive(wide, "absent", *words, seconds=seconds) for seconds in (5, 35))
    assert whole["use"] * 20_000 >= 0.85 * 2000
    assert whole["lost"] - after["lost"] < 0.04 * 30 * 2000 / 10  # trials included


@pytest.mark.slow
def test_random_loss_is_repaired_and_causes_no_cut(constant: Path) -> None:
    words = ("link.delay_ms=50", "link.reverse.delay_ms=50")
    clean, lossy = (drive(constant, "right", f"link.loss={loss}", *words, seconds=30) for loss in (0, 0.02))
    assert lossy["cuts"] <= clean["cuts"] + 1  # in half a minute
    assert lossy["use"] >= clean["use"] - 0.03
