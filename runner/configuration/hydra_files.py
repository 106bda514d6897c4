"""Makes Hydra find and read configuration files: the user's before the packaged ones, all through `yaml_file`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from hydra.conf import JobConf, OverridesConf, RuntimeConf
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigNode, ConfigStore
from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf

from runner.configuration.files import ROOT, SITE
from runner.configuration.yaml_file import load_node, read
from runner.resources import directory

SCHEME = "tod-runner"
Names = list[str]


class CheckedFiles(ConfigSource):
    """A directory of files, each checked before Hydra sees its content.

    instead  by group, what is chosen in place of the choice of the packaged conf/config.yaml
    site     what the site file states, composed after all other files; None: there is none
    """

    instead: Mapping[str, str] = {}
    site: Mapping[str, Any] | None = None

    @staticmethod
    def scheme() -> str:
        return SCHEME

    def available(self) -> bool:
        return self.is_group("")

    def is_group(self, config_path: str) -> bool:
        return Path(self.path, config_path).is_dir()

    def is_config(self, config_path: str) -> bool:
        """Whether anything of that name exists; `load_config` reports why it cannot be read."""
        return config_path == SITE or self._file(config_path).exists()

    def load_config(self, config_path: str) -> ConfigResult:
        """raises ConfigError"""
        if config_path == SITE:
            return ConfigResult(
                self.provider, self.full_path(), OmegaConf.create(dict(self.site or {})), {"package": "_global_"}
            )
        file = self._file(config_path)
        node = load_node(file)
        if config_path == ROOT:
            self._adapt(node, file)
        return ConfigResult(self.provider, self.full_path(), node, {"package": read(file).package})

    def _adapt(self, node: DictConfig, file: Path) -> None:
        """Choose what a side chooses by itself, and the site file as the last one."""
        chosen = [dict(entry) if isinstance(entry, DictConfig) else entry for entry in node.get("defaults", ["_self_"])]
        if file.is_relative_to(directory("conf")):
            for entry in chosen:
                if isinstance(entry, dict):
                    entry |= {group: name for group, name in self.instead.items() if group in entry}
        node["defaults"] = [*chosen, *([SITE] if self.site is not None else [])]

    def list(self, config_path: str, results_filter: ObjectType | None) -> Names:
        return sorted(file.stem for file in Path(self.path, config_path).glob("*.yaml"))

    def _file(self, config_path: str) -> Path:
        return Path(self.path, f"{config_path}.yaml")


class Directories(SearchPathPlugin):
    """Prepends directories; Hydra's own --config-dir appends, so that a user's file could not shadow a packaged one."""

    directories: Sequence[Path] = ()

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for each in reversed(self.directories):
            search_path.prepend(SCHEME, f"{SCHEME}://{each}")


def search(directories: Sequence[Path], instead: Mapping[str, str], site: Mapping[str, Any] | None) -> None:
    """Make Hydra search these directories in order; the others as in `CheckedFiles`."""
    Directories.directories = directories
    CheckedFiles.instead, CheckedFiles.site = instead, site
    for plugin in (CheckedFiles, Directories):
        Plugins.instance().register(plugin)


@contextmanager
def without_launchers() -> Iterator[None]:
    """Compose without Hydra's own configuration of launchers, logging and so on.

    Nothing here uses it, and it takes a quarter of the time.
    """
    group = ConfigStore.instance().repo["hydra"]
    own, group["config.yaml"] = group["config.yaml"], _hydra_alone()
    try:
        yield
    finally:
        group["config.yaml"] = own


@cache
def _hydra_alone() -> ConfigNode:
    """The keys of Hydra's own configuration that it reads and writes while it composes."""
    parts = {"overrides": OverridesConf, "runtime": RuntimeConf, "job": JobConf}
    node = OmegaConf.create({"defaults": [], "searchpath": [], "verbose": False, **parts})
    return ConfigNode(name="config.yaml", node=node, package=None, group="hydra", provider="hydra")
