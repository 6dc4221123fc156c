"""Site of the monitor scenario: its named positions."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from fractus_sim.scenarios.scenario_site import Position, ScenarioSite

EXAMPLE = Path("examples/monitor")
DRIVER = "Waypoints"
PHOTOGRAPHER = "Photographer"
COURSE = "COURSE"
OUTSIDE_POSITIONS_M = {"WP-E1": (90.0, 90.0), "WP-E2": (150.0, -40.0), "WP-E3": (151.0, 80.0)}
"""Positions that the deviating program requests: metres east and north of home. WP-E3 is in the no-fly zone."""

DECLARED = ("WP1", "WP2", "WP3", "WP4")
DEVIATING = ("WP1", "WP2", "WP-E1", "WP3", "WP-E2", "WP-E3", "WP4")


class MonitorSite(ScenarioSite):
    """The monitor scenario at its site."""

    @cached_property
    def places(self) -> dict[str, Position]:
        """Positions WP1 to WP4 and WP-E1 to WP-E3 in degrees and metres above home."""
        positions: dict[str, Position] = {}
        for number, part in enumerate(self.environment(DRIVER)[COURSE].split(";"), start=1):
            lat, lon, alt = (float(value) for value in part.split(","))
            positions[f"WP{number}"] = (lat, lon, alt)
        altitude_m = positions["WP1"][2]
        for name, (east, north) in OUTSIDE_POSITIONS_M.items():
            lat, lon = self.frame.latlon(east, north)
            positions[name] = (lat, lon, altitude_m)
        return positions
