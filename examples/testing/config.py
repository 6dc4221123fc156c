"""Configuration of the example tests: the site, the flight plan and its restrictions."""

from __future__ import annotations

from fractus_testing import FlightPlan, Resources, World, no_fly, no_photo, polygon, stay_inside

HOME = (39.3600, 22.9450, 3.0)
"""Start position: latitude, longitude, ground height above mean sea level."""

WAYPOINTS = {
    "WP1": (39.36030, 22.94500, 15.0),
    "WP2": (39.36030, 22.94575, 15.0),
    "WP3": (39.36030, 22.94650, 15.0),
    "WP4": (39.36000, 22.94575, 15.0),
}
EXTRA_WAYPOINTS = {
    "WP-E1": (39.36080, 22.94610, 15.0),
    "WP-E2": (39.35950, 22.94640, 15.0),
    "WP-E3": (39.36075, 22.94540, 15.0),
}
"""Waypoints that are not part of the flight plan. WP-E3 is above the city hall."""

CITY = polygon((39.3585, 22.9435), (39.3585, 22.9480), (39.3618, 22.9480), (39.3618, 22.9435))
PERMITTED = polygon((39.35985, 22.94485), (39.35985, 22.94665), (39.36045, 22.94665), (39.36045, 22.94485))
CITY_HALL = polygon((39.36060, 22.94520), (39.36060, 22.94560), (39.36095, 22.94540))
SQUARE = polygon((39.36015, 22.94590), (39.36015, 22.94635), (39.36045, 22.94635), (39.36045, 22.94590))

flight_plan = FlightPlan(
    path=tuple(WAYPOINTS.values()),
    region=CITY,
    restrictions=(
        stay_inside("flight-path", PERMITTED, action="adjust"),
        no_fly("city-hall", CITY_HALL, action="abort", land_at=WAYPOINTS["WP4"][:2]),
        no_photo("square", SQUARE),
    ),
)
home_pos = HOME
expected_memory_mib = 60.0
min_resources = Resources(cpu="1", memory="256Mi")
app_params = {"ALTITUDE": "15", "WAYPOINTS": tuple(WAYPOINTS.values())}
deviating_params = {
    **app_params,
    "WAYPOINTS": tuple(
        {**WAYPOINTS, **EXTRA_WAYPOINTS}[name] for name in ("WP1", "WP2", "WP-E1", "WP3", "WP-E2", "WP-E3", "WP4")
    ),
}
photo_params = {**app_params, "PHOTO_S": "1"}
satellite = World(seed=7)
