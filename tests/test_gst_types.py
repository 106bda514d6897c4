"""The classes of GStreamer's types exist before threads use them."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.gst

PROGRAM = """
import sys
from runner.apply import OperatorSide
from gi.repository import GstRtspServer, GstSdp
OperatorSide([], lambda *_: None, None).stop()
print("SDPMessage" in vars(GstSdp), "RTSPContext" in vars(GstRtspServer))
"""


def test_the_classes_of_all_types_are_made_before_threads_use_them() -> None:
    """PyGObject creates a class on first use; two racing threads would create two, which reject each other."""
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=60, check=False)
    assert (done.stdout, done.stderr) == ("True True\n", "")
