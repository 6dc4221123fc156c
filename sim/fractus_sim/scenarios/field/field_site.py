"""Site of the field experiment: its named positions."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path

import shapely

from fractus_sim.scenarios.scenario_site import Position, ScenarioSite

EXAMPLE = Path("examples/field")
NAVIGATOR = "Navigator"
VIEWER = "AerialViewer"
ZIGZAG = "ZIGZAG"
ALTITUDE_M = 10.0
OUTSIDE_POSITIONS_M = {"WP-E1": (62.0, 130.0), "WP-E2": (226.0, 60.0)}
"""Forbidden positions that the violating program requests: metres east and north of home, outside of its area."""

ABOVE_STRIPE = "WP-S"
"""Hover position above the no-photo stripe.

Each run hovers at this position for longer than the picture interval, so that at least one picture is requested.
"""


class FieldSite(ScenarioSite):
    """The field experiment at its site."""

    @cached_property
    def places(self) -> dict[str, Position]:
        """Positions CTRL1, WP1 to WP9, CTRL2, WP-E1, WP-E2 and WP-S in degrees and metres above home."""
        component = next(c for c in self.application.spec.components if c.name == NAVIGATOR)
        positions: dict[str, Position] = {}
        waypoints: list[Position] = []
        for number, point in enumerate(component.control_points, start=1):
            start = point.point.position if point.point is not None else None
            if start is not None:
                positions[f"CTRL{number}"] = (start.lat, start.lon, start.alt or ALTITUDE_M)
            waypoints += [(p.lat, p.lon, p.alt or ALTITUDE_M) for p in point.path or ()]
        for part in self.environment(NAVIGATOR)[ZIGZAG].split(";"):
            lat, lon, alt = (float(value) for value in part.split(","))
            waypoints.append((lat, lon, alt))
        positions |= {f"WP{number}": place for number, place in enumerate(waypoints, start=1)}
        for name, (east, north) in OUTSIDE_POSITIONS_M.items():
            lat, lon = self.frame.latlon(east, north)
            positions[name] = (lat, lon, ALTITUDE_M)
        positions[ABOVE_STRIPE] = self._above_stripe(positions)
        return positions

    def _above_stripe(self, places: Mapping[str, Position]) -> Position:
        """Return the position between WP6 and WP7 that is farthest inside the no-photo stripe."""
        path = shapely.LineString([self.frame.xy(*places[name][:2]) for name in ("WP6", "WP7")])
        middle = path.intersection(self.zone("no-photo")).centroid
        return (*self.frame.latlon(middle.x, middle.y), ALTITUDE_M)
