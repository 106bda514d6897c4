"""Rate-quality models of live encoders, measured offline: the running system never scores video."""
