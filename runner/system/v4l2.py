"""What V4L2 devices say about themselves: whether they deliver pictures, in which formats, sizes and rates.

Structures and numbers are those of linux/videodev2.h; parsing them is apart from asking the kernel for them.
"""

from __future__ import annotations

import errno
import fcntl
import grp
import os
import stat
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from runner.core.capture import Capture
from runner.errors import reason
from runner.system.usb import BITS

QUERYCAP, ENUM_FMT, REQBUFS = 0x80685600, 0xC0405602, 0xC0145608
ENUM_FRAMESIZES, ENUM_FRAMEINTERVALS = 0xC02C564A, 0xC034564B
CAPTURE, CAPTURE_MPLANE, OUTPUT, OUTPUT_MPLANE = 0x1, 0x1000, 0x2, 0x2000
M2M, M2M_MPLANE, META_CAPTURE, DEVICE_CAPS = 0x8000, 0x4000, 0x800000, 0x80000000
VIDEO, VIDEO_MPLANE = 1, 9  # types of buffers
MMAP, DISCRETE = 1, 1
MOST = 256  # entries of one list, in case a driver never ends it
# Names in a `capture`, by the driver's code. A `raw` one is any other that is not in ENCODED.
ENCODED = {"MJPG": "mjpeg", "JPEG": "mjpeg", "H264": "h264", "HEVC": "h265"}
RAW = {"YUYV": "YUY2", "YU12": "I420", "YM12": "I420", "NM12": "NV12", "NM16": "NV16"}
RAW |= {"RGB3": "RGB", "BGR3": "BGR", "GREY": "GRAY8"}
EASE = ("raw", "mjpeg", "h264", "h265")  # to decode, the easiest first
WIDTH, HEIGHT, RATE = Fraction(1280), Fraction(720), Fraction(30)  # px, Hz: wanted of a camera shown for the first time
UNKNOWN = Fraction(1, 2)  # share of that rate, for a size whose rates the driver does not state
CLOSE = Fraction(1, 100)  # rates that differ by less are the same to a user: 29.97, 30 and 30000/1001

Ioctl = Callable[[int, int, bytearray], None]  # descriptor, request, structure; raises OSError


class Capability(NamedTuple):
    """card: the device's name; flags: what this node can do"""

    card: str
    flags: int

    @property
    def captures(self) -> bool:
        return bool(self.flags & (CAPTURE | CAPTURE_MPLANE))

    @property
    def kind(self) -> str:
        """What a node that delivers no pictures is."""
        if self.flags & META_CAPTURE:
            return "metadata"
        if self.flags & (M2M | M2M_MPLANE):
            return "a codec"
        return "an output" if self.flags & (OUTPUT | OUTPUT_MPLANE) else "no pictures"


class Span(NamedTuple):
    """Values that are offered from the least to the most, in steps; a single one: all three are equal, or step is 0."""

    least: Fraction
    most: Fraction
    step: Fraction = Fraction(0)

    def nearest(self, wanted: Fraction) -> Fraction:
        inside = min(max(wanted, self.least), self.most)
        return self.least + round((inside - self.least) / self.step) * self.step if self.step else inside


class Size(NamedTuple):
    """Picture sizes, px, and the rates offered for the largest of them, Hz."""

    width: Span
    height: Span
    rates: tuple[Span, ...]

    def has(self, width: int | None, height: int | None) -> bool:
        sides = ((self.width, width), (self.height, height))
        return all(wanted is None or span.nearest(Fraction(wanted)) == wanted for span, wanted in sides)

    def __str__(self) -> str:
        return f"{self.width.most}x{self.height.most}"


class Format(NamedTuple):
    """name: as in a `capture`"""

    name: str
    sizes: tuple[Size, ...]


def parse_capability(data: bytes) -> Capability:
    _, card, _, _, all_nodes, own, *_ = struct.unpack("16s32s32s3I3I", data)
    return Capability(_text(card), own if all_nodes & DEVICE_CAPS else all_nodes)


def parse_format(data: bytes) -> tuple[str, int]:
    """The name of a format, and its code."""
    code = struct.unpack_from("I", data, 44)[0]
    letters = struct.pack("I", code & 0x7FFFFFFF).decode("ascii", "replace").strip()
    return ENCODED.get(letters) or RAW.get(letters, letters), code


def parse_size(data: bytes) -> tuple[Span, Span]:
    kind, *numbers = struct.unpack_from("7I", data, 8)
    if kind == DISCRETE:
        return _single(numbers[0]), _single(numbers[1])
    wide, high = numbers[:3], numbers[3:6]
    return Span(*map(Fraction, wide)), Span(*map(Fraction, high))


def parse_rate(data: bytes) -> Span | None:
    """A rate from the interval that a driver states; None: it states none that can be used."""
    kind, *numbers = struct.unpack_from("7I", data, 16)
    if not all(numbers[: 2 if kind == DISCRETE else 4]):
        return None
    shortest = Fraction(numbers[1], numbers[0])
    if kind == DISCRETE:
        return Span(shortest, shortest)
    return Span(Fraction(numbers[3], numbers[2]), shortest)


def _text(data: bytes) -> str:
    return data.partition(b"\0")[0].decode(errors="replace")


def _single(value: int) -> Span:
    return Span(Fraction(value), Fraction(value))


class Device:
    """A V4L2 device, open for questions until `close`.

    raises  OSError if it does not open, or is no V4L2 device
    """

    def __init__(self, path: Path, ioctl: Ioctl = fcntl.ioctl) -> None:
        self._ioctl = ioctl
        self._file = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            self.capability = parse_capability(self._ask(QUERYCAP, bytearray(104)))
        except OSError:
            os.close(self._file)
            raise

    def close(self) -> None:
        os.close(self._file)

    def formats(self) -> list[Format]:
        """What it offers; empty if its driver does not say."""
        found: dict[str, list[Size]] = {}
        for data in self._listed(ENUM_FMT, 64, (0, self._type)):
            name, code = parse_format(data)
            found.setdefault(name, []).extend(self._sizes(code))
        return [Format(name, tuple(sizes)) for name, sizes in found.items()]

    def is_busy(self) -> bool:
        """Whether another process captures from it."""
        try:
            self._ask(REQBUFS, bytearray(struct.pack("3I8x", 0, self._type, MMAP)))
        except OSError as error:
            return error.errno == errno.EBUSY
        return False

    @property
    def _type(self) -> int:
        return VIDEO if self.capability.flags & CAPTURE else VIDEO_MPLANE

    def _sizes(self, code: int) -> Iterator[Size]:
        for data in self._listed(ENUM_FRAMESIZES, 44, (0, code)):
            width, height = parse_size(data)
            asked = (0, code, int(width.most), int(height.most))
            rates = (parse_rate(each) for each in self._listed(ENUM_FRAMEINTERVALS, 52, asked))
            yield Size(width, height, tuple(rate for rate in rates if rate))

    def _listed(self, request: int, size: int, asked: tuple[int, ...]) -> Iterator[bytes]:
        """The entries of a list; a stepwise range is the only one of its list."""
        for index in range(MOST):
            data = bytearray(size)
            struct.pack_into(f"{len(asked)}I", data, 0, index, *asked[1:])
            try:
                yield self._ask(request, data)
            except OSError:
                return

    def _ask(self, request: int, data: bytearray) -> bytes:
        self._ioctl(self._file, request, data)
        return bytes(data)


class Connected(NamedTuple):
    """A device that captures pictures.

    node     its device file
    path     one that stays the same after a restart, if there is one; otherwise `node`
    formats  what it offers; empty if its driver does not say
    problem  why it can not be used now; None: it can
    """

    node: Path
    path: Path
    card: str
    formats: list[Format]
    problem: str | None


def connected(devices: Path = Path("/dev"), ioctl: Ioctl = fcntl.ioctl) -> Iterator[Connected]:
    """The devices of this machine that capture pictures, by number, and those that this user may not open."""
    stable = {link.resolve(): link for link in sorted((devices / "v4l/by-path").glob("*"), reverse=True)}
    for node in sorted(devices.glob("video[0-9]*"), key=lambda node: (len(node.name), node.name)):
        path = stable.get(node.resolve(), node)
        try:
            device = Device(node, ioctl)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EPERM, errno.EBUSY):
                yield Connected(node, path, "", [], _unopened(node, error))
            continue
        with closing(device):
            if device.capability.captures:
                busy = _busy(node) if device.is_busy() else None
                yield Connected(node, path, device.capability.card, device.formats(), busy)


def preferred(formats: list[Format]) -> Capture:
    """The capture that is nearest to 1280x720 at 30 Hz; of several that which takes least to decode."""
    found = []
    for each in formats:
        ease = EASE.index(each.name if each.name in ENCODED.values() else "raw")
        for size in each.sizes if each.name in BITS else ():
            width, height = size.width.nearest(WIDTH), size.height.nearest(HEIGHT)
            rates: Sequence[Fraction | None] = [span.nearest(RATE) for span in size.rates] or [None]
            for rate in rates:
                nearness = _share(width * height, WIDTH * HEIGHT) * (_share(rate, RATE) if rate else UNKNOWN)
                found.append((nearness, -ease, Capture(each.name, int(width), int(height), rate)))
    return max(found, key=lambda one: one[:2], default=(0, 0, Capture()))[2]


def _share(offered: Fraction, wanted: Fraction) -> Fraction:
    return min(offered, wanted) / max(offered, wanted)


def users(path: Path) -> list[str]:
    """Processes that have a device open, as far as this user may see: NAME (PID)."""
    try:
        device = path.stat().st_rdev
    except OSError:
        return []
    found = []
    for process in sorted(Path("/proc").glob("[0-9]*"), key=lambda each: int(each.name)):
        if process.name != str(os.getpid()) and _has_open(process, device):
            with suppress(OSError):
                found.append(f"{(process / 'comm').read_text().strip()} ({process.name})")
    return found


def _has_open(process: Path, device: int) -> bool:
    with suppress(OSError):
        for file in (process / "fd").iterdir():
            with suppress(OSError):
                if file.stat().st_rdev == device:
                    return True
    return False


def picture_nodes(path: Path, sysfs: Path = Path("/sys")) -> list[str]:
    """Other nodes of the same hardware, in order: a camera's pictures may be at one of them."""
    own = sysfs / "class/video4linux" / path.resolve().name / "device"
    if not own.exists():
        return []
    nodes = (sysfs / "class/video4linux").glob("video*")
    same = [node.name for node in nodes if node.name != path.name and (node / "device").resolve() == own.resolve()]
    return [f"/dev/{name}" for name in sorted(same)]


def device_problem(path: Path, capture: Capture, fps: Fraction, ioctl: Ioctl = fcntl.ioctl) -> str | None:
    """Why a device does not deliver the pictures that are asked for; None if it does, as far as its driver says.

    fps  of the camera, if the capture names none
    """
    if not path.is_char_device():
        return "is not a device file"
    try:
        device = Device(path, ioctl)
    except OSError as error:
        if error.errno in (errno.ENOTTY, errno.EINVAL):
            return "is no camera: it does not answer as a V4L2 device"
        return _unopened(path, error)
    with closing(device):
        card = device.capability.card
        if not device.capability.captures:
            nodes = picture_nodes(path)
            hint = f"; other nodes of this device: {', '.join(nodes)}" if nodes else ""
            return f"is no camera: {card} delivers {device.capability.kind} here{hint}"
        return unoffered(device.formats(), capture, fps) or (_busy(path) if device.is_busy() else None)


def _unopened(path: Path, error: OSError) -> str:
    if error.errno == errno.EBUSY:
        return _busy(path)
    hint = ""
    with suppress(OSError, KeyError):
        status = path.stat()
        if error.errno == errno.EACCES and status.st_mode & stat.S_IRGRP:
            group = grp.getgrgid(status.st_gid).gr_name
            hint = f"; it is open to the group {group}: sudo usermod -aG {group} $USER, then log in again"
    return f"does not open: {reason(error)}{hint}"


def _busy(path: Path) -> str:
    by = users(path)
    return f"is in use by {', '.join(by) if by else 'another process'}"


def unoffered(formats: list[Format], capture: Capture, fps: Fraction) -> str | None:
    """What of a capture a device does not offer, and what it offers instead; None: all of it, or it is unknown."""
    if capture.format is None or not formats:
        return None
    fitting = _fitting(formats, capture.format)
    if not fitting:
        return f"offers no {capture.format}, only {', '.join(each.name for each in formats)}"
    every = [size for each in fitting for size in each.sizes]
    sizes = [size for size in every if size.has(capture.width, capture.height)]
    asked = f"{capture.format} of {capture.width or 'any'}x{capture.height or 'any'}"
    if every and not sizes:
        return f"offers no {asked}, only {', '.join(dict.fromkeys(map(str, every)))}"
    rates = sorted({rate.most for size in sizes for rate in size.rates})
    listed = ", ".join(map(str, rates))
    if capture.fps and rates and offered_rate(formats, capture) is None:
        return f"offers {asked} at {listed} Hz, not at {float(capture.fps):g}"
    if not capture.fps and rates and rates[-1] < fps * (1 - CLOSE):
        return f"offers {asked} at {listed} Hz, less than the camera's fps, {float(fps):g}"
    return None


def offered_rate(formats: list[Format], capture: Capture) -> Fraction | None:
    """The offered rate that is nearest to that of a capture, Hz; None: none is close, or none is known."""
    if capture.format is None or capture.fps is None:
        return None
    wanted = capture.fps
    sizes = chain.from_iterable(each.sizes for each in _fitting(formats, capture.format))
    offered = (rate.nearest(wanted) for size in sizes if size.has(capture.width, capture.height) for rate in size.rates)
    nearest = min(offered, key=lambda rate: abs(rate - wanted), default=None)
    return nearest if nearest is not None and abs(nearest - wanted) <= CLOSE * wanted else None


def _fitting(formats: list[Format], name: str) -> list[Format]:
    raw = name == "raw"
    return [each for each in formats if each.name == name or (raw and each.name not in ENCODED.values())]
