"""Picture quality: metrics by name. Each of the four is described in the module of its name.

The modules are imported on demand: each needs its own libraries or tools.
"""

from __future__ import annotations

from pathlib import Path

from runner.errors import UserError, suggest
from runner.rate_quality.metrics.interface import Luma, Mask, Metric, PictureSize, QualityMeter

__all__ = ["NAMES", "VMAF_MODEL", "Luma", "Mask", "Metric", "PictureSize", "QualityMeter", "find_metric"]

NAMES = ("psnr", "mssim", "vmaf", "brisque")
VMAF_MODEL = "vmaf_v0.6.1"


def find_metric(
    name: str,
    *,
    brisque_model: Path | None = None,
    brisque_range: Path | None = None,
    vmaf_model: str = VMAF_MODEL,
) -> Metric:
    """The metric with this name.

    brisque_model, brisque_range  files of the regression and of the feature ranges, see `svr.py`; brisque needs both
    vmaf_model                    one that is built into libvmaf
    raises  UserError for an unknown name or model, a file that is missing or cannot be read;
            RunError if no ffmpeg has libvmaf
    """
    match name:
        case "psnr":
            from runner.rate_quality.metrics import psnr

            return psnr.metric()
        case "mssim":
            from runner.rate_quality.metrics import mssim

            return mssim.metric()
        case "vmaf":
            from runner.rate_quality.metrics import vmaf

            return vmaf.metric(vmaf_model)
        case "brisque":
            from runner.rate_quality.metrics import brisque

            return brisque.metric(brisque_model, brisque_range)
        case _:
            raise UserError("", "metric", repr(name), f"unknown metric{suggest(name, NAMES)}")
