"""Processes, signals, files and ports of the operating system."""
