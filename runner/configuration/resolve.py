"""Resolve the interpolations of a composed tree."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

from runner.configuration.interpolation import expands_within, spliced
from runner.configuration.origin import Composed, Part
from runner.errors import ConfigError, Problem

if TYPE_CHECKING:
    from omegaconf import DictConfig

MAX_RESOLVED = 50_000  # values of a configuration with its interpolations expanded


def resolved(config: DictConfig, parts: Sequence[Part]) -> Composed:
    """The composed tree as plain data, interpolations resolved.

    raises  ConfigError
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    written = OmegaConf.to_container(config)
    if not expands_within(written, MAX_RESOLVED):
        file = next(part.file for part in parts if "${" in str(part.content))
        rule = f"interpolations, ${{...}}, are nested too deeply or expand to more than {MAX_RESOLVED} values"
        raise ConfigError([Problem(file, "", None, rule)])
    try:
        document = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        origin = Composed({}, list(parts))
        path = tuple(int(p) if p.isdigit() else p for p in re.split(r"[.\[\]]+", str(error.full_key or "")) if p)
        raise ConfigError([origin.problem(path, None, str(error).splitlines()[0])]) from None
    document, moved = spliced(written, document)
    return Composed(cast("dict[str, Any]", document), list(parts), moved).without_graph_parts()
