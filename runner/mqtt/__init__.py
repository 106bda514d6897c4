"""The control link over MQTT, and a broker of one's own."""
