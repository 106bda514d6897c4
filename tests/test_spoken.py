"""How much later than usual voice arrives, and who is told that somebody speaks."""

from __future__ import annotations

from itertools import pairwise

from runner.core.model import Mode
from runner.operator.sound import voice_notes
from runner.records.vehicle import VehicleState, VoiceReading, VoiceState
from runner.system.lateness import Lateness
from runner.vehicle.spoken import Spoken


def test_the_fastest_counts_as_usual() -> None:
    late = Lateness()
    assert [round(late.add(sent, sent + 100 + took), 2) for sent, took in ((0, 0.05), (1, 0.03), (2, 0.33))] == [
        *(0, 0, 0.3),
    ]


def test_clocks_that_drift_are_no_delay() -> None:
    late = Lateness()
    assert max(late.add(float(t), t * 1.0005) for t in range(10_000)) < 0.001


def test_a_sender_that_begins_anew_is_not_late() -> None:
    late = Lateness()
    late.add(5000, 5000)
    assert late.add(0, 5001) == 0


def test_who_has_spoken_is_told_once() -> None:
    spoken, silent = Spoken(), VoiceReading("alice", packets=10)
    assert spoken.look(silent, 0.0) is None
    begun = VoiceReading("alice", speaking=True, packets=20, missing=1, level_db=-20)
    assert spoken.look(begun, 1.0) == "alice speaks"
    assert spoken.look(begun._replace(packets=107, missing=3), 2.0) is None
    ended = VoiceReading(None, packets=107, missing=3)
    assert spoken.look(ended, 3.5) == "alice has spoken for 2.5 s: -20 dB, 3.0 % of the packets lost"
    assert spoken.look(ended, 4.0) is None


def test_a_level_may_be_unknown() -> None:
    spoken = Spoken()
    spoken.look(VoiceReading("alice", speaking=True, packets=3), 0.0)
    assert "level unknown" in str(spoken.look(VoiceReading("alice", packets=3), 1.0))


def test_operators_are_told_who_speaks() -> None:
    def state(voice: VoiceState) -> VehicleState:
        return VehicleState(0.0, "", Mode.AUTOMATIC, 0, 0, {}, None, voice=voice)

    heard = [VoiceState("alice"), VoiceState("alice", speaking=True), VoiceState(None), VoiceState(fault="unplugged")]
    told = [list(voice_notes(state(before), state(after))) for before, after in pairwise([*heard, VoiceState()])]
    assert told == [
        ["alice speaks"],
        ["alice has spoken"],
        ["loudspeaker lost: unplugged"],
        ["loudspeaker found again"],
    ]
