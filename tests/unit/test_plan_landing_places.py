"""Legality of landing places before takeoff."""

import pytest
from fractus_core.api import Application
from fractus_core.api.geometry import Point
from fractus_core.planning import Infeasible, Settings, plan
from fractus_core.planning.grant_compiler import compile_grants
from test_grants import FENCE, policy, zone
from test_plan_legality import APP, WARN, stock
from test_planning import PATH, application, at, drone, navigator


def aborting(place, **more):
    """Return a policy with a landing place in metres around the depot. Its own zone is far from the path."""
    spot = {name: at(*place)[name] for name in ("lat", "lon")}
    return policy("far", zones=["far"], **FENCE | {"action": "abort", "landAt": spot} | more)


FAR = zone("far", (150, 80), 20)


def refusal(inventory):
    with pytest.raises(Infeasible) as refused:
        plan(APP, inventory, WARN)
    assert refused.value.reason == "LandingPlaceIllegal"
    (rejection,) = refused.value.rejected
    assert rejection.reason == "LandingPlaceIllegal"
    return rejection.message


def test_drone_with_legal_landing_place_is_selected():
    assert plan(APP, stock(aborting((100, 0)), zones=[FAR]), WARN).drone.node == "d"


def test_landing_place_inside_zone_is_refused():
    covering = policy("cover", zones=["covering"], **FENCE)
    message = refusal(stock(aborting((100, 0)), covering, zones=[FAR, zone("covering", (100, 0), 15)]))
    place = Point(**{name: at(100, 0)[name] for name in ("lat", "lon")})
    assert message.startswith(f"landAt of policy far ({place.lat:.6f}, {place.lon:.6f}) is not a legal landing place:")
    assert "it is inside zone covering of policy cover" in message


def test_landing_place_outside_area_of_grant_is_refused():
    assert "it is not inside the area of the Grant" in refusal(stock(aborting((100, 500)), zones=[FAR]))


def test_landing_place_without_route_is_refused():
    # The corridor is about 14 m wide, so a zone across it separates the two ends.
    across = policy("across", zones=["across"], **FENCE)
    message = refusal(stock(aborting((250, 0)), across, zones=[FAR, zone("across", (200, 0), 20)]))
    assert "no legal route from the drone's home to it was found" in message


def test_drone_of_present_plan_is_kept_when_landing_place_becomes_illegal():
    present = plan(APP, stock(aborting((100, 0)), zones=[FAR]), WARN)
    covered = stock(aborting((100, 0)), policy("cover", zones=["c"], **FENCE), zones=[FAR, zone("c", (100, 0), 15)])
    assert plan(APP, covered, WARN, present).drone.node == "d"


def test_another_drone_is_selected_if_landing_place_is_legal_for_it_only():
    fleet = [drone("a", minutes=30), drone("d", minutes=30)]
    only_a = policy(
        "far",
        zones=["far"],
        nodes=[{"key": "name", "operator": "In", "values": ["a"]}],
        **FENCE | {"action": "abort", "landAt": {name: at(100, 500)[name] for name in ("lat", "lon")}},
    )
    chosen = plan(APP, stock(only_a, zones=[FAR], drones=fleet), WARN)
    assert chosen.drone.node == "d"
    assert [(r.node, r.reason) for r in chosen.rejected] == [("a", "LandingPlaceIllegal")]


def losing_contact(lost):
    body = application(navigator(PATH)).to_dict()
    return Application.from_body(body | {"spec": body["spec"] | {"contactLost": lost}})


def test_landing_place_for_lost_contact_is_checked():
    lost = {"action": "abort", "landAt": {name: at(100, 500)[name] for name in ("lat", "lon")}}
    app = losing_contact(lost)
    with pytest.raises(Infeasible) as refused:
        plan(app, stock(), WARN)
    assert refused.value.rejected[0].message.startswith("contactLost.landAt (")


def test_grant_contains_reaction_to_lost_contact():
    lost = {"after": 20, "action": "abort", "landAt": {name: at(100, 0)[name] for name in ("lat", "lon")}}
    app = losing_contact(lost)
    (grant,) = compile_grants(app, plan(app, stock(), WARN), stock())
    assert grant.contact_lost == app.spec.contact_lost


def test_landing_place_is_not_checked_without_time():
    assert plan(APP, stock(aborting((100, 500)), zones=[FAR]), Settings()).drone.node == "d"
