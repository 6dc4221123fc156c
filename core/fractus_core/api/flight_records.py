"""Records of the flight of a plan, as the agent of its drone and the management API return them."""

from __future__ import annotations

import re
from datetime import datetime
from typing import Annotated, Literal

from pydantic import FailFast, Field

from fractus_core.api.model import OpenModel
from fractus_core.api.names import DNS_LABEL, is_subdomain

MAX_RECORDS = 500
"""Maximum number of records in a page."""

# A node may be compromised: the first invalid item ends the validation, so that many of them use no memory.
_Names = Annotated[tuple[str, ...], FailFast()]
_MAX_NAMES = 100

VerdictKind = Literal["call", "takeover", "control", "monitor"]


class FlightVerdict(OpenModel):
    """A verdict on a call, a change of the control authority, or an alarm in flight."""

    time: datetime = Field(description="Time of the node.")
    kind: VerdictKind = Field(
        description="call: verdict on a call of a component. takeover: the system took control. control: other changes of"
        " control. monitor: alarm or correction in flight."
    )
    component: str = Field(default="", description="Component that called; empty: no call.")
    method: str = Field(default="", description="Method of the call; empty: no call.")
    action: str = Field(description="Action: allow, correct, deny or takeover for a call.")
    code: str = Field(default="", description="Machine-readable CamelCase reason; empty: none.")
    reason: str = Field(default="", description="Human-readable explanation; empty: none.")
    policies: _Names = Field(default=(), max_length=_MAX_NAMES, description="Policies that caused the verdict.")
    filters: _Names = Field(default=(), max_length=_MAX_NAMES, description="Privacy filters that a picture needed.")
    lat: float | None = Field(default=None, description="Latitude of the drone in degrees; unset: unknown.")
    lon: float | None = Field(default=None, description="Longitude of the drone in degrees; unset: unknown.")
    alt: float | None = Field(default=None, description="Altitude of the drone in metres above home; unset: unknown.")


class TrackPoint(OpenModel):
    """Position of the drone while its motors ran."""

    time: datetime = Field(description="Time of the node.")
    lat: float | None = Field(default=None, description="Latitude in degrees; unset: unknown.")
    lon: float | None = Field(default=None, description="Longitude in degrees; unset: unknown.")
    alt: float | None = Field(default=None, description="Altitude in metres above home; unset: unknown.")
    amsl: float | None = Field(default=None, description="Altitude in metres above mean sea level; unset: unknown.")
    speed: float | None = Field(default=None, description="Ground speed in metres per second; unset: unknown.")
    battery: float | None = Field(default=None, description="State of charge, 0 to 1; unset: unknown.")
    mode: str = Field(default="", description="Flight mode of the autopilot.")
    controller: str = Field(
        description="Control authority: system, pilot, the component of the driver, or other for a driver of another application."
    )
    in_air: bool = Field(description="True if the drone was in the air.")


class RecordedPicture(OpenModel):
    """A picture as a component received it, after privacy filters."""

    id: str = Field(description="Id of the picture in its request.", max_length=64)
    time: datetime = Field(description="Time of the picture.")
    component: str = Field(description="Component that took the picture.")
    size_bytes: int = Field(ge=0, description="Size of the JPEG in bytes.")


_CONTINUE = Field(
    default=None,
    alias="continue",
    max_length=64,
    description="Parameter `continue` of the next page; unset: no more records for now.",
)


class VerdictPage(OpenModel):
    """One page of the verdicts of a flight."""

    items: Annotated[tuple[FlightVerdict, ...], FailFast()] = Field(
        max_length=MAX_RECORDS, description="Verdicts in the order of time."
    )
    continue_: str | None = _CONTINUE


class TrackPage(OpenModel):
    """One page of the track of a flight."""

    items: Annotated[tuple[TrackPoint, ...], FailFast()] = Field(
        max_length=MAX_RECORDS, description="Positions in the order of time, at most two per second."
    )
    continue_: str | None = _CONTINUE


class PicturePage(OpenModel):
    """One page of the recorded pictures of a flight."""

    items: Annotated[tuple[RecordedPicture, ...], FailFast()] = Field(
        max_length=MAX_RECORDS, description="Pictures in the order of recording."
    )
    continue_: str | None = _CONTINUE


def records_path(namespace: str, plan: str, records: str) -> str:
    """Return the path of records of a plan at the recording endpoint of an agent.

    Raises:
        ValueError: A name is not the name of an object.
    """
    if not re.fullmatch(DNS_LABEL, namespace) or not is_subdomain(plan):
        raise ValueError("not the name of a namespace or a flight plan")
    return f"/v1/namespaces/{namespace}/plans/{plan}/{records}"
