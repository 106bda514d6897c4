"""Public: a streaming vehicle, for programs, see docs/sources.md."""

from runner.vehicle.live import LiveVehicle, live_vehicle

__all__ = ["LiveVehicle", "live_vehicle"]
