"""What the page is told: one value for each thing that happened, and how it is written on the wire."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

# `view/web/src/events.ts` declares the same fields; a test compares them.


@dataclass(frozen=True, slots=True)
class Fix:
    """Where a drone was.

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
    """What a drone did: altitude above home, speed over ground, share of the battery that is left, and who flies.

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
    """A drone is no more: all that was told of it is void."""

    drone: str
    time_ms: int


@dataclass(frozen=True, slots=True)
class Verdict:
    """What was decided on a call, or on the flight itself, with the policies that decided it."""

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
    """A line of a log; levels as in foxglove.Log, from 1 (debug) to 5 (fatal)."""

    drone: str
    time_ms: int
    level: int
    text: str


@dataclass(frozen=True, slots=True)
class Areas:
    """Zones, areas, planned paths and places of one origin: all that hold from now on, as GeoJSON features.

    Each has `kind` (zone, operationArea, corridor, path, depot or edgeNode) and `name` among its properties, and maybe
    `altitude`, a `component` or an `application` that it is of, and a `state`.
    """

    origin: str
    time_ms: int
    features: Sequence[Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Application:
    """Where an application stands; `reason` is for programs, `text` for people."""

    name: str
    drone: str
    phase: str
    reason: str
    text: str


@dataclass(frozen=True, slots=True)
class Applications:
    """All applications that there are from now on."""

    time_ms: int
    applications: Sequence[Application]


@dataclass(frozen=True, slots=True)
class Link:
    """A direct link that a drone may have with a node.

    Attributes:
        lat: degrees, of the node.
        lon: degrees, of the node.
        traffic: the path that it takes now, cloud or direct; empty where that is not known.
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
    """All direct links that there may be from now on."""

    time_ms: int
    links: Sequence[Link]


@dataclass(frozen=True, slots=True)
class Policy:
    """What a policy says, in a phrase, and where; no zones: everywhere."""

    name: str
    text: str
    zones: Sequence[str]


@dataclass(frozen=True, slots=True)
class Policies:
    """All policies that hold from now on."""

    time_ms: int
    policies: Sequence[Policy]


@dataclass(frozen=True, slots=True)
class Contact:
    """Whether what is shown is so now. It is told every second or so, whether anything happens or not.

    Attributes:
        stale_since_ms: since when nothing is heard of where all this comes from; None: it is heard.
        text: why, in one sentence.
    """

    time_ms: int
    stale_since_ms: int | None
    text: str


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture after privacy filters; `id` names it to the server."""

    drone: str
    time_ms: int
    id: str


@dataclass(frozen=True, slots=True)
class Problem:
    """Something that the user of the page should know of what they see, in one sentence."""

    time_ms: int
    text: str


Event = Fix | State | Gone | Verdict | Note | Areas | Applications | Links | Policies | Contact | Picture | Problem

RESET = '{"type":"reset"}'
"""What was told before is void: all that holds follows."""

LIVE = '{"type":"live"}'
"""Everything up to now was told; what follows happens now."""

END = '{"type":"end"}'
"""A recording has no more."""


def encode(event: Event) -> str:
    """As an object of JSON, with the name of its type."""
    content = {"type": type(event).__name__.lower(), **asdict(event)}
    return json.dumps(content, separators=(",", ":"), allow_nan=False)


def message(id_: str, encoded: Iterable[str]) -> bytes:
    """Encoded events as one message of an event stream, which a client that comes back names as the last it heard."""
    return f"id: {id_}\ndata: [{','.join(encoded)}]\n\n".encode()
