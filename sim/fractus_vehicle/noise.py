"""Sensor noise as a function of seed and time. A request on one link therefore does not change data on other links."""

from __future__ import annotations

import math
import struct
import zlib

# Noise of ArduPilot's simulated sensors: at rest, and added at full throttle.
ACCEL_MPS2 = 0.05
ACCEL_THROTTLE_MPS2 = 0.25
GYRO_RPS = 0.002
GYRO_THROTTLE_RPS = 0.007
MAG_MGAUSS = 1.0


def gaussian(seed: int, tick: int, axis: int) -> float:
    """Return a standard normal number for a tick and an axis.

    A CRC, mixed twice, yields two uniform numbers for a Box-Muller transform. This is much cheaper than seeding a
    generator for each number, and good enough for noise.
    """
    key = struct.pack("<QIB", seed & 0xFFFFFFFFFFFFFFFF, tick & 0xFFFFFFFF, axis & 0xFF)
    one = _mixed(zlib.crc32(key))
    two = _mixed(one ^ 0x9E3779B9)
    return math.sqrt(-2.0 * math.log((one + 1.0) / 4294967297.0)) * math.cos(2.0 * math.pi * two / 4294967296.0)


def _mixed(value: int) -> int:
    value = (value ^ value >> 16) * 0x7FEB352D & 0xFFFFFFFF
    value = (value ^ value >> 15) * 0x846CA68B & 0xFFFFFFFF
    return value ^ value >> 16
