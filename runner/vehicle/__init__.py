"""The vehicle's side while it drives."""
