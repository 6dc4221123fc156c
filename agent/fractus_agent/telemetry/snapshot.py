"""What a drone is doing at one moment, in the API's terms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from fractus_core.control import Outcome


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The drone at one moment."""

    flight_state: str
    controller: str
    connected: bool
    ready: bool
    in_air: bool
    mode: str
    position: tuple[float, float, float, str] | None
    """Degrees north, degrees east, metres, and what the metres are measured from."""
    battery_remaining: float
    battery_voltage_v: float
    battery_current_a: float
    missions: Mapping[str, Outcome] = field(default_factory=dict)
    velocity_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """East, north and up."""
    altitude_amsl_m: float = 0.0
    recording_problem: str = ""
    """Why flights are not recorded that should be; empty when nothing is wrong."""
    controller_reason: str = ""
    """Why no driver has control; empty while one has, or where that is not known."""
