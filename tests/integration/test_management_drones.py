"""Drones and applications through the management API, and the paths of the thesis."""

from __future__ import annotations

from typing import Any

import pytest
from control_plane import wait_for
from management_server import ManagementServer, User, plan, problem, submitted, user_token
from operator_world import FRACTUS, World, at, navigator

Body = dict[str, Any]


def area(*positions: Body) -> str:
    return ";".join(",".join(str(each) for each in position.values()) for position in positions)


def query(**more: str) -> str:
    start = plan()["window"]["start"]
    parameters = {"start": start, "duration": "15", "area": area(at(50, 50, alt=20)), **more}
    return "&".join(f"{name}={value}" for name, value in parameters.items())


@pytest.fixture
def authority(pilot: User, world: World, management: ManagementServer, namespace: str) -> User:
    """A user who may read everything, and publish applications."""
    roles = ("fractus-flightplan-viewer", "fractus-drone-viewer", "fractus-applicationtemplate-editor")
    user = User(management, user_token(world, namespace, "authority", (), roles), namespace)
    wait_for(lambda: user("GET", "/v1/drones").status == 200, "the roles of the authority")
    return user


def test_drone_has_descriptor_state_and_free_windows(pilot: User, authority: User) -> None:
    (listed,) = pilot("GET", "/v1/drones").body["items"]
    assert listed["spec"]["services"]["mobility"]["maxSpeed"] == 15
    assert listed["status"]["flightState"] == "inactive"
    (free,) = authority("GET", "/v1/drones/drone-1").body["freeWindows"]
    reserved = submitted(pilot).body["status"]["volumes"]
    before, after = authority("GET", "/v1/drones/drone-1").body["freeWindows"]
    assert before["end"] == min(each["begin"] for each in reserved)
    assert after["begin"] == max(each["end"] for each in reserved)
    assert before["begin"] > free["begin"]
    problem(pilot("GET", "/v1/drones/drone-9"), 404)


def test_free_windows_need_permission_for_all_plans(pilot: User) -> None:
    assert pilot("GET", "/v1/drones/drone-1").body.keys() == {"drone"}


def test_template_is_published_and_not_approved(pilot: User, authority: User) -> None:
    leader = navigator()
    leader["container"]["image"] = "registry.test/component@sha256:" + "0" * 64
    spec = {"navigation": "path", "altitudes": {"upper": 60}, "template": {"components": [leader]}}
    problem(pilot("POST", "/v1/apps", {"name": "other", "spec": spec}), 403)
    created = authority("POST", "/v1/apps", {"name": "other", "spec": spec})
    assert created.status == 201
    assert {item["metadata"]["name"] for item in pilot("GET", "/v1/apps").body["items"]} == {"survey", "other"}
    assert pilot("GET", "/v1/apps/other").body["spec"] == created.body["spec"]
    problem(authority("POST", "/v1/apps", {"name": "other", "spec": spec}), 409)
    (reason,) = problem(authority("POST", "/v1/apps", {"name": "third", "spec": spec | {"altitudes": {}}}), 422)
    assert reason["field"] == "spec.altitudes.upper"
    match = pilot("GET", f"/v1/apps/other/drones?{query()}").body
    assert (match["state"], match["suitable"]) == ("Rejected", [])
    assert "not approved" in match["refusals"][0]["message"]


def test_application_lists_suitable_drones_and_reasons_for_others(pilot: User, world: World) -> None:
    for number in (2, 3):
        world.add_drone(f"drone-{number}")
    world.api.merge(f"{FRACTUS}/drones/drone-3", {"spec": {"services": {"mobility": {"maxAltitude": 5}}}})
    wait_for(lambda: world.is_labelled("drone-2", "drone-3"), "the operator to know the drones")
    match = pilot("GET", f"/v1/apps/survey/drones?{query()}").body
    assert match["state"] == "Accepted"
    assert {each["node"] for each in match["suitable"]} == {"drone-1", "drone-2"}
    assert all(each["score"] > 0 for each in match["suitable"])
    assert [each["node"] for each in match["rejected"]] == ["drone-3"]
    submitted(pilot, drone="drone-1")
    match = pilot("GET", f"/v1/apps/survey/drones?{query()}").body
    assert match["refusals"][0]["reason"] == "Conflict"


def test_template_with_invalid_schema_is_refused(authority: User, world: World) -> None:
    template = world.api.get(f"{FRACTUS}/applicationtemplates/survey")
    assert template is not None
    spec = template["spec"] | {"parameters": {"properties": {"speed": {"type": "float"}}}}
    (reason,) = problem(authority("POST", "/v1/apps", {"name": "other", "spec": spec}), 422)
    assert reason["field"] == "spec.parameters.properties.speed.type"


def test_drones_of_an_application_do_not_depend_on_its_parameters(pilot: User, world: World) -> None:
    world.api.merge(f"{FRACTUS}/applicationtemplates/survey", {"spec": {"parameters": {"required": ["speed"]}}})
    approval = {"generation": 2, "by": "admin", "at": "2026-01-01T00:00:00Z"}
    world.api.merge(f"{FRACTUS}/applicationtemplates/survey/status", {"status": {"approval": approval}})

    def refused() -> bool:
        checked = pilot("POST", "/v1/plans:check", plan()).body["status"]
        return [each["reason"] for each in checked.get("refusals", ())] == ["ParametersInvalid"]

    wait_for(refused, "the operator to know the changed template")
    match = pilot("GET", f"/v1/apps/survey/drones?{query()}").body
    assert (match["state"], len(match["suitable"]), match["refusals"]) == ("Accepted", 1, [])
    assert submitted(pilot, parameters={"speed": 2}).body["status"]["state"] == "Accepted"


@pytest.mark.parametrize(
    ("parameters", "field"),
    [({"area": "north"}, "area"), ({"duration": "0"}, "duration"), ({"start": "tomorrow"}, "window.start")],
)
def test_invalid_question_for_drones_names_the_field(pilot: User, parameters: dict[str, str], field: str) -> None:
    (reason,) = problem(pilot("GET", f"/v1/apps/survey/drones?{query(**parameters)}"), 422)
    assert reason["field"] == field


def test_paths_of_the_thesis_do_the_same(pilot: User) -> None:
    assert pilot("GET", "/drones").body == pilot("GET", "/v1/drones").body
    assert pilot("GET", "/drones/drone-1").body["drone"]["metadata"]["name"] == "drone-1"
    assert pilot("GET", "/apps").body == pilot("GET", "/v1/apps").body
    assert pilot("GET", "/apps/survey").body == pilot("GET", "/v1/apps/survey").body
    assert pilot("GET", f"/apps/survey/drones?{query()}").body["state"] == "Accepted"
    created = pilot("POST", "/app_plan", plan())
    name = created.body["metadata"]["name"]
    assert pilot("GET", f"/app_status/{name}").body["plan"]["state"] == "Accepted"
    changed = pilot("PUT", f"/app_plan/{name}", plan(in_s=7200), If_Match=created.etag)
    assert pilot("GET", f"/app_plan/{name}").body["spec"] == changed.body["spec"]
    assert pilot("DELETE", f"/app_plan/{name}", If_Match="*").status == 204
