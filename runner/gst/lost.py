"""Cameras, and sound, whose sources cannot be opened: why, and when each is tried again."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from runner.errors import RunError
from runner.graph import Plan
from runner.gst.aside import HUNG_STARTING, change_in_thread
from runner.system.backoff import pause_s

if TYPE_CHECKING:
    from runner.sound import SoundPlan
    from runner.voice import VoicePlan

BACKOFF_S = (1.0, 10.0)  # between two attempts: doubled from the first value up to the second
POLL_S = 0.25


@dataclass(slots=True)
class _Loss:
    """due: time.monotonic of the next attempt; is_tested: the source alone does not open, so no viewer need try it"""

    reason: str
    due: float
    attempts: int = 1
    is_tested: bool = False
    must_test: bool = True


class LostCameras:
    """May be used from any thread. Each source is tested in a thread of its own: a device may block it for good.

    A source that does not open by itself, such as a missing device, is tested again until it does. One that opens and
    delivers nothing, such as an address where no camera answers, is tried again by its viewers, when that is due.

    lost      by camera that does not open at the start, why
    problem   returns why a source does not open; None: it opens
    on_found  called with a camera whose source opens again; if it raises, the camera is still lost
    """

    def __init__(
        self,
        plans: Sequence[Plan | SoundPlan | VoicePlan],
        lost: Mapping[str, str],
        problem: Callable[[Plan | SoundPlan | VoicePlan], str | None],
        on_found: Callable[[str], None],
    ) -> None:
        self._plans, self._problem, self._on_found = {plan.name: plan for plan in plans}, problem, on_found
        self._changed = threading.Condition()
        due = time.monotonic() + BACKOFF_S[0]
        self._losses = {name: _Loss(why, due, is_tested=True) for name, why in lost.items()}
        self._testing: set[str] = set()
        self._stopped = False
        threading.Thread(target=self._run, name="lost", daemon=True).start()

    def reasons(self) -> dict[str, str]:
        """By camera that is lost, why."""
        with self._changed:
            return {name: loss.reason for name, loss in self._losses.items()}

    def may_open(self, name: str) -> bool:
        """Whether a viewer may make the camera open now."""
        with self._changed:
            loss = self._losses.get(name)
            return loss is None or (not loss.must_test and time.monotonic() >= loss.due)

    def fail(self, name: str, why: str) -> None:
        """An attempt to open a camera has failed, or delivers nothing."""
        with self._changed:
            loss = self._losses.setdefault(name, _Loss(why, 0.0, attempts=0))
            self._put_off(loss, why)
            self._changed.notify_all()

    def delay(self, name: str, why: str) -> None:
        """An attempt to open a camera takes long."""
        with self._changed:
            self._losses.setdefault(name, _Loss(why, 0.0, attempts=0, must_test=False))

    def open(self, name: str) -> None:
        """A camera delivers pictures."""
        with self._changed:
            self._losses.pop(name, None)

    def stop(self) -> None:
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def _put_off(self, loss: _Loss, why: str) -> None:
        loss.reason, loss.due = why, time.monotonic() + pause_s(loss.attempts, *BACKOFF_S)
        loss.attempts += 1
        loss.must_test = True

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._losses or self._stopped)
                self._changed.wait_for(lambda: self._stopped, POLL_S)
                if self._stopped:
                    return
                now = time.monotonic()
                idle = [(name, loss) for name, loss in self._losses.items() if name not in self._testing]
                due = [name for name, loss in idle if loss.must_test and now >= loss.due]
                self._testing.update(due)
            for name in due:
                change_in_thread(f"test {name}", partial(self._test, name), partial(self._note_hung, name))

    def _note_hung(self, name: str) -> None:
        with self._changed:
            if (loss := self._losses.get(name)) and name in self._testing:
                loss.reason = f"its source {HUNG_STARTING}"

    def _test(self, name: str) -> None:
        try:
            why = self._problem(self._plans[name])
            with self._changed:
                loss = self._losses.get(name)
                is_found = loss is not None and why is None and loss.is_tested and not self._stopped
            if is_found:
                self._on_found(name)
        except RunError as error:
            why = str(error)
        except Exception as error:  # it must be tried again: nothing else does
            why = f"{type(error).__name__}: {error}"
        with self._changed:
            self._testing.discard(name)
            if loss := self._losses.get(name):
                self._note_test(name, loss, why)

    def _note_test(self, name: str, loss: _Loss, why: str | None) -> None:
        if why is not None:
            loss.is_tested = True
            self._put_off(loss, why)
        elif loss.is_tested:
            del self._losses[name]
        else:
            loss.must_test = False
