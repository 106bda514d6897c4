"""The operator's side while it drives."""
