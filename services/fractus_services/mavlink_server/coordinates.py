"""Frames of geographic coordinates, and the limits within which ArduCopter accepts positions."""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as mavlink

# Frames by the reference of their altitude: mean sea level, home, or terrain. The deprecated *_INT frames are equivalent.
ABSOLUTE_FRAMES = frozenset({mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT})
RELATIVE_FRAMES = frozenset({mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT})
TERRAIN_FRAMES = frozenset({mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT, mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT})
GLOBAL_FRAMES = ABSOLUTE_FRAMES | RELATIVE_FRAMES | TERRAIN_FRAMES

# ArduPilot rejects positions above this altitude.
ALTITUDE_MAX_M = 83_000.0


def valid_coordinates(lat_e7: int, lon_e7: int) -> bool:
    """Return True if latitude and longitude are in range."""
    return abs(lat_e7) <= 900_000_000 and abs(lon_e7) <= 1_800_000_000
