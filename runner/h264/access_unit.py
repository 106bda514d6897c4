"""Access units for viewers, and the units that a late-joining viewer must decode first. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from itertools import pairwise
from math import inf
from typing import NamedTuple

from runner.core.model import Roi
from runner.h264.keyframe import grey_idr
from runner.h264.region import MOST_BYTES, region_of
from runner.h264.sps import SPS, Bits

SLICE, IDR, SEI = 1, 5, 6  # NAL unit types (ITU-T H.264, table 7-1)
RECOVERY_POINT = 6  # SEI payload type (D.1.8)
H265_VCL, H265_IRAP = range(32), range(16, 24)  # NAL unit types (ITU-T H.265, table 7-1)
H265_SETS = range(32, 35)  # video, sequence and picture parameter sets
PERIODS = 2  # of refresh until any picture is exact: they contain a whole wave, whenever it began
CODECS = ("h264", "h265")
LATE = 4  # factor by which a wave may take longer than stated
REFRESHED_S = 1.0  # at most, by one unit
LONGEST_S = 20.0  # kept of a stream without further keyframes whose refresh period is unknown


class AccessUnit(NamedTuple):
    """One encoded picture, H.264 or H.265, Annex B.

    captured  capture time, s since 1970 by the vehicle's clock, on the page by this machine's; None if unknown
    arrived   arrival time, s since 1970 by this machine's clock
    key       whether a decoder can start with it (H.264: IDR picture; H.265: any IRAP picture)
    recovery  frames after which a decoder that starts here is exact, if a refresh wave begins here; otherwise None
    exact     False: the decoded picture still shows content that was never sent
    damaged   whether the decoded picture still shows earlier packet loss
    whole     False: a decoder that starts late shows an older picture in part, see `RecentUnits`
    region    what it shows of the camera's full image, as it states itself; None: all, or it does not state it
    """

    data: bytes
    captured: float | None
    arrived: float
    key: bool
    recovery: int | None = None
    exact: bool = True
    damaged: bool = False
    whole: bool = True
    region: Roi | None = None


def read_unit(
    data: bytes, captured: float | None, arrived: float, *, damaged: bool = False, codec: str = "h264"
) -> AccessUnit | None:
    """A received access unit, in Annex B: its NAL units show whether a decoder can start with it.

    damaged  packets of it were lost
    codec    h264 or h265
    returns  None for a useless one: browsers' decoders fail on an incomplete picture, but tolerate a missing one.
             An incomplete H.264 IDR picture is replaced by a grey one, which the next refresh wave overwrites.

    Parameter sets do not identify an IDR picture: encoders repeat them at every wave.
    """
    if codec == "h265":
        return None if damaged else _read_h265(data, captured, arrived)
    recovery, region = None, None
    for header, at in nal_units(data):
        kind = header & 0x1F
        if kind == IDR and damaged:
            grey = grey_idr(data)
            return AccessUnit(grey, captured, arrived, key=True, exact=False, region=region) if grey else None
        if SLICE <= kind <= IDR:
            return None if damaged else AccessUnit(data, captured, arrived, kind == IDR, recovery, region=region)
        if kind == SEI:
            recovery = _recovery(data[at : at + 16]) if recovery is None else recovery
            region = region_of(data[at : at + MOST_BYTES]) or region
    return None


def stated_region(data: bytes) -> Roi | None:
    """The region that the beginning of an H.264 access unit states; None: none."""
    for header, at in nal_units(data):
        if SLICE <= header & 0x1F <= IDR:
            break
        if header & 0x1F == SEI and (region := region_of(data[at : at + MOST_BYTES])):
            return region
    return None


def starts(data: bytes, codec: str) -> tuple[bool, int | None]:
    """Whether a decoder can start with an access unit, and its recovery_frame_cnt if a refresh wave begins there."""
    unit = read_unit(data, None, 0.0, codec=codec)
    return (unit.key, unit.recovery) if unit else (False, None)


def coded_picture(data: bytes, codec: str) -> bytes:
    """The part of an access unit that codes its picture: without parameter sets, with start codes of three bytes."""
    for header, at in nal_units(data):
        if (header >> 1 & 0x3F) in H265_VCL if codec == "h265" else SLICE <= (header & 0x1F) <= IDR:
            return data[at - 1 :].replace(b"\0\0\0\1", b"\0\0\1").rstrip(b"\0")
    return b""


def parameter_sets(data: bytes) -> bytes:
    """The parameter sets in front of an H.265 picture, Annex B; empty: there are none."""
    units, sets = [(header >> 1 & 0x3F, at - 4) for header, at in nal_units(data)], b""
    for (kind, begin), (_, end) in pairwise([*units, (0, len(data))]):
        if kind in H265_VCL:
            break
        if kind in H265_SETS:
            sets += b"\0" + data[begin:end].rstrip(b"\0")
    return sets


def has_parameter_sets(data: bytes, codec: str) -> bool:
    """Whether an access unit states the parameter sets that its picture needs."""
    return bool(parameter_sets(data)) if codec == "h265" else any(h & 0x1F == SPS for h, _ in nal_units(data))


def _read_h265(data: bytes, captured: float | None, arrived: float) -> AccessUnit | None:
    """`read_unit` for H.265. Recovery points are ignored: a late viewer waits for the next IRAP picture."""
    for header, _ in nal_units(data):
        kind = header >> 1 & 0x3F
        if kind in H265_VCL:
            return AccessUnit(data, captured, arrived, kind in H265_IRAP)
    return None


def nal_units(data: bytes) -> Iterator[tuple[int, int]]:
    """First byte of the header of each NAL unit, and the offset after it; its start code begins 4 bytes before."""
    at = data.find(b"\0\0\1")
    while 0 <= at < len(data) - 3:
        yield data[at + 3], at + 4
        at = data.find(b"\0\0\1", at + 3)


def _recovery(message: bytes) -> int | None:
    """recovery_frame_cnt of an SEI message that is a recovery point (D.1.8); None also if it is cut off."""
    try:
        return Bits(message[2:]).ue() if message[:1] == bytes([RECOVERY_POINT]) else None
    except ValueError:
        return None


class RecentUnits:
    """The units of one camera that a late decoder needs: the last IDR, and the units since or of the last periods.

    With intra-refresh, an IDR is sent only when the picture size changes, and by x264 at some hard cuts. Starting from
    it alone mixes an old picture with new changes; after two refresh periods, or one whole wave that the stream
    announces, the old picture is gone. A stream that others already watch sends no IDR for a late viewer, who starts
    from a grey one. After a long pause the units before it are gone, so a decoder that starts now shows the last IDR
    where no wave has passed yet; one that has been running does not.

    A camera that encodes by itself (`keyed`) sends a whole key picture now and then, one without refresh waves when it
    is asked for one. Before the first one there is nothing to begin with, unless it announces refresh waves; nor is
    there once the last one is too old to be kept. Whoever has begun goes on.

    Some encoders state their parameter sets only once; then key units are completed by those last seen (H.265).

    refresh_s  length of a refresh wave or keyframe interval, s; None if the graph does not state it
    codec      h264 or h265; an H.265 stream that others already watch starts with its next IRAP picture
    keyed      whether only a key picture, or an announced wave, makes a picture whole
    """

    def __init__(self, refresh_s: float | None, codec: str = "h264", *, keyed: bool = False) -> None:
        self._keyed = keyed
        self._states_sets, self._sets = codec == "h265", b""
        self._grey = grey_idr if codec == "h264" else lambda _unit: None
        self._window = LONGEST_S if refresh_s is None else PERIODS * refresh_s
        self._key: AccessUnit | None = None
        self._since: deque[AccessUnit] = deque()
        self._previous: float | None = None  # arrival of the last unit
        self._grey_since: float | None = None  # since when grey is being overwritten; None: the picture is exact
        self._resumed = -inf  # when the stream went on after its last long pause
        self._is_cut = False  # whether units since the last IDR are no longer stored
        self._has_waves = False  # whether it has announced one since then
        self._has_begun = False  # whether a decoder has been able to start

    def add(self, unit: AccessUnit) -> AccessUnit:
        """Store a received unit; returns it with `exact` set for a decoder that starts from the stored units."""
        self._follow_clock(unit.arrived)
        if self._states_sets:
            unit = self._complete(unit)
        if unit.key:
            self._key, self._grey_since = unit, None if unit.exact else unit.arrived
            self._since.clear()
            self._resumed, self._is_cut, self._has_waves = -inf, False, False
            return unit
        begins = not self._keyed or unit.recovery is not None
        if self._key is None and begins and (grey := self._grey(unit.data)):
            self._key = AccessUnit(grey, None, unit.arrived, key=True, exact=False)
            self._grey_since = unit.arrived
        if self._key is None:
            return unit._replace(exact=self._has_begun and self._grey_since is None)
        self._has_begun = True
        self._has_waves |= unit.recovery is not None
        self._since.append(unit)
        self._forget(unit.arrived)
        if not self._since:
            return unit._replace(exact=self._grey_since is None)
        if self._grey_since is not None and not self._is_refreshing(self._grey_since):
            self._grey_since = None
        if self._grey_since is not None:
            self._since[-1] = unit = unit._replace(exact=False)
        if self._is_cut and self._is_refreshing(self._resumed):
            self._since[-1] = unit = unit._replace(whole=False)
        return unit

    def _complete(self, unit: AccessUnit) -> AccessUnit:
        """With parameter sets, if it is a key unit and any are known."""
        if sets := parameter_sets(unit.data):
            self._sets = sets
        return unit._replace(data=self._sets + unit.data) if unit.key and not sets else unit

    def _follow_clock(self, now: float) -> None:
        """Shift times if the clock was set back, or all units would be kept until it has caught up; also after a pause.

        Nothing is refreshed in a pause.
        """
        ahead, self._previous = now - (now if self._previous is None else self._previous), now
        if ahead < 0:
            self._since = deque(each._replace(arrived=each.arrived + ahead) for each in self._since)
        shift = ahead if ahead < 0 else max(0.0, ahead - REFRESHED_S)
        self._resumed = now if ahead > self._window else self._resumed + shift
        if self._grey_since is not None:
            self._grey_since += shift

    def _is_refreshing(self, since: float) -> bool:
        """Whether the newest picture may still show parts that are older, or grey, if its refresh began at `since`."""
        assert self._previous is not None
        longest = self._window * (LATE if self._has_waves else 1)
        return self._previous - since < longest and self._wave() is None

    def _forget(self, now: float) -> None:
        """Drop units older than the window, but keep waves whole that take longer because frames are late."""
        if any(unit.recovery is not None for unit in self._since):
            spare, oldest = self._wave() or 0, now - LATE * self._window
        else:
            spare, oldest = len(self._since), now - self._window
        while self._since[0].arrived < oldest or (spare > 0 and self._since[0].arrived < now - self._window):
            self._since.popleft()
            self._is_cut = True
            spare -= 1
        if self._keyed and self._is_cut and self._wave() is None:
            self._key = None
            self._since.clear()

    def burst(self) -> list[AccessUnit]:
        """Units to decode, in order, the newest last; empty until a decoder can start."""
        if self._key is None:
            return []
        units = list(self._since)
        return [self._key, *units[self._wave() or 0 :]]

    def _wave(self) -> int | None:
        """Index of the first unit of the last completed wave; None if there is none."""
        for at in range(len(self._since) - 1, -1, -1):
            recovery = self._since[at].recovery
            if recovery is not None and len(self._since) - 1 - at >= recovery:
                return at
        return None
