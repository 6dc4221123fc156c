"""Applications of flight plans, and the conversion between the status of plans and operational intents."""

import json
import math

import pytest
import shapely
from fractus_core.airspace import Airspace, OperationalIntent, Volume4D, decide
from fractus_core.airspace.plan_status import PRIORITIES, intent_of, plan_finding, reserved_volume, volume_of
from fractus_core.api import ApplicationTemplate, FlightPlan, InvalidObject
from fractus_core.geo import LocalFrame
from fractus_core.planning.ordered_application import ordered_application
from test_planning import PATH, STORE, VIEWER, at, navigator

BEGIN_S = 1_800_000_000.0
PINNED = {"image": "registry.example/app@sha256:" + "0" * 64}
NEW_PATH = [at(50, 60, 25), at(70, 80, 30)]
REGION = {"circle": {"center": at(100, 0), "radius": 50}}


def template(*components, approved=3, **more):
    components = [c | {"container": c["container"] | PINNED} for c in components or (navigator(PATH), STORE)]
    body = {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "ApplicationTemplate",
        "metadata": {"name": "survey", "generation": 3},
        "spec": {"navigation": "path", "altitudes": {"upper": 40}, "template": {"components": components}} | more,
    }
    if approved:
        body["status"] = {"approval": {"generation": approved, "by": "ann", "at": "2026-12-01T09:00:00Z"}}
    return ApplicationTemplate.from_body(body)


def flight(status=None, **more):
    window = {"start": "2027-01-15T08:00:00Z", "duration": 10}
    spec = {"template": "survey", "waypoints": NEW_PATH, "window": window} | more
    body = {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "FlightPlan",
        "metadata": {"name": "morning", "namespace": "team", "uid": "3e0a", "generation": 1},
        "spec": {name: value for name, value in spec.items() if value is not None},
    }
    return FlightPlan.from_body(body | ({"status": status} if status else {}))


def places(positions):
    return [(p.lat, p.lon, p.alt) for p in positions]


def test_waypoints_of_plan_replace_those_of_the_template():
    app = ordered_application(flight(), template())
    assert places(app.spec.driver.control_points[0].path) == [(p["lat"], p["lon"], p["alt"]) for p in NEW_PATH]
    assert [c.name for c in app.spec.components] == ["Navigator", "DataStore"]


def test_waypoints_of_plan_replace_points_of_interest():
    guide = VIEWER | {"egress": [], "pointsOfInterest": {"points": [at(1, 1)], "ordered": False}}
    app = ordered_application(flight(), template(guide))
    assert places(app.spec.points_of_interest.points) == [(p["lat"], p["lon"], p["alt"]) for p in NEW_PATH]
    assert not app.spec.points_of_interest.ordered


def test_region_of_plan_replaces_that_of_the_template():
    point = {"navigation": "regionBased", "region": {"circle": {"center": at(0, 0), "radius": 5}}, "duration": 1}
    free = template(navigator(PATH) | {"controlPoints": [point]}, navigation="region")
    app = ordered_application(flight(waypoints=None, region=REGION, stay=7), free)
    (flown,) = app.spec.driver.control_points
    assert (flown.region.circle.radius, flown.duration, flown.path) == (50, 7, None)


def test_application_belongs_to_its_plan():
    metadata = ordered_application(flight(), template()).metadata
    assert (metadata.namespace, metadata.name) == ("team", "flight-3e0a")
    (owner,) = metadata.owner_references
    assert (owner.kind, owner.name, owner.uid, owner.controller) == ("FlightPlan", "morning", "3e0a", True)


def test_parameters_are_an_environment_variable_of_every_container():
    app = ordered_application(flight(parameters={"speed": 2, "names": ["a"]}), template())
    for component in app.spec.components:
        values = {variable.name: variable.value for variable in component.container.env}
        assert json.loads(values["FLIGHT_PARAMETERS"]) == {"speed": 2, "names": ["a"]}
    assert not ordered_application(flight(), template()).spec.components[0].container.env


@pytest.mark.parametrize(("own", "expected"), [(None, 40), (30, 30), (90, 40)])
def test_flight_stays_below_the_altitude_of_the_template(own, expected):
    base = template()
    limited = {"maxAltitude": own} if own is not None else {}
    app = ordered_application(flight(), template(template=base.spec.template.to_dict() | limited))
    assert app.spec.max_altitude == expected


def test_actions_of_plan_override_those_of_the_template():
    base = template()
    spec = base.spec.template.to_dict() | {
        "policyActions": [{"policy": "p", "action": "hover"}, {"policy": "q", "action": "land"}]
    }
    base = template(template=spec)
    lost = {"action": "abort", "landAt": {"lat": 39.36, "lon": 22.93}}
    app = ordered_application(flight(policyActions=[{"policy": "p", "action": "abort"}], contactLost=lost), base)
    assert {a.policy: a.action for a in app.spec.policy_actions} == {"p": "abort", "q": "land"}
    assert app.spec.contact_lost.action == "abort"


@pytest.mark.parametrize("approved", [None, 2, 4])
def test_template_whose_generation_is_not_approved_is_refused(approved):
    with pytest.raises(
        InvalidObject, match=r"spec.template: generation 3 of ApplicationTemplate survey is not approved"
    ):
        ordered_application(flight(), template(approved=approved))


def test_plan_with_the_other_navigation_is_refused():
    with pytest.raises(InvalidObject, match="has navigation path; give waypoints"):
        ordered_application(flight(waypoints=None, region=REGION, stay=7), template())


def volume(x=0.0, *, lower=-math.inf, upper=50.0, place=(39.36, 22.93), side=100.0):
    frame = LocalFrame(*place)
    shape = shapely.box(x, 0, x + side, side).difference(shapely.box(x + side / 3, side / 3, x + side / 2, side / 2))
    return Volume4D.of_shape(frame, shape, lower_m=lower, upper_m=upper, begin_s=BEGIN_S, end_s=BEGIN_S + 600.5)


@pytest.mark.parametrize("place", [(39.36, 22.93), (0.0, 180.0), (90.0, 0.0), (-77.0, -180.0)])
@pytest.mark.parametrize("side", [5.0, 100.0, 20_000.0])
def test_volume_is_the_same_after_it_was_stored(place, side):
    made = volume(place=place, side=side)
    stored = reserved_volume(made)
    read = volume_of(type(stored).model_validate_json(stored.model_dump_json(by_alias=True)))
    assert (read.lower_m, read.upper_m, read.begin_s, read.end_s) == (made.lower_m, 50.0, BEGIN_S, BEGIN_S + 600.5)
    frame = made.frame
    assert shapely.hausdorff_distance(made.in_frame(frame), read.in_frame(frame)) < 0.001
    hole = volume(side / 2.7, place=place, side=side / 20)
    assert (made.overlap(hole) is None) == (read.overlap(hole) is None)


def test_stored_volume_without_polygon_is_refused():
    stored = reserved_volume(volume())
    for areas in ((), ({"circle": {"center": at(0, 0), "radius": 5}},)):
        body = json.loads(stored.model_dump_json(by_alias=True)) | {"areas": areas}
        with pytest.raises(InvalidObject, match="give at least one, and no circle"):
            volume_of(type(stored).model_validate(body))


def test_intent_has_the_state_volumes_and_priority_in_force():
    stored = json.loads(reserved_volume(volume()).model_dump_json(by_alias=True))
    status = {"state": "Accepted", "decidedFor": 1, "priorityClass": "elevated", "volumes": [stored]}
    plan = flight(status, priorityClass="emergency")
    intent = intent_of(plan)
    assert (intent.name, intent.state, intent.priority) == ("team/morning", "Accepted", PRIORITIES["elevated"])
    decision = decide(OperationalIntent("x", "Accepted", 1, (volume(90),)), None, Airspace([intent]), BEGIN_S)
    (finding,) = map(plan_finding, decision.refusals)
    assert (finding.reason, finding.plan) == ("Conflict", "team/morning")


def test_plan_without_status_is_a_draft_without_volumes():
    assert intent_of(flight(priorityClass="emergency")) == OperationalIntent("team/morning", "Draft", 2)
