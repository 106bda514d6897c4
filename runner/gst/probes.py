"""Pad probes that leak no memory.

PyGObject before 3.44.2 (Debian 12, Ubuntu 22.04) leaks 130 bytes for each callback passed to C, such as a probe or a
timer. Latencies of eight cameras are sampled 80 times a second, and an operator's side tries once a second to reach
each camera of a vehicle that is away: a gigabyte a day. So these probes share one ctypes callback, which reads the
structures of GStreamer's stable ABI.
"""

from __future__ import annotations

import ctypes
import itertools
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from ctypes import CFUNCTYPE, POINTER, Structure, c_char_p, c_int, c_size_t, c_uint, c_uint64, c_ulong, c_void_p
from typing import Any
from weakref import WeakMethod, WeakValueDictionary

from gi.repository import Gst


class _MiniObject(Structure):
    _fields_ = (
        ("type", c_size_t),
        ("counts", c_int * 3),  # references, lock, flags
        ("functions", c_void_p * 3),
        ("private_number", c_uint),
        ("private", c_void_p),
    )


class _Typed(Structure):
    """The beginning of an event, and of a query."""

    _fields_ = (("object", _MiniObject), ("type", c_uint))


class _Buffer(Structure):
    _fields_ = (("object", _MiniObject), ("pool", c_void_p), ("pts", c_uint64), ("dts", c_uint64))


class _ProbeInfo(Structure):
    _fields_ = (("type", c_uint), ("id", c_ulong), ("data", c_void_p))


class _ReferenceTimestamp(Structure):
    _fields_ = (("flags", c_uint), ("info", c_void_p), ("reference", c_void_p), ("timestamp", c_uint64))


_library = ctypes.CDLL("libgstreamer-1.0.so.0")


def _function(name: str, result: Any, *arguments: Any) -> Any:
    function = getattr(_library, name)
    function.restype, function.argtypes = result, arguments
    return function


_Callback = CFUNCTYPE(c_int, c_void_p, POINTER(_ProbeInfo), c_void_p)
_add_probe = _function("gst_pad_add_probe", c_ulong, c_void_p, c_uint, _Callback, c_void_p, c_void_p)
_get_size = _function("gst_buffer_get_size", c_size_t, c_void_p)
_extract = _function("gst_buffer_extract", c_size_t, c_void_p, c_size_t, c_char_p, c_size_t)
_make_writable = _function("gst_mini_object_make_writable", c_void_p, c_void_p)
_allocate = _function("gst_allocator_alloc", c_void_p, c_void_p, c_size_t, c_void_p)
_replace = _function("gst_buffer_replace_memory_range", None, c_void_p, c_uint, c_int, c_void_p)
_fill = _function("gst_buffer_fill", c_size_t, c_void_p, c_size_t, c_char_p, c_size_t)
_get_reference = _function("gst_buffer_get_reference_timestamp_meta", POINTER(_ReferenceTimestamp), c_void_p, c_void_p)
_get_structure = _function("gst_event_get_structure", c_void_p, c_void_p)
_get_name = _function("gst_structure_get_name", c_char_p, c_void_p)
_get_uint = _function("gst_structure_get_uint", c_int, c_void_p, c_char_p, POINTER(c_uint))
_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_pointer.restype, _pointer.argtypes = c_void_p, (ctypes.py_object, c_char_p)


class PassingBuffer:
    """A buffer passing a pad; valid only during the callback that receives it."""

    def __init__(self, address: int) -> None:
        self._address = address

    @property
    def pts(self) -> int | None:
        """ns; None if not set."""
        pts = int(_Buffer.from_address(self._address).pts)
        return None if pts == Gst.CLOCK_TIME_NONE else pts

    @property
    def dts(self) -> int | None:
        """ns; None if not set."""
        dts = int(_Buffer.from_address(self._address).dts)
        return None if dts == Gst.CLOCK_TIME_NONE else dts

    @dts.setter
    def dts(self, dts: int) -> None:
        _Buffer.from_address(self._address).dts = dts

    @property
    def size(self) -> int:
        """Bytes."""
        return int(_get_size(self._address))

    def has_flags(self, flags: Gst.BufferFlags) -> bool:
        return bool(self._object.counts[2] & int(flags))

    def unset_flags(self, flags: Gst.BufferFlags) -> None:
        self._object.counts[2] &= ~int(flags)

    @property
    def _object(self) -> _MiniObject:
        return _MiniObject.from_address(self._address)

    @property
    def reference_ns(self) -> int | None:
        """Its reference timestamp; None if it has none, or the sender left it 0."""
        meta = _get_reference(self._address, None)
        return (int(meta.contents.timestamp) or None) if meta else None

    @property
    def address(self) -> int:
        """Of the GstBuffer."""
        return self._address

    def extract(self, offset: int, count: int) -> bytes:
        """Up to `count` bytes from an offset."""
        data = ctypes.create_string_buffer(count)
        copied = _extract(self._address, offset, data, count)
        return data.raw[:copied]


class _Probe(ABC):
    """Known to C by a number. A pad does not keep it alive: once deleted, it is removed.

    kinds  of what passes a pad
    """

    on_fault = Gst.PadProbeReturn.OK  # of its owner; ctypes would return 0, which drops what passes

    def __init__(self, kinds: Gst.PadProbeType) -> None:
        self._key, self._kinds = next(_keys), kinds
        _probes[self._key] = self

    def add_to(self, pad: Gst.Pad) -> None:
        _add_probe(int(_pointer(pad.__gpointer__, None)), self._kinds, _on_probe, self._key, None)

    def pass_on(self, info: Any) -> Gst.PadProbeReturn:
        """Called with the `_ProbeInfo` of what passes."""
        return self.handle(info.contents.data)

    @abstractmethod
    def handle(self, address: int | None) -> Gst.PadProbeReturn:
        """Called with the address of what passes; None while nothing does."""


class BufferProbe(_Probe):
    """A probe that can be armed repeatedly. While it is not armed, buffers cost nothing. It ends with its owner.

    on_buffer  method of the owner, which it does not keep alive: called in the streaming thread with the pad and each
               buffer, until it returns True
    in_lists   whether buffers may come in lists, of which nothing can be read
    armed      whether it waits for a buffer
    """

    def __init__(
        self, pad: Gst.Pad, on_buffer: Callable[[Gst.Pad, PassingBuffer], bool], *, in_lists: bool = False
    ) -> None:
        super().__init__(Gst.PadProbeType.BUFFER | (Gst.PadProbeType.BUFFER_LIST if in_lists else 0))
        self._pad, self._on_buffer = pad, WeakMethod(on_buffer)
        self.armed = False

    def arm(self) -> None:
        """Wait for the next buffer, unless already armed. To be called by one thread at a time."""
        if not self.armed:
            self.armed = True
            self.add_to(self._pad)

    def handle(self, address: int | None) -> Gst.PadProbeReturn:
        on_buffer = self._on_buffer()
        assert address
        if on_buffer and not on_buffer(self._pad, PassingBuffer(address)):
            return Gst.PadProbeReturn.OK
        self.armed = False
        return Gst.PadProbeReturn.REMOVE


class PassProbe(_Probe):
    """Asks a method of its owner, which it does not keep alive, whether a buffer passes a pad; all do without it.

    passes  called in the streaming thread with the pad and each buffer
    """

    def __init__(self, pad: Gst.Pad, passes: Callable[[Gst.Pad, PassingBuffer], bool]) -> None:
        super().__init__(Gst.PadProbeType.BUFFER)
        self._pad, self._passes = pad, WeakMethod(passes)
        self.add_to(pad)

    def handle(self, address: int | None) -> Gst.PadProbeReturn:
        passes = self._passes()
        assert address
        if passes is None:
            return Gst.PadProbeReturn.REMOVE
        return Gst.PadProbeReturn.OK if passes(self._pad, PassingBuffer(address)) else Gst.PadProbeReturn.DROP


class RewritingProbe(_Probe):
    """Asks a method of its owner, which it does not keep alive, what to pass on in place of the content of a buffer.

    rewritten  called in the streaming thread with the pad and each buffer; None: it passes as it is
    """

    def __init__(self, pad: Gst.Pad, rewritten: Callable[[Gst.Pad, PassingBuffer], bytes | None]) -> None:
        super().__init__(Gst.PadProbeType.BUFFER)
        self._pad, self._rewritten = pad, WeakMethod(rewritten)
        self.add_to(pad)

    def pass_on(self, info: Any) -> Gst.PadProbeReturn:
        rewritten, passing = self._rewritten(), info.contents
        if rewritten is None:
            return Gst.PadProbeReturn.REMOVE
        data = rewritten(self._pad, PassingBuffer(passing.data))
        if data is not None:
            passing.data = _make_writable(passing.data)
            _replace(passing.data, 0, -1, _allocate(None, len(data), None))
            _fill(passing.data, 0, data, len(data))
        return Gst.PadProbeReturn.OK

    def handle(self, address: int | None) -> Gst.PadProbeReturn:
        raise NotImplementedError


class IdleProbe(_Probe):
    """Calls a method of its owner, which it does not keep alive, between two buffers of a pad.

    Once each time it is added: immediately if nothing passes the pad, otherwise in the streaming thread.
    """

    on_fault = Gst.PadProbeReturn.REMOVE  # until then the pad is blocked

    def __init__(self, on_idle: Callable[[], None]) -> None:
        super().__init__(Gst.PadProbeType.IDLE)
        self._on_idle = WeakMethod(on_idle)

    def handle(self, address: int | None) -> Gst.PadProbeReturn:
        if on_idle := self._on_idle():
            on_idle()
        return Gst.PadProbeReturn.REMOVE


class TypeProbe(_Probe):
    """Decides by its type what becomes of an event or a query; of any number of pads. A constant of its module.

    kinds    of the events or queries
    results  by type; the others pass
    """

    def __init__(self, kinds: Gst.PadProbeType, results: Mapping[Any, Gst.PadProbeReturn]) -> None:
        super().__init__(kinds)
        self._results = {int(kind): result for kind, result in results.items()}

    def handle(self, address: int | None) -> Gst.PadProbeReturn:
        assert address
        return self._results.get(_Typed.from_address(address).type, Gst.PadProbeReturn.OK)


class EventProbe(_Probe):
    """Asks a method of its owner, which it does not keep alive, whether to drop an event.

    kinds       of the events
    is_dropped  called in the streaming thread with the type of each
    """

    def __init__(self, kinds: Gst.PadProbeType, is_dropped: Callable[[Gst.EventType], bool]) -> None:
        super().__init__(kinds)
        self._is_dropped = WeakMethod(is_dropped)

    def handle(self, address: int | None) -> Gst.PadProbeReturn:
        assert address
        is_dropped = self._is_dropped()
        dropped = is_dropped and is_dropped(Gst.EventType(_Typed.from_address(address).type))
        return Gst.PadProbeReturn.DROP if dropped else Gst.PadProbeReturn.OK


class RequestProbe(_Probe):
    """Asks a method of its owner, which it does not keep alive, whether a custom event may go upstream.

    name        of the events; others pass
    is_granted  called in a streaming thread for each, with the sequence number that it asks for; None: it has none
    """

    def __init__(self, name: str, is_granted: Callable[[int | None], bool]) -> None:
        super().__init__(Gst.PadProbeType.EVENT_UPSTREAM)
        self._name, self._is_granted = name.encode(), WeakMethod(is_granted)

    def handle(self, address: int | None) -> Gst.PadProbeReturn:
        assert address
        is_granted = self._is_granted()
        if is_granted is None or _Typed.from_address(address).type != _CUSTOM_UPSTREAM:
            return Gst.PadProbeReturn.OK
        structure = _get_structure(address)
        dropped = structure and _get_name(structure) == self._name and not is_granted(_number(structure))
        return Gst.PadProbeReturn.DROP if dropped else Gst.PadProbeReturn.OK


def _number(structure: int) -> int | None:
    number = c_uint()
    return number.value if _get_uint(structure, b"seqnum", number) else None


_CUSTOM_UPSTREAM = int(Gst.EventType.CUSTOM_UPSTREAM)
_keys = itertools.count(1)
_probes: WeakValueDictionary[int, _Probe] = WeakValueDictionary()


def _dispatch(_pad: int, info: Any, key: int) -> int:
    probe = _probes.get(key)
    if probe is None:
        return int(Gst.PadProbeReturn.REMOVE)
    try:
        return int(probe.pass_on(info))
    except Exception:
        traceback.print_exc()
        return int(probe.on_fault)


_on_probe = _Callback(_dispatch)
