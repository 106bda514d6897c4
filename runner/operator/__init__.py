"""The operator's side while driving."""
