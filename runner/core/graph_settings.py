"""What a graph states of itself: what its knobs set, and its numbers."""

from __future__ import annotations

from dataclasses import dataclass

NEVER_S = 1e6  # between two refresh waves: there are none


@dataclass(frozen=True, slots=True)
class KnobTarget:
    """One property that a knob sets, and its value: a quantity of the knob (see `runner.graph`) or a text with some."""

    element: str
    property: str
    value: str


@dataclass(frozen=True, slots=True)
class KnobCommand:
    """A program of the user's that sets what no element can, such as the bitrate of an IP camera.

    words     the program and its arguments, without a shell; {kbps} and {bps} stand for the value
    every_s   least time between the starts of two calls
    within_s  after which a call is killed
    """

    words: tuple[str, ...]
    every_s: float = 2.0
    within_s: float = 5.0

    def with_bitrate(self, kbps: int) -> list[str]:
        """Its words for a bitrate."""
        return [word.replace("{kbps}", str(kbps)).replace("{bps}", str(1000 * kbps)) for word in self.words]


@dataclass(frozen=True, slots=True)
class GraphSettings:
    """Numbers of a graph that this program reads itself. None, and the defaults: a graph that does not state them.

    first_port         UDP port of the first camera; camera n uses this + n
    mtu_bytes          size of an RTP packet
    header_bytes       headers of a packet on the wire, below the payload of the video
    jitter_buffer_ms   how long the operator waits for a missing packet
    retransmission_ms  how long the vehicle keeps packets for retransmission; 0: there is none
    srt_latency_ms     how long SRT may take to repair a loss, its playout delay
    dscp               DiffServ code point of the video packets; -1 leaves it to the system
    key_interval_s     between key frames or refresh waves, at most; fills {key_interval_frames}
    longest_wave_s     between refresh waves, at most, where a rule sets how often they are asked for; 0: no limit
    shortest_wave_s    between refresh waves that are asked for, at least; None: the encoder makes them by itself
    vbv_frames         rate control buffer in frames at the bitrate in force; fills {vbv_ms}
    lowest_kbps        to which a camera that encodes by itself can be set
    """

    first_port: int
    mtu_bytes: int = 1200
    header_bytes: int = 58
    jitter_buffer_ms: int = 0
    retransmission_ms: int = 0
    srt_latency_ms: int = 0
    dscp: int = -1
    key_interval_s: float | None = None
    longest_wave_s: float = 6.0
    shortest_wave_s: float | None = None
    vbv_frames: float | None = None
    lowest_kbps: int = 1

    @property
    def may_have_no_waves(self) -> bool:
        """Whether only a key picture, which has to be asked for, makes the picture of a decoder whole that joins."""
        return self.shortest_wave_s is not None and self.key_interval_s is None
