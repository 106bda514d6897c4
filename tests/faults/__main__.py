"""usage: python tests/faults [PACKAGE ...]

Injects one fault at a time, one or two in each package, into a copy of the checkout and runs the tests that must fail.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

CHECKOUT = Path(__file__).resolve().parents[2]
LIMIT_S = 600  # ten times what the tests of one file take


class Fault(NamedTuple):
    """The text to replace in a file below runner/, and the tests that must notice."""

    file: str
    right: str
    wrong: str
    tests: str

    @property
    def package(self) -> str:
        return self.file.partition("/")[0]


FAULTS = [
    Fault("core/allocation.py", "if share * weights[name] < 1:", "if share * weights[name] <= 2:", "test_allocation"),
    Fault(
        "core/scaling.py",
        "bisect_right(model.b_min, bitrate) - 1",
        "bisect_right(model.b_min, bitrate)",
        "test_scaling",
    ),
    Fault("core/driving.py", "or not is_supervisor):", "and not is_supervisor):", "test_driving"),
    Fault("core/evidence.py", "- _gap_s(memory) - held_up_s", "- _gap_s(memory)", "test_sending"),
    Fault("core/follow_link.py", "state.t - link.t < START_S", "True", "test_rules"),
    Fault("core/learned.py", "- self.bias", "", "test_belief"),
    Fault("configuration/overrides.py", "if str(override.value) not in known:", "if False:", "test_config"),
    Fault("configuration/interpolation.py", "len(value) // CHARACTERS", "0", "test_hostile_files"),
    Fault(
        "vehicle/operators.py", "t - o.last_message > SILENT_S", "t - o.last_message > 9 * SILENT_S", "test_operators"
    ),
    Fault("vehicle/sending.py", "left - captured - self.usual_s", "left - captured", "test_sending"),
    Fault("vehicle/inbox.py", "len(waiting) >= MAX_QUEUED", "len(waiting) > MAX_QUEUED", "test_inbox"),
    Fault("operator/meter.py", "* 8 / 1000 /", "/ 1000 /", "test_meter"),
    Fault("operator/notes.py", "if form < before", "if form > before", "test_notes"),
    Fault("mqtt/messages.py", "if len(payload) > limit:", "if len(payload) > 2 * limit:", "test_messages"),
    Fault(
        "mqtt/link.py",
        "if self.check() or not self._listening.is_set():",
        "if self.check():",
        "integration/test_control",
    ),
    Fault("mqtt/copies.py", "> seen.taken", ">= seen.taken", "test_copies"),
    Fault("h264/access_unit.py", "kind == IDR, recovery,", "kind == SLICE, recovery,", "test_units"),
    Fault(
        "h264/sps.py", "frame_num_bits = read.ue(12) + 4", "frame_num_bits = read.ue(12)", "integration/test_keyframe"
    ),
    Fault(
        "gst/knobs.py",
        "if self._differs(assignment):\n            element.set_property",
        "if False:\n            element.set_property",
        "integration/test_apply",
    ),
    Fault(
        "gst/sender_filter.py",
        "IPV4_SOURCE, IPV6_SOURCE = NET + 12",
        "IPV4_SOURCE, IPV6_SOURCE = NET + 16",
        "test_sender_filter",
    ),
    Fault("pqos/track.py", "now = t % self.duration_s if self._loop else", "now =", "test_track"),
    Fault("pqos/table.py", 'if "" in names:', "if False:", "test_table"),
    Fault("link/bucket.py", "self._tokens -= size", "self._tokens -= size / 2", "test_link_parts"),
    Fault("link/relay.py", "up.put(len(data) + UDP_HEADERS,", "up.put(len(data) // 2,", "integration/test_link"),
    Fault("drive/latency.py", "FREEZE_FACTOR * means, means + FREEZE_MORE_S", "means, means", "test_statistics"),
    Fault(
        "drive/time_series.py",
        'np.searchsorted(line.t, at, "right") - 1',
        'np.searchsorted(line.t, at, "left") - 1',
        "test_series",
    ),
    Fault("rate_quality/curves.py", "if at in (0, len(gain)):", "if at < 0:", "test_curves"),
    Fault("rate_quality/choice.py", "if len(points) == len(groups)", "if points", "test_curves"),
    Fault(
        "synthetic/picture.py",
        "right, down = np.array([math.sin(yaw), -math.cos(yaw), 0.0])",
        "right, down = np.array([-math.sin(yaw), math.cos(yaw), 0.0])",
        "test_synthetic",
    ),
    Fault(
        "synthetic/__init__.py",
        "missing = [view for view in dict.fromkeys(views) if not",
        "missing = [view for view in dict.fromkeys(views) if True or not",
        "test_synthetic",
    ),
    Fault("page/server.py", "case _ if not viewer.visitor.may_drive:", "case _ if False:", "test_page_parts"),
    Fault("page/viewer.py", "if len(queue.live) > MAX_UNITS:", "if False:", "test_page_parts"),
    Fault(
        "page/control.py",
        "if token == self._holder:\n            self._closed_at = ",
        "if True:\n            self._closed_at = ",
        "test_page_parts",
    ),
    Fault("drive/read.py", "if kind not in OF_SEVERAL_THREADS and t < ", "if False and t < ", "test_replay"),
    Fault("verbs/validate.py", 'not name.startswith(".") and name.lower()', "name.lower()", "test_validate"),
    Fault("security/authority.py", "in keyring.PUBLIC else 0o600", "in keyring.PUBLIC else 0o640", "test_keys"),
    Fault(
        "security/identities.py",
        "if self._by_key else _stated(presented)",
        "or _stated(presented)",
        "test_company_keys",
    ),
    Fault("security/authority.py", "if role is Role.VEHICLE or role in VIEWERS:", "if role in VIEWERS:", "test_keys"),
    Fault("system/clocks.py", "if exchange.answered < exchange.received:", "if False:", "test_clocks"),
    Fault("system/reports.py", "if most or text in self._passed_on:", "if text in self._passed_on:", "test_reports"),
    Fault("bag/pictures.py", "if size < form.step * rows:", "if size < form.step * rows - form.step:", "test_bag"),
    Fault("bag/__init__.py", "abs(measured - whole) <= ROUND * whole", "measured == whole", "test_bag"),
    Fault("ros/inputs.py", "if other != camera:", "if False:", "test_ros_cameras"),
    Fault("metrics/prometheus.py", "if not is_own:", "if False:", "test_prometheus"),
    Fault(
        "turning.py",
        "right, bottom = native_width - left - value.width",
        "right, bottom = native_width - value.width",
        "test_graph",
    ),
]


def main(words: list[str]) -> int:
    chosen = [fault for fault in FAULTS if not words or fault.package in words]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        tests = list(dict.fromkeys(fault.tests for fault in chosen))
        if failed := [failure for failure in pool.map(_failure, tests) if failure]:
            print(f"fails without any fault: {', '.join(failed)}")
            return 2
        missed = 0
        for fault, caught in zip(chosen, pool.map(_caught, chosen), strict=True):
            print("caught" if caught else "MISSED", fault.file, "->", caught or fault.tests, flush=True)
            missed += not caught
    print(f"{len(chosen)} faults, {missed} missed")
    return 1 if missed else 0


def _caught(fault: Fault) -> str:
    """The first test that fails with the fault; "" if none does, or they did not end."""
    return _failure(fault.tests, fault)


def _failure(tests: str, fault: Fault | None = None) -> str:
    """The first test of a file that fails with a fault, or without; "" if none does, or they did not end."""
    with tempfile.TemporaryDirectory() as directory:
        copy = Path(directory, "checkout")
        left_out = shutil.ignore_patterns(".*", "node_modules", "__pycache__", "bench", "docs")
        shutil.copytree(CHECKOUT, copy, symlinks=True, ignore=left_out)
        if fault:
            file = copy / "runner" / fault.file
            text = file.read_text()
            assert text.count(fault.right) == 1, f"{fault.file}: {fault.right!r} occurs {text.count(fault.right)} times"
            file.write_text(text.replace(fault.right, fault.wrong))
        environment = {
            **os.environ,
            "PYTHONPATH": str(copy),
            "TOD_SHARED_DATA": str(CHECKOUT.parent / "shared" / "data"),
        }
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", f"tests/{tests}.py"]
        options: dict[str, Any] = {"cwd": copy, "env": environment, "capture_output": True, "text": True}
        try:
            done = subprocess.run(command, check=False, timeout=LIMIT_S, **options)
        except subprocess.TimeoutExpired:
            print(f"{tests}: not done after {LIMIT_S} s", flush=True)
            return "" if fault else tests
        failed = [line for line in done.stdout.splitlines() if line.startswith("FAILED ")]
        if done.returncode > 1 or (done.returncode and not failed):
            print(f"{tests}: {done.stdout}{done.stderr}", flush=True)
            return "" if fault else tests
        return failed[0].split(" ")[1] if failed else ""


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
