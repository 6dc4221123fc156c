"""Task steps of experiment files."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

from fractus_core.api.geometry import Latitude, Longitude
from fractus_core.api.model import InvalidObject, Model
from pydantic import Field, model_validator

ModeName = Literal["STABILIZE", "ALT_HOLD", "AUTO", "GUIDED", "LOITER", "RTL", "LAND", "BRAKE", "SMART_RTL"]
Altitude = Annotated[float, Field(ge=0, le=5000, description="Metres above home.")]


class Place(Model):
    """A horizontal position: degrees, or metres from the home position of the vehicle."""

    lat: Latitude | None = None
    lon: Longitude | None = None
    north: float | None = Field(default=None, ge=-50_000, le=50_000, description="Metres north of home.")
    east: float | None = Field(default=None, ge=-50_000, le=50_000, description="Metres east of home.")

    @model_validator(mode="after")
    def _check_coordinates(self) -> Self:
        degrees = {self.lat is None, self.lon is None}
        metres = {self.north is None, self.east is None}
        if len(degrees) == 2 or len(metres) == 2 or degrees == metres:
            raise InvalidObject("", "requires lat and lon, or north and east")
        return self

    @property
    def label(self) -> str:
        """Text for titles."""
        if self.lat is not None and self.lon is not None:
            return f"{self.lat:.6f}, {self.lon:.6f}"
        return f"{self.north:g} m north, {self.east:g} m east"


class TaskStep(Model):
    """Step of a task."""

    TITLE: ClassVar[str]

    @property
    def title(self) -> str:
        """Short description of the step."""
        return self.TITLE.format(step=self)


class Takeoff(TaskStep):
    """Arm in GUIDED and take off."""

    TITLE = "takeoff to {step.alt:g} m"
    do: Literal["takeoff"]
    alt: Altitude


class Goto(Place, TaskStep):
    """Fly to a position and stop."""

    TITLE = "goto {step.label} at {step.alt:g} m"
    do: Literal["goto"]
    alt: Altitude
    within: float = Field(default=1.5, gt=0, le=100, description="Maximum distance to the target, metres.")


class Speed(TaskStep):
    """Set the ground speed of the following steps."""

    TITLE = "speed {step.speed:g} m/s"
    do: Literal["speed"]
    speed: float = Field(gt=0, le=50, description="Metres per second.")


class Hold(TaskStep):
    """Hold the position."""

    TITLE = "hold {step.seconds:g} s"
    do: Literal["hold"]
    seconds: float = Field(gt=0, le=3600)


class SetMode(TaskStep):
    """Change the flight mode."""

    TITLE = "mode {step.mode}"
    do: Literal["mode"]
    mode: ModeName


class Waypoint(Place):
    """A waypoint of a mission."""

    alt: Altitude
    hold: float = Field(default=0, ge=0, le=3600, description="Hold time, seconds.")


class FlyMission(TaskStep):
    """Upload a mission, take off, and fly it in AUTO until it ends."""

    do: Literal["mission"]
    takeoff: Altitude = Field(description="Takeoff altitude, metres above home.")
    waypoints: tuple[Waypoint, ...] = Field(min_length=1, max_length=500)
    land: Literal["home", "last"] = Field(default="home", description="Return to launch, or land at the last waypoint.")

    @property
    def title(self) -> str:
        """Short description of the step."""
        return f"mission of {len(self.waypoints)} waypoints"


class ReturnToLaunch(TaskStep):
    """Return to launch and land."""

    TITLE = "return to launch"
    do: Literal["returnToLaunch"]


class Land(TaskStep):
    """Land at the current position."""

    TITLE = "land"
    do: Literal["land"]


Step = Annotated[
    Takeoff | Goto | Speed | Hold | SetMode | FlyMission | ReturnToLaunch | Land,
    Field(discriminator="do"),
]
