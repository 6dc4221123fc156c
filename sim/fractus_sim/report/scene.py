"""What a map shows, whatever was flown: tracks, zones, nodes, and marks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from fractus_core.geo import LocalFrame

from fractus_sim.report.drawing import CORRECTED, FAULT, REFUSED
from fractus_sim.report.track import Track

XY = tuple[float, float]
ZoneKind = Literal["exclusion", "denial", "camera", "inclusion", "limit", "other"]
MARKS: Mapping[str, Mapping[str, Any]] = {"refused": REFUSED, "corrected": CORRECTED, "fault": FAULT}


@dataclass(frozen=True, slots=True)
class DrawnZone:
    """A zone; `shape` is shapely's, in metres of the scene's frame."""

    name: str
    kind: ZoneKind
    shape: Any


@dataclass(frozen=True, slots=True)
class DrawnNode:
    """An edge node and how far its WiFi reaches."""

    name: str
    at: XY
    reach_m: float | None
    used: bool


@dataclass(frozen=True, slots=True)
class Mark:
    """A numbered thing that happened.

    Attributes:
        kind: how it is drawn.
        at: where, in the scene's frame.
        origin: where the drone was, when `at` is where it was not let go.
        label: in the legend; the kind where there is none.
    """

    kind: Literal["refused", "corrected", "fault"]
    number: str
    at: XY
    origin: XY | None = None
    label: str = ""


@dataclass(frozen=True)
class Scene:
    """Everything on one map; metres east and north of the frame's origin.

    Attributes:
        area: shape of the operation area.
        depots: names and places.
        links: where the drone was when its traffic took a direct link, and where the node stands.
    """

    title: str
    frame: LocalFrame
    tracks: tuple[Track, ...]
    zones: tuple[DrawnZone, ...] = ()
    area: Any = None
    nodes: tuple[DrawnNode, ...] = ()
    depots: tuple[tuple[str, XY], ...] = ()
    marks: tuple[Mark, ...] = ()
    links: tuple[tuple[XY, XY], ...] = ()
