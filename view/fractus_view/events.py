"""Events for the page, and their encoding."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

# `view/web/src/events.ts` declares the same fields; a test compares them.


@dataclass(frozen=True, slots=True)
class Fix:
    """Position of a drone.

    Attributes:
        drone: its node.
        time_ms: Unix milliseconds, as of every event.
        lat: degrees.
        lon: degrees.
        amsl_m: metres above sea level.
        heading_deg: clockwise from north; None where it is not known.
    """

    drone: str
    time_ms: int
    lat: float
    lon: float
    amsl_m: float | None
    heading_deg: float | None


@dataclass(frozen=True, slots=True)
class State:
    """State of a drone: altitude above home, ground speed, remaining battery (0 to 1), and control authority.

    Attributes:
        seen_ms: when the drone itself said so; None: then.
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


@dataclass(frozen=True, slots=True)
class Gone:
    """A drone was removed. Its earlier events are void."""

    drone: str
    time_ms: int


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict on a call or on the flight, with the policies that decided."""

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


@dataclass(frozen=True, slots=True)
class Areas:
    """Zones, areas, planned paths and places of one origin as GeoJSON features. They replace the earlier ones.

    Each has `kind` (zone, operationArea, corridor, path, depot or edgeNode) and `name` among its properties, and maybe
    `altitude`, a `component` or an `application` that it is of, and a `state`.
    """

    origin: str
    time_ms: int
    features: Sequence[Mapping[str, Any]]


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
        traffic: Current path, `cloud` or `direct`; empty if unknown.
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
        stale_since_ms: Time since which the source has sent nothing; None if the state is current.
        text: Reason in one sentence.
    """

    time_ms: int
    stale_since_ms: int | None
    text: str


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


Event = Fix | State | Gone | Verdict | Note | Areas | Applications | Links | Policies | Contact | Picture | Problem

RESET = '{"type":"reset"}'
"""Earlier events are void. The complete current state follows."""

LIVE = '{"type":"live"}'
"""The current state is complete. Later events happen now."""

END = '{"type":"end"}'
"""The recording has ended."""


def encode(event: Event) -> str:
    """Return the event as a JSON object with the name of its type."""
    content = {"type": type(event).__name__.lower(), **asdict(event)}
    return json.dumps(content, separators=(",", ":"), allow_nan=False)


def message(id_: str, encoded: Iterable[str]) -> bytes:
    """Return encoded events as one message of the event stream. A client that reconnects sends its id."""
    return f"id: {id_}\ndata: [{','.join(encoded)}]\n\n".encode()
