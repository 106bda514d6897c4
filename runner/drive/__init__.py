"""Drives on disk: one file of JSON Lines for each side that logs, written while driving and read afterwards."""
