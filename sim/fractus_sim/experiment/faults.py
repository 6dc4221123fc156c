"""Faults as an experiment's file spells them, and what each of them does: parameters of the autopilot, or a cut.

Vehicles are harmed through ArduPilot's own simulation parameters (SIM_*), sent by MAVLink, so that a file means the same
for a simulated vehicle of ours and for ArduPilot's SITL.
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
    """When a fault happens, how long it lasts, and to whom.

    Attributes:
        TITLE: The fault in a few words, with its fields.
        PARAMETERS: The autopilot's parameters that it sets, each to a number or to the value of a field.
    """

    TITLE: ClassVar[str]
    PARAMETERS: ClassVar[Mapping[str, str | float]] = {}

    at: float = Field(ge=0, description="Seconds after `since`.")
    since: Literal["takeoff", "start"] = Field(
        default="takeoff", description="takeoff: of the vehicle concerned; start: when all vehicles are ready."
    )
    duration: float | None = Field(default=None, gt=0, description="Seconds; unset: until the end.")
    vehicles: tuple[Name, ...] = Field(default=(), description="Names of vehicles; unset: all.")

    @property
    def title(self) -> str:
        """The fault in a few words, for pictures and tables."""
        return self.TITLE.format(fault=self)

    def steps(self) -> Steps:
        """Parameters to set, each with seconds after the beginning; empty for a fault that is no parameter."""
        values = {name: getattr(self, v) if isinstance(v, str) else v for name, v in self.PARAMETERS.items()}
        return ((0.0, values),) if values else ()


class GpsLoss(TimedFault):
    """The receiver loses its fix."""

    TITLE = "GPS lost"
    PARAMETERS: ClassVar[Mapping[str, str | float]] = {"SIM_GPS_DISABLE": 1.0}
    fault: Literal["gpsLoss"]


class GpsNoise(TimedFault):
    """Positions scatter."""

    TITLE = "GPS noise {fault.noise:g} m"
    PARAMETERS: ClassVar[Mapping[str, str | float]] = {"SIM_GPS_NOISE": "noise"}
    fault: Literal["gpsNoise"]
    noise: float = Field(gt=0, le=50, description="Standard deviation, metres.")


class BatteryDrop(TimedFault):
    """The pack's voltage falls as if a cell died."""

    TITLE = "battery drops to {fault.voltage:g} V"
    PARAMETERS: ClassVar[Mapping[str, str | float]] = {"SIM_BATT_VOLTAGE": "voltage"}
    fault: Literal["batteryDrop"]
    voltage: float = Field(gt=0, le=60, description="Open-circuit voltage of the pack when full, volts.")


class MotorFailure(TimedFault):
    """A motor gives less thrust than it is told to."""

    fault: Literal["motorFailure"]
    motor: int = Field(default=1, ge=1, le=8, description="Which motor, counted from 1 as ArduPilot does.")
    thrust: Share = Field(default=0.0, description="Share of its thrust that is left.")

    @property
    def title(self) -> str:
        """The fault in a few words."""
        return f"motor {self.motor} fails" if not self.thrust else f"motor {self.motor} at {self.thrust:.0%}"

    def steps(self) -> Steps:
        """Weaken the motor."""
        return ((0.0, {"SIM_ENGINE_MUL": self.thrust, "SIM_ENGINE_FAIL": float(1 << (self.motor - 1))}),)


class WindGust(TimedFault):
    """The wind freshens within `rise` seconds."""

    TITLE = "gust {fault.speed:g} m/s from {fault.direction:g}°"
    fault: Literal["windGust"]
    speed: float = Field(ge=0, lt=60, description="Metres per second.")
    direction: float = Field(default=270, ge=0, lt=360, description="Degrees it comes from.")
    turbulence: float = Field(default=0, ge=0, lt=30, description="Standard deviation of the turbulence, m/s.")
    rise: float = Field(default=1.0, ge=0, le=60, description="Seconds from calm to full strength.")

    def steps(self) -> Steps:
        """Raise the wind in small steps."""
        count = max(round(self.rise / GUST_STEP_S), 1)
        first = {"SIM_WIND_DIR": self.direction, "SIM_WIND_TURB": self.turbulence}
        return tuple(
            (at * GUST_STEP_S, {**(first if not at else {}), "SIM_WIND_SPD": self.speed * (at + 1) / count})
            for at in range(count)
        )


class SetParameter(TimedFault):
    """Any parameter of the autopilot takes another value."""

    TITLE = "{fault.name} = {fault.value:g}"
    fault: Literal["parameter"]
    name: str = Field(pattern=r"^[A-Z][A-Z0-9_]{0,15}$", description="ArduPilot's name of it.")
    value: float

    def steps(self) -> Steps:
        """Set it."""
        return ((0.0, {self.name: self.value}),)


class LinkLoss(TimedFault):
    """A link carries nothing for a while, in both directions."""

    TITLE = "link lost"
    fault: Literal["linkLoss"]
    link: Literal["groundStation", "companion", "uplink"] | None = Field(
        default=None,
        description="groundStation (mode vehicles): station and vehicle; companion (mode standalone): companion computer"
        " and autopilot; uplink (mode cluster): the node and the rest of the cluster. Unset: the one of the mode.",
    )


class NodePowerOff(TimedFault):
    """The companion computer loses its power: all that runs on it dies at once, and the vehicle flies on."""

    fault: Literal["nodePowerOff"]
    node: Name | None = Field(default=None, description="Mode cluster: a node without a vehicle.")

    @property
    def title(self) -> str:
        """The fault in a few words."""
        return f"power of {self.node} off" if self.node else "companion loses power"


Fault = Annotated[
    GpsLoss | GpsNoise | BatteryDrop | MotorFailure | WindGust | SetParameter | LinkLoss | NodePowerOff,
    Field(discriminator="fault"),
]
LINK_OF_MODE = {"vehicles": "groundStation", "standalone": "companion", "cluster": "uplink"}
