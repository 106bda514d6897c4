"""Everything that touches GStreamer, used only through `runner/apply.py`.

raises  MissingBindings on import, naming every part that fails to load
"""

import ctypes
from contextlib import suppress
from importlib import import_module

from runner.errors import MissingBindings
from runner.gst.memory import limit_heaps

# GStreamer loads libunwind, whose symbols override those of libgcc in all libraries loaded later: the next C++
# exception, in Matplotlib or OpenCV, would end the process. So libgcc is loaded first, and its symbols take precedence.
with suppress(OSError):
    ctypes.CDLL("libgcc_s.so.1", mode=ctypes.RTLD_GLOBAL)

TYPELIBS = {  # Debian package by typelib
    "Gst": "gir1.2-gstreamer-1.0",
    "GstAllocators": "gir1.2-gst-plugins-base-1.0",
    "GstPbutils": "gir1.2-gst-plugins-base-1.0",
    "GstRtp": "gir1.2-gst-plugins-base-1.0",
    "GstRtsp": "gir1.2-gst-plugins-base-1.0",
    "GstSdp": "gir1.2-gst-plugins-base-1.0",
    "GstVideo": "gir1.2-gst-plugins-base-1.0",
    "GstRtspServer": "gir1.2-gst-rtsp-server-1.0",
}


def _load() -> None:
    """Load PyGObject and the typelibs; an installed one may still fail to load."""
    try:
        gi = import_module("gi")
    except Exception as error:  # a partial installation may raise anything
        how = "apt-get install python3-gi, and a virtual environment that sees it"
        raise MissingBindings({"Python module gi": f"{error}; {how}"}) from None
    missing = {}
    for name, package in TYPELIBS.items():
        try:
            gi.require_version(name, "1.0")
            import_module(f"gi.repository.{name}")
        except Exception as error:  # ValueError, ImportError, GLib.Error: from the loader or the file
            why = str(error).partition("\n")[0]
            missing[f"typelib {name}"] = f"{why}; apt-get install {package}"
    if missing:
        raise MissingBindings(missing)


_load()

from gi.repository import GLib, Gst  # noqa: E402

__all__ = ["TYPELIBS", "GLib", "Gst", "load_types"]

limit_heaps()
Gst.init(None)


def load_types() -> None:
    """Let PyGObject create the classes of all types before threads use them.

    It creates a class on first use. If two threads race, it creates two, and the methods of one reject objects of the
    other.
    """
    for name in TYPELIBS:
        module = import_module(f"gi.repository.{name}")
        for attribute in dir(module):
            with suppress(AttributeError):  # some need newer libraries than those installed
                getattr(module, attribute)
