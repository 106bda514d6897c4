"""The measured link between real sides: reports arrive, the total follows what the link carries, replay repeats it."""

from __future__ import annotations

import signal
import time
from collections import Counter
from itertools import pairwise
from statistics import median

import pytest

from rig import NOISE, ROBOT_SIZES, SMALL_ROBOT, Operator, free_port, needs_root, process, run
from runner.core.belief import ABSENT_S
from runner.core.events import LinkMeasured, LinkState, OperatorConnected
from runner.drive.read import read_drive
from runner.records.decisions import DecisionMade
from runner.records.lines import LinkSample
from runner.records.reception import ReceptionReported

pytestmark = [
    pytest.mark.gst,
    pytest.mark.alone,
]  # load delays packets, and so lowers the measured link

ROBOT = (*SMALL_ROBOT, "fps_max=15", "page.serve=false", "pqos=constant", "pqos.kbps=4000")
SECONDS, SETTLED_S = 12, 6
PAUSES, PAUSE_S = 3, 0.2


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A drive over a link that carries half of the predicted bitrate."""
    path = tmp_path_factory.mktemp("feedback") / "drive"
    ports = (f"media.port={free_port()}", f"control.port={free_port()}")
    link = ("link=relay", "link.share=0.5")
    done = run("demo", *ROBOT, *NOISE, *ports, *link, f"log={path}", f"duration_s={SECONDS}")
    assert done.returncode == 0, done.stderr
    return path


def test_reports_reach_the_vehicle_and_measure_the_link(drive):
    vehicle = read_drive(drive).sides["vehicle"]
    reports = list(vehicle.of(ReceptionReported))
    assert len({report.operator for report in reports}) == 1
    assert all(report.in_control for report in reports[1:])
    times = [report.t for report in reports]
    assert len(times) > 10 * (times[-1] - times[0])  # 25 a second, unless the machine is busy
    units = [unit for report in reports for unit in report.report.units]
    assert {unit.camera for unit in units} == {"front", "rear", "mast"}
    measured = list(vehicle.of(LinkMeasured))
    assert LinkState.FILLING in {link.state for link in measured}
    settled = [float(link.kbps) for link in measured if link.t > SETTLED_S and link.kbps]
    assert 1000 < median(settled) < 2100  # the link carries 2000


def test_the_vehicle_knows_its_operator_before_pictures_fill_the_link(drive):
    """So it starts at half of the predicted bitrate."""
    sides = read_drive(drive).sides
    vehicle, link = sides["vehicle"], sides["link"]
    connected = next(vehicle.of(OperatorConnected)).t
    ahead_s = link.began.time - vehicle.began.time
    passed = [line.bytes for line in link.of(LinkSample) if line.t + ahead_s < connected]
    assert max(passed, default=0) < 20_000
    first = next(line for line in vehicle.of(DecisionMade) if line.t >= connected)
    assert first.total_kbps <= 2000
    assert "the link has not been measured yet" in first.cameras["front"].reason


def test_the_total_follows_what_the_link_carries(drive):
    sides = read_drive(drive).sides
    decisions = [line for line in sides["vehicle"].of(DecisionMade) if line.t > SETTLED_S]
    assert decisions
    assert median(line.total_kbps for line in decisions) < 2200  # of 4000 predicted, over a link of 2000
    assert any("capacity of the link" in line.cameras["front"].reason for line in decisions)
    link = list(sides["link"].of(LinkSample))
    late = [line for line in link if line.t > SETTLED_S]
    carried = (late[-1].bytes - late[0].bytes) * 8 / 1000 / (late[-1].t - late[0].t)
    assert carried > 0.6 * 2000
    assert late[-1].dropped - late[0].dropped < 0.05 * (late[-1].packets - late[0].packets)


def test_a_replay_measures_the_link_again_bit_for_bit(drive):
    logged, again = (run("replay", f"input={drive}", f"link={link}") for link in ("logged", "again"))
    assert (logged.returncode, again.returncode) == (0, 0), again.stderr
    assert "link_measured" in logged.stdout
    assert again.stdout == logged.stdout


@pytest.mark.parametrize(
    "kind", [pytest.param("netns", marks=needs_root), pytest.param("relay", marks=[pytest.mark.soak])]
)
def test_frames_tell_the_rate_of_a_link_that_they_do_not_fill(kind, tmp_path):
    """Each as a train of packets, and by what the link carried since the frame before, if it was still busy then."""
    for attempt in range(3):
        trains, busy = rates(kind, tmp_path / str(attempt))
        if len(busy) > 15:
            break  # otherwise the cameras' phases, which chance decides, are apart
    assert min(len(trains), len(busy)) > 15
    assert (median(trains), median(busy)) == pytest.approx((4000, 4000), rel=0.1)


def rates(kind, path):
    """Of trains, and of frames that found the link busy, kbit/s, over a link of 4000."""
    words = ("fps_max=5", "modes=open_loop", "pqos.kbps=3200", f"link={kind}", "link.share=1.25", "duration_s=6")
    ports = (f"media.port={free_port()}", f"control.port={free_port()}")
    done = run("demo", *ROBOT, *NOISE, *ports, *words, f"log={path}")
    assert done.returncode == 0, done.stderr
    reports = [line.report for line in read_drive(path).sides["vehicle"].of(ReceptionReported) if line.t > 2]
    units = [(report.at - unit.ago_s, unit) for report in reports for unit in report.units]
    shortest = {name: min(u.delay_s - u.train_s for _, u in units if u.camera == name) for name in ROBOT_SIZES}
    trains = [kbps(u.train_packets, u.train_bytes, u.train_s) for _, u in units if u.whole and u.train_packets > 10]
    busy = [
        kbps(unit.carried_packets, unit.carried_bytes, at - before)
        for (before, _), (at, unit) in pairwise(units)
        if before > at - unit.delay_s + shortest[unit.camera] + 0.002 and at > before
    ]
    return trains, busy


def kbps(packets, size, seconds):
    """As the link counts: IP packets, with the headers of IPv4, UDP and RTP."""
    return 8 * (size + 40 * packets) / 1000 / seconds


def test_a_side_that_is_held_up_is_not_mistaken_for_a_full_link(broker, tmp_path):
    """Its whole process stands still again and again, and then sends or handles all frames of that time at once."""
    for attempt in range(3):
        lines = held_up(broker, tmp_path / str(attempt))
        reports = [line for line in lines if isinstance(line, ReceptionReported)]
        if max(after.t - before.t for before, after in pairwise(reports)) < ABSENT_S:
            break  # otherwise a busy machine has held it up for so long that the total is halved
    sent_late = {int(line.t) for line in reports if line.late_s and max(line.late_s) > PAUSE_S / 2}
    read_late = {int(line.t) for line in reports if any(unit.ago_s > PAUSE_S / 2 for unit in line.report.units)}
    assert min(len(sent_late), len(read_late)) >= PAUSES / 2
    states = Counter(line.state for line in lines if isinstance(line, LinkMeasured))
    assert states[LinkState.FILLING] + states[LinkState.STALLED] <= 0.02 * states.total()
    decided = [line for line in lines if isinstance(line, DecisionMade)]
    low_s = sum(after.t - before.t for before, after in pairwise(decided) if before.total_kbps < 4000)
    assert low_s <= 0.05 * (lines[-1].t - lines[0].t)  # a busy machine may spread the packets of a frame


def held_up(broker, log):
    """What the vehicle logged while each side stood still."""
    ports = (f"media.port={free_port()}", f"control.port={broker.port}")
    with (
        process("vehicle", *ROBOT, "source=test", *ports, f"log={log}") as vehicle,
        process("operator", *ROBOT, "source=test", *ports) as operator,
    ):
        onlooker = Operator(broker)
        # Half of the prediction until the link is measured, which carries more.
        onlooker.state(lambda state: state.get("driving", {}).get("holder") and state.get("total_kbps") > 4000)
        time.sleep(1.5)  # the usual time from capture to sending becomes known
        begin = onlooker.as_of()
        for side in [vehicle] * PAUSES + [operator] * PAUSES:
            side.send_signal(signal.SIGSTOP)
            time.sleep(PAUSE_S)
            side.send_signal(signal.SIGCONT)
            time.sleep(1 - PAUSE_S)
        vehicle.send_signal(signal.SIGINT)
        vehicle.wait(timeout=20)
    return [line for line in read_drive(log).sides["vehicle"].lines if line.t > begin]


def test_an_operator_may_not_state_what_the_link_carries(broker):
    words = (*ROBOT, "source=test", f"control.port={broker.port}", f"media.port={free_port()}")
    with process("vehicle", *words):
        operator = Operator(broker)
        operator.state(lambda state: state["online"])
        numbers = {"kbps": 100, "queue_ms": 500, "loss": 0, "rtt_ms": 30}
        reply = operator.ask("1", event="link_measured", state="filling", evidence={}, **numbers)
    assert (reply["result"], reply["reason"]) == ("refused", "link_measured: only the vehicle itself makes this event")
