"""Keys: a small certificate authority, the keys of each side, and access control based on them."""
