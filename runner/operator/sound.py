"""The vehicle's sound as table, log and page state it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from msgspec import UNSET, UnsetType

from runner.operator.latency import corrected
from runner.records.operator import SoundSample
from runner.records.vehicle import VehicleState, VoiceState
from runner.system.clocks import ClockDifference

if TYPE_CHECKING:
    from runner.apply import SoundReception

UNEXPLAINED = "the vehicle has no room for another listener"


def sound_sample(
    received: SoundReception | None,
    state: VehicleState | None,
    clock: ClockDifference | None,
    operator: str,
    *,
    recorded: bool = False,
) -> SoundSample | UnsetType:
    """What to state of it; absent: this side receives none.

    clock     the vehicle's against this machine's; None: unknown
    operator  id of this side's
    recorded  whether the log of this side holds it
    """
    if received is None:
        return UNSET
    latency_ms, stated = corrected(received.latency_ms, clock), state.sound if state else UNSET
    refusals = {} if stated is UNSET or stated.refused is UNSET else stated.refused
    return SoundSample(
        packets=received.packets,
        bytes=received.bytes,
        lost=received.lost,
        level_db=None if received.level_db is None else round(received.level_db, 1),
        latency_ms=None if latency_ms is None else round(latency_ms, 1),
        foreign=received.foreign,
        rebuilt=received.rebuilt,
        fault=UNSET if stated is UNSET or stated.fault is None else stated.fault,
        refused=refusals.get(operator, UNEXPLAINED) if received.refused else UNSET,
        recorded=recorded,
    )


def sound_words(sound: SoundSample) -> str:
    """A line for the table: sound: 46 ms old, -15 dB, 3 packets lost."""
    if sound.refused is not UNSET:
        return f"sound: refused by the vehicle: {sound.refused}"
    if sound.fault is not UNSET:
        return f"sound: {sound.fault}"
    if sound.level_db is None:
        return "sound: nothing arrives"
    age = "age unknown" if sound.latency_ms is None else f"{sound.latency_ms:.0f} ms old"
    recorded = ", recorded" if sound.recorded else ""
    return f"sound: {age}, {sound.level_db:.0f} dB, {sound.lost} packets lost{recorded}"


def voice_notes(before: VehicleState, state: VehicleState) -> Iterator[str]:
    """Who begins or ends to speak; that the vehicle's loudspeaker does not open any more, and why, or does again."""
    was, now = (VoiceState() if each.voice is UNSET else each.voice for each in (before, state))
    if now.speaking != was.speaking:
        yield f"{now.operator} speaks" if now.speaking else f"{was.operator} has spoken"
    if now.fault and now.fault != was.fault:
        yield f"loudspeaker lost: {now.fault}"
    elif was.fault and not now.fault:
        yield "loudspeaker found again"


def sound_notes(before: VehicleState, state: VehicleState) -> Iterator[str]:
    """That its source does not open any more, and why, or does again."""
    was, now = (None if each.sound is UNSET else each.sound.fault for each in (before, state))
    if now and now != was:
        yield f"sound lost: {now}"
    elif was and not now:
        yield "sound found again"
