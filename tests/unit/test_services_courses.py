"""First leg of a route flown by the system."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.effects import FlightConstraints
from fractus_services.mobility.flight import route_following
from policy_world import at, compiled, spec


def unused(_motion: Any) -> Any:
    raise AssertionError("nothing is flown")


def route(*_: Any, **__: Any) -> Iterator[None]:
    """Fake route search. The first waypoint of its route is beside the drone."""
    yield from ()
    return ((0.2, 0.0), (100.0, 50.0))


@pytest.mark.parametrize(("altitude_m", "waypoint"), [(5.0, (0.2, 0.0)), (30.0, (100.0, 50.0))])
async def test_first_leg_skips_waypoint_near_drone_only_at_its_altitude(
    monkeypatch: pytest.MonkeyPatch, altitude_m: float, waypoint: tuple[float, float]
) -> None:
    monkeypatch.setattr(route_following, "route_steps", route)
    grant = compiled(operationArea=[])
    trip = route_following.SystemFlight(FlightConstraints(ActiveGrant("", "", spec(), grant), grant), "Transit", unused)
    result = await route_following.first_leg(grant.frame.latlon(100.0, 50.0), (30.0,), at(0, 0, alt=altitude_m), trip)
    assert result is not None
    leg, last, _ = result
    assert grant.frame.xy(leg.lat, leg.lon) == pytest.approx(waypoint, abs=0.01)
    assert leg.alt == 30.0
    assert last == (altitude_m == 30.0)
