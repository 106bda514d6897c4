"""Pictures of the counter that `tod-runner latency` reads, as a camera that films it would deliver them.

The cells are those of `runner/page/static/counter.js`.
"""

from __future__ import annotations

from binascii import crc_hqx

import numpy as np
from numpy.typing import NDArray

BITS = 18  # of the milliseconds
HEAD, TAIL = "1101", "1011"  # 1: black
MARGIN = 4  # cells, white on both sides
BLACK, WHITE, GREY = 16, 235, 128  # ITU-R BT.709, limited range


def cells(ms: int) -> str:
    """A time as cells, 1 for black: head, the last 18 bits of it, their CRC-16/CCITT-FALSE, tail."""
    value = ms % 2**BITS
    return f"{HEAD}{value:0{BITS}b}{crc_hqx(value.to_bytes(3, 'big'), 0xFFFF):016b}{TAIL}"


def counter_frame(ms: int, width: int, height: int) -> NDArray[np.uint8]:
    """A picture of the counter at a time, in the middle half of its rows.

    ms       of the clock that it shows
    returns  I420, flat, of width * height * 3 / 2 bytes
    """
    black = np.array([cell == "1" for cell in "0" * MARGIN + cells(ms) + "0" * MARGIN])
    row = np.where(black[np.arange(width) * len(black) // width], BLACK, WHITE)
    frame = np.full(width * height * 3 // 2, GREY, np.uint8)
    luma = frame[: width * height].reshape(height, width)
    luma[:] = WHITE
    luma[height // 4 : height - height // 4] = row
    return frame
