"""Reads H.264 and H.265 byte streams without decoding them."""
