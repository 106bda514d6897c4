"""Sets the bitrate of cameras that encode by themselves, by commands of the user's. Nobody waits for them."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial

from runner.core.commands import KnobValues
from runner.core.graph_settings import KnobCommand
from runner.system.backoff import pause_s
from runner.system.children import KILLED_S, bound, ending

REPEAT_S = 60.0  # until a camera gets the same value again: it may have been restarted, and begun anew
LONGEST_PAUSE_S = 60.0  # between calls that fail
SHOWN = 200  # characters of what a call that failed has said


class CameraControls:
    """Those of all cameras that have a command.

    commands   by camera; None: it has none
    on_set     called, from any thread, when a camera has accepted a bitrate
    on_report  called, from any thread, with a camera and why its command fails, once for each reason
    """

    def __init__(
        self,
        commands: Mapping[str, KnobCommand | None],
        on_set: Callable[[], None],
        on_report: Callable[[str, str], None],
    ) -> None:
        self._by_name = {
            name: _Control(command, on_set, partial(on_report, name)) for name, command in commands.items() if command
        }

    def turn(self, changed: Mapping[str, KnobValues]) -> None:
        """Ask cameras for the bitrates among these knobs; returns at once."""
        for name, control in self._by_name.items():
            if isinstance(kbps := changed.get(name, {}).get("bitrate"), int):
                control.ask(kbps)

    def applied(self, name: str, knobs: KnobValues) -> KnobValues:
        """The values of a camera's knobs, with the bitrate that it has accepted; without one, it has none yet."""
        if name not in self._by_name:
            return knobs
        kbps, others = self._by_name[name].accepted, {knob: its for knob, its in knobs.items() if knob != "bitrate"}
        return others if kbps is None else {**others, "bitrate": kbps}

    def stop(self) -> None:
        """End all calls."""
        for control in self._by_name.values():
            control.stop()


class _Control:
    """Calls one camera's command, on a thread of its own: the newest value, and again after a failure."""

    def __init__(self, command: KnobCommand, on_set: Callable[[], None], on_report: Callable[[str], None]) -> None:
        self._command, self._on_set, self._on_report = command, on_set, on_report
        self._changed = threading.Condition()
        self._asked: int | None = None
        self._ends = False
        self._running: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._run, name="camera control", daemon=True)
        self.accepted: int | None = None

    def ask(self, kbps: int) -> None:
        with self._changed:
            if self._asked is None and not self._ends:
                self._thread.start()
            self._asked = kbps
            self._changed.notify()

    def stop(self) -> None:
        with self._changed:
            self._ends = True
            self._kill()
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join(2 * KILLED_S)

    def _run(self) -> None:
        failed, reported = 0, ""
        while True:
            with self._changed:
                kbps = self._asked
            assert kbps is not None
            began = time.monotonic()
            try:
                failure = self._call(kbps)
            except OSError as error:
                failure = f"its bitrate cannot be set: {error}"
            if self._ends:
                return
            failed = failed + 1 if failure else 0
            if failure is None:
                self.accepted = kbps
                self._on_set()
            if (failure or "") != reported:
                self._on_report(f"{failure}; trying again" if failure else "its bitrate can be set again")
                reported = failure or ""
            if self._waits(kbps, began, failed):
                return

    def _waits(self, kbps: int, began: float, failed: int) -> bool:
        """Wait until the next call is due; returns whether there is none."""
        least_s = self._command.every_s if not failed else pause_s(failed - 1, self._command.every_s, LONGEST_PAUSE_S)
        repeated = began + max(least_s, REPEAT_S)
        with self._changed:
            self._changed.wait_for(lambda: self._ends, max(0.0, began + least_s - time.monotonic()))
            if not failed:
                self._changed.wait_for(lambda: self._ends or self._asked != kbps, max(0.0, repeated - time.monotonic()))
            return self._ends

    def _call(self, kbps: int) -> str | None:
        """Run the command once; returns why it failed, in one line, None if it did not."""
        words = self._command.with_bitrate(kbps)
        program = words[0]
        if shutil.which(program) is None:
            return f"its bitrate cannot be set: {program}: no such program, or it may not be run"
        with tempfile.TemporaryFile() as output:  # not a pipe, which a process that the program leaves would hold open
            with self._changed:
                if self._ends:
                    return None
                self._running = process = subprocess.Popen(
                    bound(words), stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
                )
            try:
                status = process.wait(self._command.within_s)
                how = None if status == 0 else ending(status)
            except subprocess.TimeoutExpired:
                how = f"no answer within {self._command.within_s:g} s"
            self._kill()
            if how is None:
                return None
            output.seek(0)
            said = " ".join(output.read(4 * SHOWN).decode(errors="replace").split())[:SHOWN]
        return f"its bitrate cannot be set: {program}: {how}" + (f": {said}" if said else "")

    def _kill(self) -> None:
        """End the call, with whatever it has started."""
        with self._changed:
            if (process := self._running) is None:
                return
            self._running = None
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
            with suppress(subprocess.TimeoutExpired):
                process.wait(KILLED_S)
