"""Check types of experiment files. `judging` evaluates them."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from fractus_core.api.model import InvalidObject, Model
from fractus_core.api.names import Name
from pydantic import AfterValidator, Field

from fractus_sim.experiment.task_steps import Altitude, ModeName, Place


def _regular(text: str) -> str:
    try:
        re.compile(text)
    except re.error as error:
        raise InvalidObject("", f"is not a valid regular expression: {error}") from None
    return text


Expression = Annotated[str, Field(min_length=1), AfterValidator(_regular)]
DataLevel = Literal["app", "runtime", "autopilot"]
Seconds = Annotated[float, Field(gt=0, description="Seconds since all vehicles were ready.")]


class VehicleCheck(Model):
    """A check that each of its vehicles must pass."""

    vehicles: tuple[Name, ...] = Field(default=(), description="Names of vehicles. Unset: all vehicles.")


class Landed(VehicleCheck):
    """The vehicle flew, and is landed and disarmed at the end."""

    check: Literal["landed"]
    within: Seconds | None = None
    near_home: float | None = Field(
        default=None, gt=0, description="Maximum distance between landing and takeoff position, metres."
    )


class NeverFlew(VehicleCheck):
    """The vehicle stayed on the ground."""

    check: Literal["neverFlew"]


class Reached(VehicleCheck, Place):
    """The vehicle reached a position at least once."""

    check: Literal["reached"]
    alt: Altitude | None = None
    tolerance: float = Field(default=3.0, gt=0, description="Metres.")
    within: Seconds | None = None


class ModeReached(VehicleCheck):
    """The autopilot entered a mode."""

    check: Literal["mode"]
    mode: ModeName
    after: Name | Literal["gpsLoss", "linkLoss", "nodePowerOff", "batteryDrop", "motorFailure", "windGust"] | None = (
        Field(default=None, description="Consider only the time after the begin of the first fault of this kind.")
    )
    within: Seconds | None = Field(
        default=None, description="Maximum seconds after the begin of this fault. Without `after`: after the start."
    )


class StatusText(VehicleCheck):
    """The autopilot sent a STATUSTEXT that matches."""

    check: Literal["statustext"]
    matches: Expression = Field(description="Regular expression that is searched for in each text.")
    absent: bool = Field(default=False, description="Require that no text matches.")


class AltitudeBand(VehicleCheck):
    """The altitude stayed between two limits while airborne, excluding takeoff and landing."""

    check: Literal["altitude"]
    min: Altitude | None = Field(
        default=None,
        description="Metres above home. Evaluated between the first and the last time that the vehicle is above this altitude.",
    )
    max: Altitude | None = Field(default=None, description="Metres above home.")


class SpeedLimit(VehicleCheck):
    """The ground speed never exceeded a limit."""

    check: Literal["speed"]
    max: float = Field(gt=0, description="Metres per second.")


class OutsideZone(VehicleCheck):
    """The vehicle was never inside the area and altitude band of a zone."""

    check: Literal["outsideZone"]
    zone: Name
    margin: float = Field(default=0, ge=0, description="Minimum distance to the border of the zone, metres.")


class InsideZone(VehicleCheck):
    """The vehicle was always inside the area and altitude band of a zone while airborne."""

    check: Literal["insideZone"]
    zone: Name


class Battery(VehicleCheck):
    """The remaining battery charge at the end is at least `min`."""

    check: Literal["battery"]
    min: float = Field(ge=0, le=100, description="Percent.")


class TaskDone(VehicleCheck):
    """The vehicle completed its task without interruption."""

    check: Literal["task"]


class DataSent(VehicleCheck):
    """The drone sent an amount of data within limits (mode standalone)."""

    check: Literal["dataSent"]
    level: DataLevel = Field(
        default="app",
        description="app: frames of the programs; runtime: frames of the services to the programs; autopilot: MAVLink of the"
        " autopilot to the services.",
    )
    min: int = Field(default=0, ge=0, description="Bytes.")
    max: int | None = Field(default=None, ge=0, description="Bytes. Unset: unlimited.")


class Separation(VehicleCheck):
    """Airborne vehicles kept a minimum distance to each other."""

    check: Literal["separation"]
    min: float = Field(gt=0, description="Metres, three-dimensional.")


class ProgramEnded(Model):
    """A program ended with the expected exit code."""

    check: Literal["program"]
    program: Name
    exit_code: int = 0


class CallJudged(Model):
    """An audit log contains a call with this verdict (modes standalone and cluster)."""

    check: Literal["call"]
    component: str | None = None
    method: str | None = None
    action: Literal["allow", "correct", "deny", "takeover"]
    code: str | None = Field(default=None, description="Reason code, such as InsideExclusionZone.")
    absent: bool = Field(default=False, description="Require that there is no such call.")


class AuditSound(Model):
    """The hash chains of all audit logs are valid (modes standalone and cluster)."""

    check: Literal["audit"]


class ApplicationPhase(Model):
    """An Application reached a phase (mode cluster)."""

    check: Literal["phase"]
    application: Name
    phase: Literal["Running", "Waiting", "Flying", "Returning", "Landed", "Completed", "Failed", "Invalid"]


class Detections(Model):
    """Detections of a program match the objects in view of the camera world (mode standalone, vehicle with a camera).

    The program appends one JSON object with `class`, `lat` and `lon` per line to the file named by the environment
    variable FRACTUS_EXPERIMENT_DETECTIONS.
    """

    check: Literal["detections"]
    kind: str = Field(description="Object class as in the truth.json of the camera world: car, person, ...")
    radius: float = Field(default=3.0, gt=0, description="Maximum distance between a detection and its object, metres.")
    precision: float = Field(default=0, ge=0, le=1, description="Minimum share of detections that match an object.")
    recall: float = Field(default=0, ge=0, le=1, description="Minimum share of objects in view that were detected.")


Check = Annotated[
    Landed | NeverFlew | Reached | ModeReached | StatusText | AltitudeBand | SpeedLimit | OutsideZone | InsideZone
    | Battery | TaskDone | DataSent | Separation | ProgramEnded | CallJudged | AuditSound | ApplicationPhase
    | Detections,
    Field(discriminator="check"),
]  # fmt: skip
