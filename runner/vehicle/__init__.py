"""The vehicle's side while driving."""
