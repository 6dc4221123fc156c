"""Site of a scenario: manifests moved to the position of the drone, zones, and Grants."""

from __future__ import annotations

import math
import re
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from fractus_core.api import Application, Drone, Zone
from fractus_core.api.grants import GrantSpec
from fractus_core.documents import BadDocument, dump_documents, parse_documents
from fractus_core.geo import LocalFrame, area_polygon

from fractus_sim.errors import ExperimentError
from fractus_sim.testbeds.standalone_testbed import grant_manifest, planned_grants, read_all_manifests

UNRESTRICTED_RADIUS_M = 1000.0
"""Radius of the operation area in the run without policies. It is larger than any flight."""

Position = tuple[float, float, float]
"""Latitude, longitude and altitude."""


@dataclass(frozen=True)
class ScenarioSite:
    """Manifests of a scenario at its site.

    Attributes:
        documents: Manifests, moved to the site.
        home: Latitude, longitude, and ground altitude above mean sea level.
    """

    documents: tuple[Mapping[str, Any], ...]
    home: Position

    @classmethod
    def read(cls, folder: Path, home: Position | None = None) -> Self:
        """Read the manifests, and move them so that the depot is at `home`.

        Raises:
            ExperimentError: A file cannot be read, or the manifests contain no depot.
        """
        documents: list[Any] = []
        for path in sorted(folder.glob("*.yaml")):
            try:
                documents += parse_documents(path.read_bytes(), str(path)).values
            except (OSError, BadDocument) as error:
                raise ExperimentError(f"{path}: {error}") from None
        depot = next((d["spec"]["location"] for d in documents if d["kind"] == "Depot"), None)
        if depot is None:
            raise ExperimentError(f"{folder} contains no Depot, which defines the home position; add one")
        if home is None:
            return cls(tuple(documents), (depot["lat"], depot["lon"], 25.0))
        moved = _HomeShift((depot["lat"], depot["lon"]), home[:2])
        return cls(tuple(moved.apply(d) for d in documents), home)

    def write(self, folder: Path) -> Path:
        """Write the moved manifests. Return the path of the file."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / "manifests.yaml"
        path.write_text(dump_documents(self.documents))
        return path

    def objects(self, kind: str) -> list[Mapping[str, Any]]:
        """Return the manifests of a kind."""
        return [d for d in self.documents if d["kind"] == kind]

    @cached_property
    def application(self) -> Application:
        """Application."""
        return Application.from_body(self.objects("Application")[0])

    @cached_property
    def drone(self) -> Drone:
        """Drone."""
        return Drone.from_body(self.objects("Drone")[0])

    def environment(self, component: str) -> dict[str, str]:
        """Return the environment of a component's container."""
        body = next(c for c in self.objects("Application")[0]["spec"]["components"] if c["name"] == component)
        return {variable["name"]: variable["value"] for variable in body["container"]["env"]}

    @cached_property
    def frame(self) -> LocalFrame:
        """Local frame in metres east and north of home."""
        return LocalFrame(self.home[0], self.home[1])

    def zone(self, name: str) -> Any:
        """Return the shape of a zone in metres."""
        body = next(d for d in self.objects("Zone") if d["metadata"]["name"] == name)
        return area_polygon(self.frame, Zone.from_body(body).spec.area)

    def grants(self, manifests: Path, *, policies: bool) -> list[dict[str, Any]]:
        """Return the Grants that the operator would create. Without policies, they allow everything everywhere.

        Each call returns Grants of another mission, because a service does not fly a completed mission again.

        Raises:
            ExperimentError: The application cannot be planned.
        """
        mission = uuid.uuid4().hex[:8]
        grants = [
            grant_manifest(spec if policies else self._unrestricted(spec))
            for spec in planned_grants(read_all_manifests([manifests]))
        ]
        for grant in grants:
            grant["metadata"]["uid"] += f"-{mission}"
        return grants

    def operation_area(self, grants: Sequence[Mapping[str, Any]]) -> list[Any]:
        """Return the shapes of the operation area in the Grants, in metres."""
        spec = GrantSpec.model_validate(grants[0]["spec"])
        return [area_polygon(self.frame, area) for area in spec.operation_area]

    def _unrestricted(self, spec: GrantSpec) -> GrantSpec:
        body = spec.to_dict()
        area = [{"circle": {"center": {"lat": self.home[0], "lon": self.home[1]}, "radius": UNRESTRICTED_RADIUS_M}}]
        body |= {"policies": [], "operationArea": area, "corridor": area}
        return GrantSpec.model_validate(body)


@dataclass(frozen=True, slots=True)
class _HomeShift:
    """Moves positions from one home to another. Distances and bearings are preserved."""

    old: tuple[float, float]
    new: tuple[float, float]

    def apply(self, value: Any) -> Any:
        """Move all positions in a manifest: mappings with lat and lon, and texts `lat,lon,alt`."""
        if isinstance(value, Mapping):
            moved = {key: self.apply(part) for key, part in value.items()}
            if "lat" in moved and "lon" in moved:
                moved["lat"], moved["lon"] = self.point(value["lat"], value["lon"])
            return moved
        if isinstance(value, list):
            return [self.apply(part) for part in value]
        if isinstance(value, str):
            return _POSITION.sub(self._move_text, value)
        return value

    def point(self, lat: float, lon: float) -> tuple[float, float]:
        """Move one point."""
        scale = math.cos(math.radians(self.old[0])) / math.cos(math.radians(self.new[0]))
        return round(self.new[0] + lat - self.old[0], 7), round(self.new[1] + (lon - self.old[1]) * scale, 7)

    def _move_text(self, match: re.Match[str]) -> str:
        lat, lon = self.point(float(match[1]), float(match[2]))
        return f"{lat:.7f},{lon:.7f},{match[3]}"


_POSITION = re.compile(r"(-?\d+\.\d+),\s*(-?\d+\.\d+),\s*(-?\d+(?:\.\d+)?)")


def format_position(place: Position) -> str:
    """Format a position as `lat,lon,alt`."""
    return f"{place[0]:.7f},{place[1]:.7f},{place[2]:g}"
