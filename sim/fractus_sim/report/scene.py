"""Content of a map: tracks, zones, nodes and marks."""

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
    """A zone. `shape` is a shapely geometry in metres of the scene's frame."""

    name: str
    kind: ZoneKind
    shape: Any


@dataclass(frozen=True, slots=True)
class DrawnNode:
    """An edge node with its WiFi range."""

    name: str
    at: XY
    reach_m: float | None
    used: bool


@dataclass(frozen=True, slots=True)
class Mark:
    """A numbered event mark.

    Attributes:
        kind: Drawing style.
        at: Position in the scene's frame.
        origin: Position of the drone, if `at` is a position that was denied.
        label: Legend text. Default: the kind.
    """

    kind: Literal["refused", "corrected", "fault"]
    number: str
    at: XY
    origin: XY | None = None
    label: str = ""


@dataclass(frozen=True)
class Scene:
    """All objects of a map, in metres east and north of the frame's origin.

    Attributes:
        area: Shape of the operation area.
        depots: Names and positions.
        links: Position of the drone when its traffic moved to a direct link, and position of the node.
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
