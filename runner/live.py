"""Public: a streaming vehicle and an operator's side, for programs, see docs/sources.md and docs/operator.md."""

from runner.operator.live import LiveOperator, live_operator
from runner.vehicle.live import LiveVehicle, live_vehicle

__all__ = ["LiveOperator", "LiveVehicle", "live_operator", "live_vehicle"]
