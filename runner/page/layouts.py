"""Layouts of the page: what its windows show, and saving a new one without stopping the video."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

from runner.configuration.layout import NOWHERE, Layouts, Places, own_places
from runner.core.model import Vehicle
from runner.errors import ConfigError, RunError, UserError
from runner.schema import shortened

Answer = Callable[[str, str], None]  # result, reason


class PageLayouts:
    """In the page's thread.

    call_soon  calls a function there
    on_saved   called there with the layouts once one was saved
    """

    def __init__(
        self,
        vehicle: Vehicle,
        layouts: Layouts,
        call_soon: Callable[..., None],
        on_saved: Callable[[dict[str, Any]], None],
    ) -> None:
        self._vehicle, self._layouts, self._call_soon, self._on_saved = vehicle, layouts, call_soon, on_saved
        self._is_saving = False

    def stated(self) -> dict[str, Any]:
        """The places of the pictures in both views, and why a layout cannot be saved."""
        own, places = own_places(self._vehicle), self._layouts.places(self._vehicle)
        problem, drive = None if self._layouts.path else NOWHERE, self._layouts.drive_places(self._vehicle)
        saved = self._layouts.has_places(self._vehicle)
        return {"places": _places(places), "own": _places(own), "saved": saved, "drive": drive, "problem": problem}

    def save(self, kind: str, document: dict[str, Any], answer: Answer) -> None:
        """Save the layout of a view in its own thread: a hung disk must not stop the video."""
        if unknown := sorted(document.keys() - {kind}):
            answer("refused", f"{shortened(unknown[0])}: unknown key, only {kind} is allowed")
        elif self._is_saving:
            answer("refused", "another layout is being saved")
        else:
            self._is_saving = True
            save = self._layouts.save if kind == "layout" else self._layouts.save_drive
            work = partial(save, self._vehicle, document[kind])
            threading.Thread(target=self._write, args=(work, answer), name="layout", daemon=True).start()

    def _write(self, save: Callable[[], None], answer: Answer) -> None:
        """Runs in its own thread."""
        problem = "the layout could not be saved"
        try:
            save()
            problem = ""
        except ConfigError as error:
            problem = "; ".join(map(str, error.problems))
        except (UserError, RunError) as error:
            problem = str(error)
        finally:
            self._call_soon(self._on_written, problem, answer)

    def _on_written(self, problem: str, answer: Answer) -> None:
        self._is_saving = False
        if not problem:
            self._on_saved(self.stated())
        answer("refused" if problem else "applied", problem)


def _places(places: Places) -> dict[str, Any]:
    return {name: place and asdict(place) for name, place in places.items()}
