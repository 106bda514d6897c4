"""`python tests/faults` takes minutes; the text that each fault replaces must exist all the same."""

from __future__ import annotations

import runpy
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]


def test_each_fault_applies_to_the_source() -> None:
    faults = runpy.run_path(str(CHECKOUT / "tests" / "faults"))["FAULTS"]
    for fault in faults:
        assert (CHECKOUT / "runner" / fault.file).read_text().count(fault.right) == 1, fault
