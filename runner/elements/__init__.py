"""GStreamer's elements as a registry describes them, that of this machine or of another, and whether a plan fits."""
