"""Events for the page, and their encoding. `fractus_view.typescript` generates the types of the page from this module."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, NotRequired, TypedDict

from fractus_core.api.policies import ZoneUse


@dataclass(frozen=True, slots=True)
class Fix:
    """Position of a drone.

    Attributes:
        drone: Name of the drone's node, as in all events.
        time_ms: Time in Unix milliseconds, as in all events.
        lat: Latitude in degrees.
        lon: Longitude in degrees.
        amsl_m: Altitude above mean sea level in metres, or None if it is unknown.
        heading_deg: Heading in degrees clockwise from north, or None if it is unknown.
    """

    drone: str
    time_ms: int
    lat: float
    lon: float
    amsl_m: float | None
    heading_deg: float | None


@dataclass(frozen=True, slots=True)
class State:
    """State of a drone.

    Attributes:
        altitude_m: Altitude above home in metres.
        speed_mps: Ground speed in metres per second.
        battery: Remaining charge from 0 to 1.
        mode: Flight mode of the autopilot, or an empty string.
        controller: Control authority, or an empty string.
        phase: Phase of the flight, for people.
        seen_ms: Time of the drone's report in Unix milliseconds, or None if it equals `time_ms`.
        flight_ms: Start of the current or latest flight in Unix milliseconds, or None if the source contains no flight.
    """

    drone: str
    time_ms: int
    altitude_m: float | None
    speed_mps: float | None
    battery: float | None
    mode: str
    controller: str
    phase: str
    seen_ms: int | None = None
    flight_ms: int | None = None


@dataclass(frozen=True, slots=True)
class Gone:
    """A drone was removed. Its earlier events are void."""

    drone: str
    time_ms: int


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict on a call or on the flight.

    Attributes:
        kind: Kind of the audit entry: `call`, `monitor` or `takeover`.
        component: Component that called, or an empty string.
        method: Called method, or an empty string.
        action: Verdict on a call: `allow`, `correct`, `deny` or `takeover`.
        code: Reason for programs.
        reason: Reason for people.
        policies: Names of the policies that decided.
        lat: Latitude of the drone in degrees, or None if it is unknown.
        lon: Longitude of the drone in degrees, or None if it is unknown.
    """

    drone: str
    time_ms: int
    kind: str
    component: str
    method: str
    action: str
    code: str
    reason: str
    policies: Sequence[str]
    lat: float | None
    lon: float | None


@dataclass(frozen=True, slots=True)
class Note:
    """Log line. Levels are those of foxglove.Log, from 1 (debug) to 5 (fatal)."""

    drone: str
    time_ms: int
    level: int
    text: str


class AltitudeBand(TypedDict):
    """Altitude limits of an area in metres. A missing limit is unlimited."""

    lower: NotRequired[float]
    upper: NotRequired[float]
    reference: NotRequired[str]


class FeatureProperties(TypedDict):
    """Properties of an area or place.

    Attributes:
        kind: zone, operationArea, corridor, path, controlPoint, depot or edgeNode.
        uses: Effects of the policies that select a zone, from the most to the least restrictive. Missing: unknown.
        number: Number of a control point, which is its index in `controlPoints`.
    """

    kind: str
    name: str
    uses: NotRequired[Sequence[ZoneUse]]
    number: NotRequired[int]
    application: NotRequired[str]
    component: NotRequired[str]
    altitude: NotRequired[AltitudeBand]
    description: NotRequired[str]
    state: NotRequired[str]


class Geometry(TypedDict):
    """GeoJSON geometry."""

    type: Literal["Polygon", "MultiPolygon", "LineString", "MultiLineString", "Point"]
    coordinates: Sequence[Any]


class Feature(TypedDict):
    """GeoJSON feature: a zone, area, planned path or place."""

    type: Literal["Feature"]
    properties: FeatureProperties
    geometry: Geometry


@dataclass(frozen=True, slots=True)
class Areas:
    """Zones, areas, planned paths and places of one origin. They replace the earlier ones of this origin."""

    origin: str
    time_ms: int
    features: Sequence[Feature]


@dataclass(frozen=True, slots=True)
class Application:
    """State of an application. `reason` is for programs, `text` for people."""

    name: str
    drone: str
    phase: str
    reason: str
    text: str


@dataclass(frozen=True, slots=True)
class Applications:
    """All current applications."""

    time_ms: int
    applications: Sequence[Application]


@dataclass(frozen=True, slots=True)
class Link:
    """Possible direct link between a drone and a node.

    Attributes:
        lat: Latitude of the node in degrees.
        lon: Longitude of the node in degrees.
        traffic: Current path of the traffic, `cloud` or `direct`, or an empty string if it is unknown.
    """

    name: str
    drone: str
    node: str
    lat: float
    lon: float
    phase: str
    traffic: str
    reason: str
    text: str


@dataclass(frozen=True, slots=True)
class Links:
    """All currently possible direct links."""

    time_ms: int
    links: Sequence[Link]


@dataclass(frozen=True, slots=True)
class Policy:
    """Summary of a policy and its zones. Without zones, the policy applies everywhere."""

    name: str
    text: str
    zones: Sequence[str]


@dataclass(frozen=True, slots=True)
class Policies:
    """All current policies."""

    time_ms: int
    policies: Sequence[Policy]


@dataclass(frozen=True, slots=True)
class Contact:
    """Staleness of the shown state. Sent about once per second, even without changes.

    Attributes:
        stale_since_ms: Time of the last contact in Unix milliseconds, or None if the state is current.
        text: Reason in one sentence, or an empty string.
    """

    time_ms: int
    stale_since_ms: int | None
    text: str


@dataclass(frozen=True, slots=True)
class Records:
    """Completeness of the verdicts. Without this event, the source always has all verdicts.

    Attributes:
        verdicts_problem: Reason why verdicts may be missing, or an empty string.
    """

    time_ms: int
    verdicts_problem: str


@dataclass(frozen=True, slots=True)
class PictureSource:
    """Completeness of the pictures of a cluster. Without this event, a cluster provides no pictures.

    Attributes:
        problem: Reason why pictures may be missing, or an empty string.
    """

    time_ms: int
    problem: str


@dataclass(frozen=True, slots=True)
class Picture:
    """Picture after privacy filters. The page requests it by `id`."""

    drone: str
    time_ms: int
    id: str


@dataclass(frozen=True, slots=True)
class Problem:
    """Problem with the shown data, in one sentence."""

    time_ms: int
    text: str


Event = (
    Fix
    | State
    | Gone
    | Verdict
    | Note
    | Areas
    | Applications
    | Links
    | Policies
    | Contact
    | Records
    | PictureSource
    | Picture
    | Problem
)

RESET = '{"type":"reset"}'
"""Earlier events are void. The complete current state follows."""

LIVE = '{"type":"live"}'
"""The current state is complete. Later events are sent as they happen."""

END = '{"type":"end"}'
"""The recording has ended."""


def encode(event: Event) -> str:
    """Return the event as a JSON object with the name of its type."""
    content = {"type": type(event).__name__.lower(), **asdict(event)}
    return json.dumps(content, separators=(",", ":"), allow_nan=False)


def stream_message(id_: str, encoded: Iterable[str]) -> bytes:
    """Return encoded events as one message of the event stream. A client that reconnects sends the id of its last message."""
    return f"id: {id_}\ndata: [{','.join(encoded)}]\n\n".encode()
