"""Pauses between attempts that fail."""

DOUBLINGS = 30  # a float cannot be doubled without end


def pause_s(failed: int, first: float, longest: float) -> float:
    """The pause after a number of failures in a row, s: doubled each time, from the first one up to the longest."""
    return min(first * 2.0 ** min(failed, DOUBLINGS), longest)
