"""Public: types that are passed to a rule, see docs/rules.md, and of what a program shows, see docs/operator.md."""

from runner.core.model import Camera, Kbps, Mode, RateQualityModel, Roi, Vehicle
from runner.core.view import NOWHERE, Seen

__all__ = ["NOWHERE", "Camera", "Kbps", "Mode", "RateQualityModel", "Roi", "Seen", "Vehicle"]
