"""The paper's method: events in, decisions and commands out. Pure: no clock, no log, no input or output."""
