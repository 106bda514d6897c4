"""The control link over MQTT, and a private broker."""
