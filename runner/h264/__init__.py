"""What is read from an H.264 or H.265 byte stream without decoding it."""
