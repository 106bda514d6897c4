"""Public: a vehicle that streams, for programs, see docs/sources.md."""

from runner.vehicle.live import LiveVehicle, live_vehicle

__all__ = ["LiveVehicle", "live_vehicle"]
