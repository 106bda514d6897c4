"""Resolve the interpolations of a composed tree."""

from __future__ import annotations

import pickle
import re
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, cast

from runner.configuration.interpolation import expands_within, spliced
from runner.configuration.origin import Composed, Part, merged
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


def is_determined(composed: Composed) -> bool:
    """Whether merging its parts in order results in the configuration."""
    whole = _merged(composed.parts)
    return whole is not None and whole.document == composed.document


def without(composed: Composed, part: Part) -> Composed | None:
    """A configuration determined by its parts, without one of them; None if the others alone are not valid."""
    return _merged([other for other in composed.parts if other is not part])


def _merged(parts: Sequence[Part]) -> Composed | None:
    try:
        return resolved(_config(merged(parts)), parts)
    except ConfigError:
        return None


def _config(document: dict[Any, Any]) -> DictConfig:
    """A document as OmegaConf holds it.

    Documents without one of their parts differ in few mappings: the others are copied, in a tenth of the time.
    """
    from omegaconf import OmegaConf

    config = OmegaConf.create(flags={"no_deepcopy_set_nodes": True})
    for key, value in document.items():
        config[key] = pickle.loads(_pickled_config(pickle.dumps(value))) if isinstance(value, dict) else value
    return config


@lru_cache(maxsize=1024)
def _pickled_config(document: bytes) -> bytes:
    """`_config` of a pickled document, pickled."""
    return pickle.dumps(_config(pickle.loads(document)))
