"""Makes Hydra find and read configuration files: the user's before the packaged ones, all through `yaml_file`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import hydra._internal.defaults_list as tree
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.defaults_list import Overrides
from hydra.conf import JobConf, OverridesConf, RuntimeConf
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigNode, ConfigStore
from hydra.core.default_element import InputDefault
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf

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
def only_what_composing_needs() -> Iterator[None]:
    """Compose without two parts of Hydra that nothing here uses, and that take a fifth of the time.

    These are its own configuration of launcher, logging and so on, and the values to which interpolations in a defaults
    list may refer: it collects them for each file, although hardly any list has an interpolation.
    """
    group = ConfigStore.instance().repo["hydra"]
    own, choices = group["config.yaml"], tree._create_interpolation_map

    def choices_if_needed(overrides: Overrides, defaults_list: list[InputDefault], self_added: bool) -> DictConfig:
        needed = any(default.is_interpolation() for default in defaults_list)
        return choices(overrides, defaults_list, self_added) if needed else OmegaConf.create()

    group["config.yaml"] = _hydra_alone()
    tree._create_interpolation_map = choices_if_needed
    try:
        yield
    finally:
        group["config.yaml"] = own
        tree._create_interpolation_map = choices


@cache
def _hydra_alone() -> ConfigNode:
    """The keys of Hydra's own configuration that it reads and writes while it composes."""
    parts = {"overrides": OverridesConf, "runtime": RuntimeConf, "job": JobConf}
    node = OmegaConf.create({"defaults": [], "searchpath": [], "verbose": False, **parts})
    return ConfigNode(name="config.yaml", node=node, package=None, group="hydra", provider="hydra")
