"""Keys: a small certificate authority, what each side holds, and what follows from it."""
