"""A drive that was logged: read back, put on one time axis, measured, drawn."""
