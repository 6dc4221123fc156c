"""Messages of InterUSS' Flight Planning Automated Testing Interface 0.7.0. Unknown fields are ignored, as it demands."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field

API_NAME = "Flight Planning Automated Testing Interface"
API_VERSION = "v0.7.0"

PlanningResult = Literal["Completed", "Rejected", "Failed", "NotSupported"]
PlanStatus = Literal["NotPlanned", "Planned", "OkToFly", "OffNominal", "Closed"]
Advisories = Literal["Unknown", "AtLeastOneAdvisoryOrCondition", "NoAdvisoriesOrConditions"]

_Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Message(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class LatLngPoint(_Message):
    """Position on the ground in degrees (WGS 84)."""

    lat: Annotated[_Finite, Field(ge=-90, le=90)]
    lng: Annotated[_Finite, Field(ge=-180, le=180)]


class Radius(_Message):
    """Radius in metres."""

    value: Annotated[_Finite, Field(gt=0)]
    units: Literal["M"] = "M"


class OutlineCircle(_Message):
    """Circle on the ground."""

    center: LatLngPoint
    radius: Radius


class OutlinePolygon(_Message):
    """Polygon on the ground. The first vertex is not repeated."""

    vertices: Annotated[tuple[LatLngPoint, ...], Field(min_length=3, max_length=10_000)]


class Altitude(_Message):
    """Altitude in metres above the ellipsoid (W84), the ground (SFC) or the takeoff place (Takeoff)."""

    value: _Finite
    reference: Literal["W84", "SFC", "Takeoff"]
    units: Literal["M"] = "M"


class Volume3D(_Message):
    """Outline on the ground with altitudes. Exactly one outline is set."""

    outline_circle: OutlineCircle | None = None
    outline_polygon: OutlinePolygon | None = None
    altitude_lower: Altitude | None = None
    altitude_upper: Altitude | None = None


class Time(_Message):
    """Time with its zone."""

    value: AwareDatetime
    format: Literal["RFC3339"] = "RFC3339"


class Volume4D(_Message):
    """Volume during a time."""

    volume: Volume3D
    time_start: Time | None = None
    time_end: Time | None = None


class BasicInformation(_Message):
    """Use, state and area of a flight."""

    usage_state: Literal["Planned", "InUse", "Closed"]
    uas_state: Literal["Nominal", "OffNominal", "Contingent", "NotSpecified"] | None = None
    area: Annotated[tuple[Volume4D, ...], Field(max_length=1000)] | None = None


class OperationalIntentInformation(_Message):
    """Information for ASTM F3548-21."""

    priority: int | None = None


class FlightPlanMessage(_Message):
    """A flight as its user describes it."""

    basic_information: BasicInformation
    astm_f3548_21: OperationalIntentInformation | None = None
    uspace_flight_authorisation: dict[str, Any] | None = None
    additional_information: dict[str, Any] | None = None


class UpsertRequest(_Message):
    """Request to create or change a flight plan."""

    flight_plan: FlightPlanMessage
    execution_style: Literal["Hypothetical", "IfAllowed", "InReality"]
    request_id: Annotated[str, Field(max_length=256)]


class ClearAreaRequest(_Message):
    """Request to remove all flight plans of an area."""

    request_id: Annotated[str, Field(max_length=256)]
    extent: Volume4D


class PlanningResponse(_Message):
    """Outcome of a request about a flight plan, and the status of the plan after it."""

    planning_result: PlanningResult
    flight_plan_status: PlanStatus
    notes: str | None = None
    includes_advisories: Advisories = "Unknown"
