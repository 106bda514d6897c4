"""Declarative multi-camera streaming for teleoperated vehicles; ARCHITECTURE.md shows how its parts fit together."""
