"""Simulated drives: links, predictions, encoders, and the whole loop."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from helpers import Command

from rig import children_named, until
from runner.configuration.config import configuration
from runner.core import commands as knobs
from runner.core.events import ClockAdvanced
from runner.drive.read import read_drive
from runner.drive.series import series
from runner.drive.statistics import statistics
from runner.link.bucket import Bucket
from runner.link.policer import Policer
from runner.simulation import drive, operator
from runner.simulation.encoder import Encoder, EncoderModel
from runner.simulation.families import FAMILIES, LEFT_OUT, generate
from runner.simulation.figures import cuts, percentile
from runner.simulation.predictions import prediction
from runner.simulation.queues import CreditQueue, OpportunityQueue, RateQueue
from runner.simulation.runs import CONFIGURED, SEEDS, Common, Job, jobs, run_job
from runner.simulation.steps import Steps
from runner.simulation.way import Put, merged

SHORT = Common(("vehicle=delivery_robot", "fps_max=15"), None)


@pytest.mark.parametrize("lowest, queue_ms, dropped", [(100, 60_000, 0), (0, 200, 283)])
def test_a_rate_queue_passes_packets_as_the_real_link_does(lowest: float, queue_ms: float, dropped: int) -> None:
    """The same packets leave at the same times as those of `link=`; where the queue is full, as many are dropped."""
    rates = Steps([0.0, 0.5, 0.8, 1.4], [2000.0, 400.0, lowest, 5000.0])
    simulated, real = RateQueue(rates, queue_ms), Bucket[int](2000.0, queue_ms, 0.0)
    changes, left, expected = [(t, rate) for t, rate in zip(rates.times, rates.values, strict=True) if t], {}, {}
    for number in range(600):
        t, size = 0.003 * number + 0.0001, 200 + 37 * number % 1300
        while changes and changes[0][0] <= t:
            at, rate = changes.pop(0)
            real.set_rate(rate, at)
        expected |= {item: when for when, item in real.take(t)}
        real.put(size, number, t)
        if (at := simulated.put(t, size)) is not None:
            left[number] = at
    expected |= {item: when for when, item in real.take(10.0)}
    assert (simulated.dropped, real.counters(10.0).dropped) == pytest.approx((dropped, dropped), rel=0.02)
    if not dropped:
        assert left == pytest.approx(expected, abs=1e-6)


def test_packets_are_delivered_at_the_end_of_their_slot() -> None:
    queue = RateQueue(Steps([0.0], [1200.0]), 300, bursts=False, slot_s=0.005)
    assert [queue.put(0.001, 300) for _ in range(3)] == pytest.approx([0.005, 0.005, 0.010])


def test_opportunities_that_find_no_packet_are_lost() -> None:
    queue = OpportunityQueue([0.001, 0.002, 0.010, 0.011], 300)
    assert [queue.put(0.0005, 1000), queue.put(0.0005, 1000)] == [0.001, 0.002]  # the second takes two opportunities
    assert [queue.put(0.003, 1500), queue.put(0.0105, 1500), queue.put(0.02, 100)] == [0.010, 0.011, None]


def test_a_scheduler_serves_saved_credit_faster_and_grants_late() -> None:
    queue = CreditQueue(Steps([0.0], [1200.0]), 300, peak=3, credit_s=0.01, grant_s=0.004)
    # A grant, 12 kbit saved, which are spent while 18 kbit leave at 3600 kbit/s; then 1200 kbit/s.
    assert queue.put(1.0, 2250) == pytest.approx(1.0 + 0.004 + 18 / 3600)
    assert queue.put(1.0, 1500) == pytest.approx(1.0 + 0.004 + 18 / 3600 + 12 / 1200)


def test_competing_flows_fill_the_link() -> None:
    """Alone; with the cameras they get what those leave."""
    flows = Common((*SHORT.overrides, "link=netns", "link.share=1", "link.tcp={flows: 1}"), None)
    shared = run_job(flows, Job("step", 0.0, "right", 1, 9.9)).figures  # at 4000 kbit/s
    assert 0.9 < shared["use"] + shared["tcp"] / 4000 < 1.05
    assert shared["tcp"] > 300


def test_losses_are_repaired_within_a_round_trip_and_shown_where_they_are_not() -> None:
    lossy = (*SHORT.overrides, "link=netns", "link.share=1", "link.loss=0.02")
    back = "link.reverse={kbps: 5000, queue_ms: 200, delay_ms: 15}"
    job = Job("step", 0.0, "right", 1, 12.0)
    repaired, never = (
        run_job(Common((*lossy, "link.delay_ms=15", back, f"graph.retransmission_ms={ms}"), None), job).figures
        for ms in (500, 0)
    )
    assert repaired["lost"] > 50 and never["lost"] > 50
    assert repaired["damaged"] < 0.1 * never["damaged"]


def test_predictions_are_wrong_as_named() -> None:
    capacity = Steps([0.0, 10.0], [2200.0, 4400.0])

    def predicted(kind: str, *times: float) -> list[float]:
        source = prediction(kind, capacity, 60.0, 1)
        seen = [source.observe(ClockAdvanced(t=t)) for t in times]
        return [float(one.kbps) for one in seen if one]

    assert predicted("right", 0, 9.9, 10) == [2000, 2000, 4000]
    assert predicted("high_50", 0, 10) == [3000, 6000] and predicted("low_30", 0) == [1400]
    assert predicted("late_2", 9.9, 11.9, 12) == [2000, 2000, 4000] and predicted("early_2", 7.9, 8) == [2000, 4000]
    assert predicted("absent", 0, 10) == []
    assert predicted("mixed", 0, 10, 60) == [2000, 2000, 4000]  # right, half, ..., right
    noise = predicted("noise", *range(10))
    assert len(set(noise)) == 10 and noise == predicted("noise", *range(10))


def test_an_encoder_follows_its_bitrate_and_gives_back_what_key_frames_took() -> None:
    camera = next(iter(configuration(SHORT.overrides, runnable=False).vehicle().cameras.values()))
    encoder = Encoder(camera, EncoderModel(noise=0, error=0, filled=1), random.Random(1))
    assert encoder.frame() == 0  # nothing is commanded
    for knob, value in (("sending", True), ("size", (480, 260)), ("bitrate", 1200)):
        encoder.turn(knobs.Command(camera.name, knob, value))
    sizes = [encoder.frame() for _ in range(30)]  # 10 kB each
    assert sizes[0] == 12_500 and sizes[1] == 8_500 and sum(sizes) == pytest.approx(300_000, rel=0.01)
    encoder.turn(knobs.Command(camera.name, "bitrate", 600))
    assert encoder.frame() == pytest.approx(5000, rel=0.01)
    encoder.turn(knobs.Command(camera.name, "bitrate", 1200))
    assert [encoder.frame() for _ in range(3)] == pytest.approx([5000, 8000, 9200], rel=0.01)
    encoder.turn(knobs.Command(camera.name, "size", (240, 130)))
    assert encoder.frame() > 11_000
    encoder.turn(knobs.Command(camera.name, "sending", False))
    assert encoder.frame() == 0


@pytest.mark.gst
def test_what_is_modelled_has_the_numbers_of_the_real_sides() -> None:
    """Some modules of the real sides need GStreamer, so the models state these numbers again."""
    from runner.gst import arriving, repair
    from runner.operator import live
    from runner.vehicle import loop

    assert (drive.TICK_S, drive.TELEMETRY_S) == (loop.TICK_S, loop.TELEMETRY_TICKS * loop.TICK_S)
    assert drive.REPORT_S == live.REPORT_S
    assert (operator.TAIL_S, 1000 * operator.REORDER_S) == (arriving.TAIL_S, repair.REORDER_MS)
    assert (*(repair.ATTEMPTS, repair.CONGESTED, repair.CLEAR, repair.DECAY),) == (
        operator.ATTEMPTS,
        operator.CONGESTED,
        operator.CLEAR,
        operator.DECAY,
    )
    assert (1000 * operator.INITIAL_RTT_S, 1000 * operator.LONGEST_WAIT_S) == (repair.INITIAL_RTT_MS, repair.LONGEST_MS)


def test_a_frame_over_two_ways_lacks_what_both_lost_and_is_whole_with_the_first_whole_copy() -> None:
    def put(last: float, *lost: int) -> Put:
        missing = dict.fromkeys(lost, 100)
        return Put(4 - len(lost), 400 - 100 * len(lost), 50, last - 0.01, last, last - 0.02, (0, 0), missing, 0)

    assert merged([put(1.0), put(2.0)]) == put(1.0)._replace(carried=100)
    assert merged([put(1.0, 1), put(2.0)]) == put(2.0)._replace(carried=100, first=0.99)
    both = merged([put(1.0, 1, 3), put(2.0, 0, 3)])
    assert (both.packets, both.bytes, both.missing, both.tail, both.last) == (3, 300, {3: 100}, 1, 2.0)


def test_a_cut_of_one_of_two_uplinks_loses_nothing_of_redundant_cameras() -> None:
    uplinks, rate = "uplinks={a: {interface: a}, b: {interface: b}}", "link.lanes={a: {kbps: 5000}, b: {kbps: 4000}}"
    cut = "link.cuts=[{lane: a, at_s: 6, for_s: 4, how: silence}]"
    words = (*SHORT.overrides, uplinks, "link=netns", "link.delay_ms=15", rate, cut)
    job = Job(CONFIGURED, 0.0, "absent", 1, 14.0)

    def driven(*more: str) -> tuple[float, float]:
        figures = run_job(Common((*words, *more), None), job).figures
        return figures["camera"], figures["lost"]

    names = configuration(SHORT.overrides, runnable=False).vehicle().cameras
    assert driven(*(f"++cameras.{name}.redundant=true" for name in names)) == (0, 0)
    frozen, lost = driven()  # until the stall is noticed
    assert frozen < 4 and lost > 0
    frozen, _ = driven("~uplinks.b")  # 4 of 11 s
    assert frozen > 35


def test_links_of_several_uplinks_are_named_together() -> None:
    named = (*SHORT.overrides, "uplinks={a: {interface: w0}, b: {interface: w1, pqos: {kind: live}}}")
    result = run_job(Common(named, None), Job("saw+step", 0.0, "right", 1, 9.0), keep=True)
    both = [generate(name, seed, 20) for name, seed in (("saw", 1), ("step", 1 + SEEDS))]
    assert result.job.link_name == "saw+step" and result.uplinks == 2
    assert result.drive and all(result.drive.capacity.at(t) == sum(one.at(t) for one in both) for t in (0, 3.3, 8))


def test_ctrl_c_ends_every_process() -> None:
    words = (sys.executable, "-m", "runner", "simulate", *SHORT.overrides, "seeds=50", "workers=2")
    with subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as child:
        assert child.stderr and "simulated: 0%" in child.stderr.readline()
        until(lambda: len(children_named(child.pid, "python")) > 2)  # workers, and one that tracks their resources
        started = children_named(child.pid, "python")
        child.send_signal(signal.SIGINT)
        assert child.wait(timeout=20) == 130
    until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in started))


def test_a_policer_drops_what_exceeds_its_rate() -> None:
    policer = Policer(800, 64)  # 6400 bytes deep
    assert [policer.passes(1600, 0.0) for _ in range(5)] == [True] * 4 + [False]
    assert [policer.passes(1600, t) for t in (0.015, 0.016)] == [False, True]


def test_links_are_generated_by_their_seed() -> None:
    for name in (*FAMILIES, *LEFT_OUT):
        assert generate(name, 3, 20).values == generate(name, 3, 20).values
        assert len(generate(name, 3, 20).times) == 200
    for name in ("markov", *LEFT_OUT):
        assert generate(name, 3, 20).values != generate(name, 4, 20).values


def test_cuts_are_falls_within_a_short_time() -> None:
    assert list(cuts([(0, 1000), (1.0, 900), (1.1, 840)])) == [1.1]
    assert list(cuts([(0, 1000), (1.0, 900), (1.3, 840)])) == []
    assert list(cuts([(0, 1000), (1.0, 800), (1.1, 600), (1.2, 400), (2, 300)])) == [1.0, 2]


def test_percentiles_are_values() -> None:
    assert [percentile([1, 2, 3, 4], share) for share in (0, 50, 95, 99)] == [1, 3, 4, 4]


def test_a_drive_is_the_same_with_the_same_seed() -> None:
    job = Job("gauss_0.5_1", 0.0, "absent", 1, 6.0)
    first, second, other = (run_job(SHORT, one).figures for one in (job, job, job._replace(seed=2)))
    assert first == second and first != other


def test_a_simulated_drive_is_a_drive(tod: Command, tmp_path: Path) -> None:
    """It replays to the same decisions, also from its reception reports, and a report reads it."""
    path, lossy = tmp_path / "drive", ("link=netns", "link.loss=0.02", "link.delay_ms=20")
    words = ("vehicle=delivery_robot", "fps_max=15", "links=markov", "predictions=late_1", "duration_s=8")
    result = tod("simulate", *words, *lossy, f"log={path}")
    assert result.status == 0 and "| markov | late_1 | 1 |" in result.out
    for number, link in enumerate(("logged", "again")):
        again = tmp_path / str(number)
        assert tod("replay", f"input={path}", f"link={link}", f"log={again}").status == 0
        assert _decisions(again) == _decisions(path)
    measured = statistics(series(read_drive(path), "drive"))
    assert 0.85 < measured.share < 1.05  # of the allocated bitrate is received
    assert all(110 <= camera.frames <= 119 for camera in measured.cameras.values())


def _decisions(directory: Path) -> list[str]:
    lines = (directory / "drive.jsonl").read_text().splitlines()
    return [line for line in lines if json.loads(line).get("log") == "decision"]


def test_the_link_of_a_drive_is_driven_again(tod: Command, tmp_path: Path) -> None:
    job = Job("saw", 0.0, "absent", 1, 6.0)
    run_job(SHORT, job, log=(tmp_path / "drive", 0.0))
    again = jobs(replace(SHORT, duration_s=5.0), [str(tmp_path / "drive")], ["right"], [1], 6)
    assert [one.link_name for one in again] == ["drive"]
    driven, link = run_job(SHORT, again[0], keep=True).drive, generate("saw", 1, 10)
    assert driven and all(driven.capacity.at(t) == link.at(t + 0.1) for t in (0, 1.1, 3.9, 4.5))  # logged from 0.1 s on
    other = (tmp_path / "drive").rename(tmp_path / "other")
    (other / "link.jsonl").unlink()
    result = tod("simulate", f"links={other}")
    expected = "has no rates in link.jsonl: must be a drive over a limited link, which link= sets"
    assert (result.status, result.err) == (2, f"{other}: {expected}\n")
