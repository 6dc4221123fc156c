"""What must hold, as an experiment's file spells it; judged by `judging` from what was recorded."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from fractus_core.api.model import InvalidObject, Model
from fractus_core.api.names import Name
from pydantic import AfterValidator, Field

from fractus_sim.experiment.tasks import Altitude, ModeName, Place


def _regular(text: str) -> str:
    try:
        re.compile(text)
    except re.error as error:
        raise InvalidObject("", f"is no regular expression: {error}") from None
    return text


Expression = Annotated[str, Field(min_length=1), AfterValidator(_regular)]
Seconds = Annotated[float, Field(gt=0, description="Seconds of the experiment, from when all vehicles were ready.")]


class VehicleCheck(Model):
    """A check that every vehicle concerned must pass."""

    vehicles: tuple[Name, ...] = Field(default=(), description="Names of vehicles; unset: all.")


class Landed(VehicleCheck):
    """It flew, and stands on the ground, disarmed, at the end."""

    check: Literal["landed"]
    within: Seconds | None = None
    near_home: float | None = Field(default=None, gt=0, description="Metres from where it took off, at most.")


class NeverFlew(VehicleCheck):
    """It stayed on the ground."""

    check: Literal["neverFlew"]


class Reached(VehicleCheck, Place):
    """It was there once."""

    check: Literal["reached"]
    alt: Altitude | None = None
    tolerance: float = Field(default=3.0, gt=0, description="Metres.")
    within: Seconds | None = None


class ModeReached(VehicleCheck):
    """The autopilot was in this mode."""

    check: Literal["mode"]
    mode: ModeName
    after: Name | Literal["gpsLoss", "linkLoss", "nodePowerOff", "batteryDrop", "motorFailure", "windGust"] | None = (
        Field(default=None, description="Only after the first fault of this kind began.")
    )
    within: Seconds | None = Field(default=None, description="Seconds after that fault, or from the start.")


class StatusText(VehicleCheck):
    """The autopilot said this."""

    check: Literal["statustext"]
    matches: Expression = Field(description="Regular expression, found anywhere in a text.")
    absent: bool = Field(default=False, description="It must not be said instead.")


class AltitudeBand(VehicleCheck):
    """While in the air and beyond takeoff and landing, it stayed between two altitudes."""

    check: Literal["altitude"]
    min: Altitude | None = Field(
        default=None, description="Metres above home; judged from first reaching it to the last."
    )
    max: Altitude | None = Field(default=None, description="Metres above home.")


class SpeedLimit(VehicleCheck):
    """It was never faster over the ground."""

    check: Literal["speed"]
    max: float = Field(gt=0, description="Metres per second.")


class OutsideZone(VehicleCheck):
    """It was never inside a zone's area and altitude band."""

    check: Literal["outsideZone"]
    zone: Name
    margin: float = Field(default=0, ge=0, description="Metres it must keep from the zone's border.")


class InsideZone(VehicleCheck):
    """While in the air it was always inside a zone's area and altitude band."""

    check: Literal["insideZone"]
    zone: Name


class Battery(VehicleCheck):
    """So much charge was left at the end."""

    check: Literal["battery"]
    min: float = Field(ge=0, le=100, description="Percent.")


class TaskDone(VehicleCheck):
    """It flew its task to the end, uninterrupted."""

    check: Literal["task"]


class Separation(VehicleCheck):
    """Vehicles in the air kept apart."""

    check: Literal["separation"]
    min: float = Field(gt=0, description="Metres, in space.")


class ProgramEnded(Model):
    """A program ended as it should."""

    check: Literal["program"]
    program: Name
    exit_code: int = 0


class CallJudged(Model):
    """The services judged a call so (modes standalone and cluster; from the audit logs)."""

    check: Literal["call"]
    component: str | None = None
    method: str | None = None
    action: Literal["allow", "correct", "deny", "takeover"]
    code: str | None = Field(default=None, description="Such as InsideExclusionZone.")
    absent: bool = Field(default=False, description="There must be no such call instead.")


class AuditSound(Model):
    """The audit logs' chains verify (modes standalone and cluster)."""

    check: Literal["audit"]


class ApplicationPhase(Model):
    """An Application reached a phase (mode cluster)."""

    check: Literal["phase"]
    application: Name
    phase: Literal["Running", "Waiting", "Flying", "Returning", "Landed", "Completed", "Failed", "Invalid"]


class Detections(Model):
    """A program's detections agree with what the camera world had in view (mode standalone, a vehicle with a camera).

    The program appends a JSON object a line, with `class`, `lat` and `lon`, to the file that the variable
    FRACTUS_EXPERIMENT_DETECTIONS names.
    """

    check: Literal["detections"]
    kind: str = Field(description="Class of object, as the world's truth.json names it: car, person, ...")
    radius: float = Field(default=3.0, gt=0, description="Metres within which a detection counts as the object.")
    precision: float = Field(default=0, ge=0, le=1, description="Share of detections that are objects, at least.")
    recall: float = Field(default=0, ge=0, le=1, description="Share of the objects seen that were detected, at least.")


Check = Annotated[
    Landed | NeverFlew | Reached | ModeReached | StatusText | AltitudeBand | SpeedLimit | OutsideZone | InsideZone
    | Battery | TaskDone | Separation | ProgramEnded | CallJudged | AuditSound | ApplicationPhase
    | Detections,
    Field(discriminator="check"),
]  # fmt: skip
