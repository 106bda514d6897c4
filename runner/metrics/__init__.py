"""Metrics of a running side, served if the configuration names a port."""
