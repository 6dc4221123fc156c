"""Plans and flights that a restriction affects."""

from datetime import UTC, datetime

import pytest
from fractus_core.airspace.flight_volumes import flight_volumes
from fractus_core.airspace.plan_status import reserved_volume
from fractus_core.airspace.restriction_impact import affected_flights, affected_plans
from fractus_core.api import FlightPlan, Grant, Policy, Zone
from fractus_core.api.policies import PolicySpec
from fractus_core.planning import Settings, operation_area
from fractus_core.planning.grant_compiler import flight_grant
from test_airspace_flights import BEGIN_S, END_S, GROUND_M, located
from test_planning import PATH, application, at, inventory, navigator

NOW_S = BEGIN_S - 3600
DRONE = located("d")
FLYING = DRONE.from_body(DRONE.to_dict() | {"status": {"flightState": "flying"}})
APPLICATION = application(navigator(PATH))
VOLUMES = flight_volumes(
    APPLICATION, DRONE, inventory([DRONE]), Settings(safety_radius_m=7.0), begin_s=BEGIN_S, end_s=END_S
)
CROSSING = [at(50, -20), at(70, -20), at(70, 20), at(50, 20)]
FAR = [at(5000, -20), at(5020, -20), at(5020, 20), at(5000, 20)]


def rfc3339(time_s):
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def restriction(corners=CROSSING, zone=None, selector=None, **more) -> tuple[PolicySpec, Zone]:
    area = {"polygon": {"exterior": corners}}
    policy = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["z"], **(selector or {})}, **more}
    parsed = Policy.from_body({"kind": "Policy", "metadata": {"name": "p"}, "spec": policy})
    return parsed.spec, Zone.from_body(
        {"kind": "Zone", "metadata": {"name": "z"}, "spec": {"area": area, **(zone or {})}}
    )


def plan(name="plan", namespace="team", state="Accepted", drone="d"):
    start = rfc3339(BEGIN_S)
    spec = {"template": "t", "waypoints": [at(60, 0, 10)], "window": {"start": start, "duration": 15}}
    volumes = [reserved_volume(volume).to_dict() for volume in VOLUMES]
    body = {"metadata": {"name": name, "namespace": namespace, "uid": f"uid-{name}"}, "spec": spec}
    return FlightPlan.from_body(
        {"kind": "FlightPlan", **body, "status": {"state": state, "drone": drone, "volumes": volumes}}
    )


def grant(phase="Active"):
    area = operation_area(APPLICATION.spec, inventory([DRONE]).depots, 7.0)
    spec = flight_grant(APPLICATION, DRONE, inventory([DRONE]), area).to_dict()
    return Grant.from_body({"kind": "Grant", "metadata": {"name": "g"}, "spec": spec, "status": {"phase": phase}})


def plans(restricted: tuple[PolicySpec, Zone], listed=None, now_s=NOW_S):
    found = affected_plans(*restricted, listed or [plan()], {"d": DRONE}, now_s)
    return [each.name for each in found]


def flights(restricted: tuple[PolicySpec, Zone], granted=None, drone=FLYING):
    found = affected_flights(*restricted, [granted or grant()], {drone.name: drone}, NOW_S)
    return [(each.application, each.drone) for each in found]


FLIGHT = [(APPLICATION.name, "d")]


@pytest.mark.parametrize("state", ["Accepted", "Activated", "Nonconforming", "Contingent"])
def test_plan_through_the_zone_is_affected(state):
    (affected,) = affected_plans(*restriction(), [plan(state=state)], {"d": DRONE}, NOW_S)
    assert (affected.namespace, affected.name, affected.state, affected.drone) == ("team", "plan", state, "d")
    assert (affected.begin.timestamp(), affected.end.timestamp()) == (BEGIN_S, END_S)


@pytest.mark.parametrize("state", ["Draft", "Rejected", "Ended"])
def test_plan_that_reserves_nothing_is_not_affected(state):
    assert plans(restriction(), [plan(state=state)]) == []


def test_plans_are_listed_by_namespace_and_name():
    listed = [plan("b"), plan("a"), plan("c", namespace="city")]
    found = affected_plans(*restriction(), listed, {"d": DRONE}, NOW_S)
    assert [(each.namespace, each.name) for each in found] == [("city", "c"), ("team", "a"), ("team", "b")]


def test_zone_beside_the_flight_affects_nothing():
    assert plans(restriction(FAR)) == []
    assert flights(restriction(FAR)) == []


def test_zone_around_the_whole_flight_affects_it():
    around = [at(-300_000, -300_000), at(300_000, -300_000), at(300_000, 300_000), at(-300_000, 300_000)]
    assert plans(restriction(around)) == ["plan"]
    assert flights(restriction(around)) == FLIGHT


@pytest.mark.parametrize(
    ("altitude", "affected"),
    [
        ({"lower": 200}, False),
        ({"lower": 50}, True),
        ({"lower": GROUND_M + 200, "reference": "amsl"}, False),
        ({"upper": GROUND_M - 10, "reference": "amsl"}, True),
        # Terrain is unknown, so the band may be anywhere.
        ({"lower": 200, "reference": "terrain"}, True),
    ],
)
def test_altitude_band_is_compared_with_the_flight(altitude, affected):
    assert bool(plans(restriction(zone={"altitude": altitude}))) == affected
    assert bool(flights(restriction(zone={"altitude": altitude}))) == affected


def test_band_above_home_counts_if_the_drone_is_unknown():
    restricted = restriction(zone={"altitude": {"lower": 200}})
    assert [each.name for each in affected_plans(*restricted, [plan(drone="gone")], {}, NOW_S)] == ["plan"]


@pytest.mark.parametrize(
    ("times", "affected"),
    [
        ({"validUntil": rfc3339(BEGIN_S)}, False),
        ({"validUntil": rfc3339(BEGIN_S + 60)}, True),
        ({"validFrom": rfc3339(END_S)}, True),
        ({"validFrom": rfc3339(END_S + 60)}, False),
    ],
)
def test_validity_is_compared_with_the_window(times, affected):
    assert bool(plans(restriction(**times))) == affected
    (zone,) = [{"schedule": [times]}]
    assert bool(plans(restriction(zone=zone))) == affected


def test_part_of_the_plan_in_the_validity_is_reported():
    restricted = restriction(validFrom=rfc3339(BEGIN_S + 60), validUntil=rfc3339(BEGIN_S + 120))
    (affected,) = affected_plans(*restricted, [plan()], {"d": DRONE}, NOW_S)
    assert (affected.begin.timestamp(), affected.end.timestamp()) == (BEGIN_S + 60, BEGIN_S + 120)


def test_plan_whose_window_is_over_is_not_affected():
    assert plans(restriction(), now_s=END_S + 1) == []


@pytest.mark.parametrize(
    ("selector", "affected"),
    [
        ({"nodes": [{"key": "name", "operator": "In", "values": ["d"]}]}, True),
        ({"nodes": [{"key": "name", "operator": "In", "values": ["other"]}]}, False),
        ({"applications": {"components": ["unknown"]}}, True),
        ({"applications": {"namespaces": ["team"]}}, True),
        ({"applications": {"namespaces": ["city"]}}, False),
        ({"applications": {"names": ["flight-uid-plan"]}}, True),
        ({"applications": {"names": ["other"]}}, False),
    ],
)
def test_selector_of_the_policy_applies_to_plans(selector, affected):
    assert bool(plans(restriction(selector=selector))) == affected


def test_flight_in_the_air_is_affected_once():
    twice = affected_flights(*restriction(), [grant(), grant()], {"d": FLYING}, NOW_S)
    assert [(each.application, each.drone) for each in twice] == FLIGHT


def test_flight_is_affected_only_in_the_air_and_with_a_valid_grant():
    assert flights(restriction(), drone=DRONE) == []
    assert flights(restriction(), grant("Revoked")) == []
    landed = DRONE.from_body(DRONE.to_dict() | {"status": {"flightState": "inactive"}})
    assert flights(restriction(), drone=landed) == []
    lost = DRONE.from_body(DRONE.to_dict() | {"status": {"flightState": "unknown", "lastFlightState": "flying"}})
    assert flights(restriction(), drone=lost) == FLIGHT


def test_restriction_that_begins_after_an_empty_battery_does_not_affect_a_flight():
    minutes = DRONE.spec.services.mobility.max_flight_time
    assert flights(restriction(validFrom=rfc3339(NOW_S + minutes * 60 + 60))) == []
    assert flights(restriction(validFrom=rfc3339(NOW_S + minutes * 60 - 60))) == FLIGHT


def test_selector_of_the_policy_applies_to_flights():
    component = APPLICATION.spec.driver.name
    assert flights(restriction(selector={"applications": {"components": [component]}})) == FLIGHT
    assert flights(restriction(selector={"applications": {"components": ["other"]}})) == []
