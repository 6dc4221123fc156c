"""Fractus agent: daemon of a drone or edge node (registration, Grants, certificate, telemetry, direct links)."""
