"""Public: types that are passed to a rule, see docs/rules.md."""

from runner.core.model import Camera, Kbps, Mode, RateQualityModel, Roi, Vehicle

__all__ = ["Camera", "Kbps", "Mode", "RateQualityModel", "Roi", "Vehicle"]
