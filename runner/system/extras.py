"""The optional dependencies of this package, and how a user installs those that are missing."""

from __future__ import annotations

from importlib.util import find_spec

from runner.errors import RunError

EXTRAS = {  # top-level modules by extra, as in pyproject.toml
    "live": ("paho", "rich"),
    "page": ("aiohttp", "plotly"),
    "synthetic": ("numba", "rich"),
    "model": ("numba", "cv2", "matplotlib", "rich"),
    "report": ("matplotlib", "plotly", "rich"),
    "vmaf": ("imageio_ffmpeg",),
    "cluster": ("distributed",),
    "mcap": ("foxglove",),
    "bag": ("rosbags", "mcap"),
    "security": ("cryptography",),
    "metrics": ("prometheus_client",),
}


def how_to_install(extra: str) -> str:
    """The last part of a message about a missing module."""
    return f"install the extra {extra}, see docs/install.md"


def require(extra: str) -> None:
    """raises RunError, which names every module of the extra that is missing"""
    missing = [module for module in EXTRAS[extra] if find_spec(module) is None]
    if missing:
        modules = (
            f"the Python modules {', '.join(missing)} are" if missing[1:] else f"the Python module {missing[0]} is"
        )
        raise RunError(f"{modules} not installed: {how_to_install(extra)}")
