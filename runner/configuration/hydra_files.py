"""Makes Hydra find and read configuration files: the user's before the packaged ones, all through `yaml_file`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.conf import HydraConf
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigNode, ConfigStore
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import OmegaConf

from runner.configuration.yaml_file import load_node, read

SCHEME = "tod-runner"


class CheckedFiles(FileConfigSource):
    """A directory of files, each checked before Hydra sees its content."""

    @staticmethod
    def scheme() -> str:
        return SCHEME

    def is_config(self, config_path: str) -> bool:
        """Whether anything of that name exists; `load_config` reports why it cannot be read."""
        return (Path(self.path) / self._normalize_file_name(config_path)).exists()

    def load_config(self, config_path: str) -> ConfigResult:
        """raises ConfigError"""
        path = Path(self.path) / self._normalize_file_name(config_path)
        return ConfigResult(self.provider, self.full_path(), load_node(path), {"package": read(path).package})


class Directories(SearchPathPlugin):
    """Prepends directories; Hydra's own --config-dir appends, so that a user's file could not shadow a packaged one."""

    directories: Sequence[Path] = ()

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for directory in reversed(self.directories):
            search_path.prepend(SCHEME, f"{SCHEME}://{directory}")


def search(directories: Sequence[Path]) -> None:
    """Make Hydra search these directories in order."""
    Directories.directories = directories
    for plugin in (CheckedFiles, Directories):
        Plugins.instance().register(plugin)


@contextmanager
def without_hydras_own_groups() -> Iterator[None]:
    """Compose without Hydra's launcher, logging and so on, which nothing here uses: they take a fifth of the time."""
    group = ConfigStore.instance().repo["hydra"]
    own = group["config.yaml"]
    group["config.yaml"] = _hydra_without_groups()
    try:
        yield
    finally:
        group["config.yaml"] = own


@cache
def _hydra_without_groups() -> ConfigNode:
    node = OmegaConf.structured(HydraConf(defaults=[]))
    return ConfigNode(name="config.yaml", node=node, package=None, group="hydra", provider="hydra")
