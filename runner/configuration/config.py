"""A configuration, composed once; its parts are checked and built on demand."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar

from runner.configuration.build import Builder, PlanCheck
from runner.configuration.compose import compose, recompose
from runner.configuration.files import conf_directories
from runner.errors import ArgumentError

if TYPE_CHECKING:
    from runner.configuration.experiment import Experiment, LinkSettings, RateAtTime
    from runner.configuration.origin import Composed
    from runner.core.model import Vehicle
    from runner.pqos import Predictions
    from runner.pqos.track import Track
    from runner.rate_quality.study import Study
    from runner.settings import Setup

T = TypeVar("T")
CONF = "conf="
Base = tuple[dict[str, Any], str]  # a configuration composed before, and its location


class Configuration:
    """The configuration composed from files and overrides.

    composed  with the origin of each value
    user      directory whose files shadow the packaged ones and may add others
    runnable  also check what only a run needs: clips, devices and addresses are configured
    files     with that, also check that clips exist; None: if runnable
    bags      also check that configured bags have pictures of each camera; None: as files
    check     further check of a compiled plan, against the GStreamer registry

    `setup()`, `pqos()`, `study()` and `experiment()` raise ConfigError with all problems of the vehicle, its settings
    and the parts requested so far.
    """

    def __init__(
        self,
        composed: Composed,
        user: Path | None = None,
        *,
        runnable: bool = True,
        files: bool | None = None,
        bags: bool | None = None,
        check: PlanCheck | None = None,
    ) -> None:
        self._composed, self._user, self._runnable, self._check = composed, user, runnable, check
        self._files = runnable if files is None else files
        self._bags = self._files if bags is None else bags
        self._bases = [*conf_directories(user), Path.cwd()]  # directories of relative paths

    def drivable(self, check: PlanCheck) -> Configuration:
        """The same, with the checks that a run needs."""
        return Configuration(self._composed, self._user, check=check)

    @property
    def document(self) -> dict[str, Any]:
        """The configuration as plain data, not yet checked."""
        return self._composed.document

    @property
    def choices(self) -> Mapping[str, str]:
        """By group, the chosen file."""
        return self._composed.choices

    def listing(self) -> str:
        """The configuration as YAML, each value with the file or the override that it comes from as a comment."""
        from runner.configuration.listing import listing

        return listing(self._composed)

    def setup(self) -> Setup:
        return self._builder.checked(self._builder.setup)

    def vehicle(self) -> Vehicle:
        return self.setup().vehicle

    def pqos(self) -> tuple[Predictions, Track | None]:
        """The sources of predictions, and the drive that gives positions if no GPS does."""
        from runner.pqos import Predictions, build_pqos, build_track

        part = self._builder.part
        common = part(("pqos",), lambda settings: build_pqos(settings, self._bases))
        # A map that cannot be read is reported once, although the drive also uses its points.
        track = part(("pqos",), lambda settings: build_track(settings, self._bases)) if common else None
        own = self._of_uplinks(lambda settings: build_pqos(settings, self._bases)) if common else {}
        uplinks = self.document.get("uplinks") or {}
        sources = own if uplinks and own.keys() == uplinks.keys() else {"": common, **own}
        return self._builder.checked(Predictions({name: each for name, each in sources.items() if each})), track

    def _of_uplinks(self, make: Callable[[dict[str, Any]], T]) -> dict[str, T | None]:
        """By uplink with predictions of its own, what is made of their source; None: that is wrong."""
        from runner.configuration.uplinks import check_complete, pqos_of_uplinks

        builder = self._builder
        if not (builder.is_valid("uplinks") and builder.is_valid("pqos")):
            return {}

        def complete(name: str, settings: dict[str, Any]) -> T:
            check_complete(settings, name)
            return make(settings)

        return {
            name: builder.attempt(("uplinks", name, "pqos"), partial(complete, name, settings))
            for name, settings in pqos_of_uplinks(self.document).items()
        }

    def study(self) -> Study:
        """How rate-quality models of the cameras are measured."""
        from runner.rate_quality.study import read_study

        return self._builder.checked(self._builder.part(("study",), read_study))

    def experiment(self) -> Experiment:
        """The drive of the demo, and the requests of its operator."""
        from runner.configuration.experiment import Experiment, read_experiment

        builder = self._builder
        given = "experiment" in self.document
        experiment = builder.part(("experiment",), read_experiment) if given else Experiment()
        if experiment:
            builder.check_requests(experiment.requests)
        return builder.checked(experiment)

    def link(self, rates: RateAtTime | None = None, *, simulated: bool = False) -> LinkSettings | None:
        """The limited link between the demo's sides, if any.

        rates  to follow if it names no file; None: what the source of predictions states, for a lane that of its uplink
        simulated  uplinks need no lanes
        """
        from runner.configuration.experiment import lane_of, read_link, true_rates

        builder = self._builder
        if "link" not in self.document:
            return None
        followed = rates or builder.part(("pqos",), lambda settings: true_rates(settings, self._bases))
        if followed is None:
            return builder.checked(None)
        own = {} if rates else self._of_uplinks(lambda settings: true_rates(settings, self._bases))
        by_lane = {lane: each for name, each in own.items() if each and (lane := lane_of(self.document, name))}
        link = builder.part(("link",), lambda settings: read_link(settings, followed, self._bases, by_lane))
        if link:
            builder.check_link(link, needs_lanes=not simulated)
        return builder.checked(link)

    @cached_property
    def _builder(self) -> Builder:
        return Builder(self._composed, self._runnable, self._files, self._bags, self._check)


def with_choice(overrides: Sequence[str], group: str, config: Configuration) -> list[str]:
    """Overrides that also state what was chosen for a group, for a side that would choose something else by itself."""
    stated = any(word.lstrip("+~").partition("=")[0] == group for word in overrides)
    return [*overrides] if stated else [f"{group}={config.choices[group]}", *overrides]


def _directory(overrides: Sequence[str], user: Path | str | None) -> tuple[Sequence[str], Path | None]:
    """The overrides without conf=DIR, and that directory, or the one named separately.

    raises  ArgumentError if they differ
    """
    named = [*([Path(user)] if user else []), *(Path(w.removeprefix(CONF)) for w in overrides if w.startswith(CONF))]
    if len(set(named)) > 1:
        raise ArgumentError("conf", named[-1], f"must name one directory; {named[0]} was named, too")
    return [word for word in overrides if not word.startswith(CONF)], named[0] if named else None


def configuration(
    overrides: Sequence[str] = (),
    user: Path | str | None = None,
    *,
    base: Base | None = None,
    runnable: bool = True,
    files: bool | None = None,
    check: PlanCheck | None = None,
    site: Path | None = None,
    instead: Mapping[str, str] = MappingProxyType({}),
) -> Configuration:
    """Compose files and overrides.

    overrides  Hydra overrides, as on the command line, also conf=DIR
    user       directory of files of your own; None: that of conf=, or none
    base       configuration to which the overrides apply; None: the packaged and the user's files
    site       file of this machine, between the files and the overrides; None: none
    instead    by group, the choice in place of that of the packaged conf/config.yaml
    raises     ConfigError if they cannot be composed
    """
    overrides, user = _directory(overrides, user)
    composed = recompose(*base, overrides, user) if base else compose(overrides, user, site, instead)
    return Configuration(composed, user, runnable=runnable, files=files, check=check)
