"""The daemon of a node: registration, telemetry, grants."""
