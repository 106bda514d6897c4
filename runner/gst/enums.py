"""The values of enumerations and flags, read from GObject: each line of PyGObject offers them in another way."""

from __future__ import annotations

import ctypes
from typing import Any

from gi.repository import GObject

from runner.elements.description import EnumValue


class _Enum(ctypes.Structure):  # GEnumClass
    _fields_ = [
        *(("type", ctypes.c_size_t), ("minimum", ctypes.c_int), ("maximum", ctypes.c_int)),
        *(("count", ctypes.c_uint), ("values", ctypes.c_void_p)),
    ]


class _Flags(ctypes.Structure):  # GFlagsClass
    _fields_ = [
        *(("type", ctypes.c_size_t), ("mask", ctypes.c_uint)),
        *(("count", ctypes.c_uint), ("values", ctypes.c_void_p)),
    ]


class _EnumValue(ctypes.Structure):  # GEnumValue
    _fields_ = [("number", ctypes.c_int), ("name", ctypes.c_char_p), ("nick", ctypes.c_char_p)]


class _FlagsValue(ctypes.Structure):  # GFlagsValue
    _fields_ = [("number", ctypes.c_uint), ("name", ctypes.c_char_p), ("nick", ctypes.c_char_p)]


_LAYOUTS: dict[str, tuple[Any, Any]] = {"GEnum": (_Enum, _EnumValue), "GFlags": (_Flags, _FlagsValue)}
_library = ctypes.CDLL("libgobject-2.0.so.0")
_library.g_type_from_name.argtypes, _library.g_type_from_name.restype = [ctypes.c_char_p], ctypes.c_size_t
_library.g_type_class_ref.argtypes, _library.g_type_class_ref.restype = [ctypes.c_size_t], ctypes.c_void_p


def enum_values(kind: GObject.GType) -> tuple[EnumValue, ...]:
    """The values of a type in the order of its definition; none if it is neither an enumeration nor flags."""
    if kind.fundamental.name not in _LAYOUTS:
        return ()
    layout, value = _LAYOUTS[kind.fundamental.name]
    # Never released: a type of a plugin stays anyway.
    described = layout.from_address(_library.g_type_class_ref(_library.g_type_from_name(kind.name.encode())))
    values = (value * described.count).from_address(described.values)
    return tuple(EnumValue(each.nick.decode(), each.number, each.name.decode()) for each in values)
