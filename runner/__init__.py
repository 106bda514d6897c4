"""Declarative multi-camera streaming for teleoperated vehicles.

Two lines run through this package:

    conf/*.yaml -> config -> model -> graph -> Plan ------------> apply -> running pipelines
    event -> state -> rules (allocation, scaling) -> Decision -> commands -> apply

Everything left of `apply` is pure: no clock, no log, no GStreamer.
"""
