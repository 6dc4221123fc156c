"""Types and unit conversions of telemetry messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from fractus_runtime.mavlink_codec import Value

from fractus_vehicle.shaping import clamp
from fractus_vehicle.state import VehicleState

Values = Mapping[str, Value]
Builder = Callable[[VehicleState], Values | None]

UNKNOWN_U16 = 65535


def boot_ms(vehicle: VehicleState) -> int:
    """Milliseconds since boot."""
    return round(vehicle.time_s * 1000.0) & 0xFFFFFFFF


def boot_us(vehicle: VehicleState) -> int:
    """Microseconds since boot."""
    return round(vehicle.time_s * 1e6)


def centi(value: float) -> int:
    """Convert to hundredths, limited to 16 bits."""
    return int(clamp(round(value * 100.0), -32768, 32767))


def milli(value: float) -> int:
    """Convert to thousandths, limited to 16 bits."""
    return int(clamp(round(value * 1000.0), -32768, 32767))
