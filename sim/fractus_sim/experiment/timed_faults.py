"""Fault types of experiment files, with the autopilot parameters that each fault sets.

Vehicle faults use ArduPilot's simulation parameters (SIM_*), set over MAVLink. The same file therefore works with the
simulated vehicle and with ArduPilot SITL.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from fractus_core.api.model import Model
from fractus_core.api.names import Name
from pydantic import Field

Share = Annotated[float, Field(ge=0, le=1)]
Steps = tuple[tuple[float, dict[str, float]], ...]
GUST_STEP_S = 0.25


class TimedFault(Model):
    """Begin, duration and vehicles of a fault.

    Attributes:
        TITLE: Short description, formatted with the fields of the fault.
        PARAMETERS: Autopilot parameters that the fault sets, each to a number or to the value of a field.
    """

    TITLE: ClassVar[str]
    PARAMETERS: ClassVar[Mapping[str, str | float]] = {}

    at: float = Field(ge=0, description="Begin, seconds after `since`.")
    since: Literal["takeoff", "start"] = Field(
        default="takeoff", description="takeoff: takeoff of the vehicle; start: when all vehicles are ready."
    )
    duration: float | None = Field(default=None, gt=0, description="Seconds. Unset: until the end.")
    vehicles: tuple[Name, ...] = Field(default=(), description="Names of vehicles. Unset: all vehicles.")

    @property
    def title(self) -> str:
        """Short description for figures and tables."""
        return self.TITLE.format(fault=self)

    def steps(self) -> Steps:
        """Return the parameters to set, each with its delay in seconds. Empty if the fault sets no parameter."""
        values = {name: getattr(self, v) if isinstance(v, str) else v for name, v in self.PARAMETERS.items()}
        return ((0.0, values),) if values else ()


class GpsLoss(TimedFault):
    """The GPS receiver loses its fix."""

    TITLE = "GPS lost"
    PARAMETERS: ClassVar[Mapping[str, str | float]] = {"SIM_GPS_DISABLE": 1.0}
    fault: Literal["gpsLoss"]


class GpsNoise(TimedFault):
    """GPS positions are noisy."""

    TITLE = "GPS noise {fault.noise:g} m"
    PARAMETERS: ClassVar[Mapping[str, str | float]] = {"SIM_GPS_NOISE": "noise"}
    fault: Literal["gpsNoise"]
    noise: float = Field(gt=0, le=50, description="Standard deviation, metres.")


class BatteryDrop(TimedFault):
    """The battery voltage drops as if a cell failed."""

    TITLE = "battery drops to {fault.voltage:g} V"
    PARAMETERS: ClassVar[Mapping[str, str | float]] = {"SIM_BATT_VOLTAGE": "voltage"}
    fault: Literal["batteryDrop"]
    voltage: float = Field(gt=0, le=60, description="Open-circuit voltage of the pack when full, volts.")


class MotorFailure(TimedFault):
    """A motor produces less thrust than commanded."""

    fault: Literal["motorFailure"]
    motor: int = Field(default=1, ge=1, le=8, description="Motor number, counted from 1 as in ArduPilot.")
    thrust: Share = Field(default=0.0, description="Remaining share of thrust.")

    @property
    def title(self) -> str:
        """Short description for figures and tables."""
        return f"motor {self.motor} fails" if not self.thrust else f"motor {self.motor} at {self.thrust:.0%}"

    def steps(self) -> Steps:
        """Return the parameters that reduce the thrust of the motor."""
        return ((0.0, {"SIM_ENGINE_MUL": self.thrust, "SIM_ENGINE_FAIL": float(1 << (self.motor - 1))}),)


class WindGust(TimedFault):
    """The wind increases within `rise` seconds."""

    TITLE = "gust {fault.speed:g} m/s from {fault.direction:g}°"
    fault: Literal["windGust"]
    speed: float = Field(ge=0, lt=60, description="Metres per second.")
    direction: float = Field(default=270, ge=0, lt=360, description="Direction that the wind comes from, degrees.")
    turbulence: float = Field(default=0, ge=0, lt=30, description="Standard deviation of the turbulence, m/s.")
    rise: float = Field(default=1.0, ge=0, le=60, description="Seconds until full strength.")

    def steps(self) -> Steps:
        """Return wind parameters that increase in small steps."""
        count = max(round(self.rise / GUST_STEP_S), 1)
        first = {"SIM_WIND_DIR": self.direction, "SIM_WIND_TURB": self.turbulence}
        return tuple(
            (at * GUST_STEP_S, {**(first if not at else {}), "SIM_WIND_SPD": self.speed * (at + 1) / count})
            for at in range(count)
        )


class SetParameter(TimedFault):
    """An autopilot parameter is set to another value."""

    TITLE = "{fault.name} = {fault.value:g}"
    fault: Literal["parameter"]
    name: str = Field(pattern=r"^[A-Z][A-Z0-9_]{0,15}$", description="Name in ArduPilot.")
    value: float

    def steps(self) -> Steps:
        """Return the parameter."""
        return ((0.0, {self.name: self.value}),)


class LinkLoss(TimedFault):
    """A link drops all traffic in both directions."""

    TITLE = "link lost"
    fault: Literal["linkLoss"]
    link: Literal["groundStation", "companion", "uplink"] | None = Field(
        default=None,
        description="groundStation (mode vehicles): ground station and vehicle; companion (mode standalone): companion computer"
        " and autopilot; uplink (mode cluster): node and cluster. Unset: the link of the mode.",
    )


class NodePowerOff(TimedFault):
    """The companion computer loses power. All its processes end immediately; the vehicle keeps flying."""

    fault: Literal["nodePowerOff"]
    node: Name | None = Field(default=None, description="Name of a node without a vehicle (mode cluster).")

    @property
    def title(self) -> str:
        """Short description for figures and tables."""
        return f"power of {self.node} off" if self.node else "companion loses power"


Fault = Annotated[
    GpsLoss | GpsNoise | BatteryDrop | MotorFailure | WindGust | SetParameter | LinkLoss | NodePowerOff,
    Field(discriminator="fault"),
]
LINK_OF_MODE = {"vehicles": "groundStation", "standalone": "companion", "cluster": "uplink"}
