"""Makes Hydra find and read configuration files: the user's before the packaged ones, all through `yaml_file`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from hydra.conf import JobConf, OverridesConf, RuntimeConf
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigNode, ConfigStore
from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import OmegaConf

from runner.configuration.yaml_file import load_node, read

SCHEME = "tod-runner"
Names = list[str]


class CheckedFiles(ConfigSource):
    """A directory of files, each checked before Hydra sees its content."""

    @staticmethod
    def scheme() -> str:
        return SCHEME

    def available(self) -> bool:
        return self.is_group("")

    def is_group(self, config_path: str) -> bool:
        return Path(self.path, config_path).is_dir()

    def is_config(self, config_path: str) -> bool:
        """Whether anything of that name exists; `load_config` reports why it cannot be read."""
        return self._file(config_path).exists()

    def load_config(self, config_path: str) -> ConfigResult:
        """raises ConfigError"""
        file = self._file(config_path)
        return ConfigResult(self.provider, self.full_path(), load_node(file), {"package": read(file).package})

    def list(self, config_path: str, results_filter: ObjectType | None) -> Names:
        return sorted(file.stem for file in Path(self.path, config_path).glob("*.yaml"))

    def _file(self, config_path: str) -> Path:
        return Path(self.path, f"{config_path}.yaml")


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
