"""Restrictions through the management API, on a real API server with the operator and the roles of the chart."""

from __future__ import annotations

import threading
from typing import Any

from control_plane import wait_for
from management_server import ManagementServer, User, problem, restriction, submitted, user_token
from operator_world import FRACTUS, World, fractus_object, traffic

Body = dict[str, Any]


def zones(world: World) -> list[Body]:
    return world.api.list(f"{FRACTUS}/zones")


def test_restriction_is_published_as_policy_and_zone(authority: User, world: World) -> None:
    created = authority("POST", "/v1/restrictions", restriction(action="land"))
    assert created.status == 201
    assert created.headers["Location"] == "/v1/restrictions/fair"
    assert created.body["zone"]["description"] == "Summer fair"
    policy = world.api.get(f"{FRACTUS}/policies/fair")
    (zone,) = zones(world)
    assert policy["spec"]["selector"]["zones"] == [zone["metadata"]["name"]]
    assert (policy["spec"]["action"], zone["spec"]) == ("land", created.body["zone"])
    assert zone["metadata"]["ownerReferences"][0]["uid"] == policy["metadata"]["uid"]
    assert authority("GET", "/v1/restrictions/fair").etag == created.etag

    def ready() -> bool:
        conditions = authority("GET", "/v1/restrictions/fair").body.get("status", {}).get("conditions", ())
        return any((each["type"], each["status"]) == ("Ready", "True") for each in conditions)

    wait_for(ready, "the operator to check the restriction")
    assert authority("GET", "/v1/restrictions/fair").etag == created.etag, "the status is no change of the content"
    assert [each["name"] for each in authority("GET", "/v1/restrictions").body["items"]] == ["fair"]


def test_repeated_publication_changes_nothing(authority: User, world: World) -> None:
    first = authority("POST", "/v1/restrictions", restriction())
    again = authority("POST", "/v1/restrictions", restriction())
    assert (again.status, again.etag) == (201, first.etag)
    (reason,) = problem(authority("POST", "/v1/restrictions", restriction(north_m=200)), 409)
    assert reason["field"] == "name"
    (reason,) = problem(authority("POST", "/v1/restrictions", restriction(action="land")), 409)
    assert len(zones(world)) == 1, "a refused request leaves no zone"
    assert authority("GET", "/v1/restrictions/fair").etag == first.etag


def test_half_written_restriction_is_completed_or_removed(authority: User, world: World) -> None:
    def half_written() -> None:
        """Leave the state after a failure between the two writes."""
        authority("POST", "/v1/restrictions", restriction())
        (zone,) = zones(world)
        assert authority("DELETE", "/v1/restrictions/fair", If_Match="*").status == 204
        metadata = {field: zone["metadata"][field] for field in ("name", "labels")}
        world.put({**zone, "metadata": metadata})
        problem(authority("GET", "/v1/restrictions/fair"), 404)
        assert len(zones(world)) == 1

    for north_m in (40, 200):
        half_written()
        assert authority("POST", "/v1/restrictions", restriction(north_m=north_m)).status == 201
        (zone,) = zones(world)
        assert world.api.get(f"{FRACTUS}/policies/fair")["spec"]["selector"]["zones"] == [zone["metadata"]["name"]]
        assert authority("DELETE", "/v1/restrictions/fair", If_Match="*").status == 204
        assert zones(world) == []
    half_written()
    assert authority("DELETE", "/v1/restrictions/fair", If_Match="*").status == 204
    assert zones(world) == []
    problem(authority("DELETE", "/v1/restrictions/fair", If_Match="*"), 404)


def test_change_replaces_zone_and_policy_together(authority: User, world: World) -> None:
    created = authority("POST", "/v1/restrictions", restriction())
    problem(authority("PATCH", "/v1/restrictions/fair", {"policy": {"action": "land"}}), 428)
    patch = {"zone": {"altitude": {"upper": 50}}, "policy": {"action": "land"}}
    changed = authority("PATCH", "/v1/restrictions/fair", patch, If_Match=created.etag)
    assert changed.status == 200
    assert changed.body["zone"]["altitude"] == {"upper": 50, "reference": "home"}
    assert changed.body["zone"]["area"] == created.body["zone"]["area"]
    assert changed.body["policy"]["action"] == "land"
    (zone,) = zones(world)
    assert world.api.get(f"{FRACTUS}/policies/fair")["spec"]["selector"]["zones"] == [zone["metadata"]["name"]]
    for method, body in (("PATCH", patch), ("DELETE", None)):
        (reason,) = problem(authority(method, "/v1/restrictions/fair", body, If_Match=created.etag), 412)
        assert reason["field"] == "If-Match"
    problem(authority("DELETE", "/v1/restrictions/fair"), 428)
    assert authority("DELETE", "/v1/restrictions/fair", If_Match=changed.etag).status == 204
    assert zones(world) == world.api.list(f"{FRACTUS}/policies") == []


def test_simultaneous_changes_leave_one_whole_restriction(authority: User, world: World) -> None:
    authority("POST", "/v1/restrictions", restriction())

    def change(north_m: float) -> None:
        for attempt in range(4):
            body = restriction(north_m=north_m + attempt, action="land")
            if attempt == 2:
                authority("DELETE", "/v1/restrictions/fair", If_Match="*")
            authority("POST", "/v1/restrictions", body)
            authority("PATCH", "/v1/restrictions/fair", {"zone": body["zone"]}, If_Match="*")

    threads = [threading.Thread(target=change, args=(north_m,)) for north_m in (100, 200, 100)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert authority("PATCH", "/v1/restrictions/fair", {"policy": {"action": "hover"}}, If_Match="*").status == 200
    (zone,) = zones(world)
    assert world.api.get(f"{FRACTUS}/policies/fair")["spec"]["selector"]["zones"] == [zone["metadata"]["name"]]


def test_invalid_restriction_names_the_field(authority: User, world: World) -> None:
    def field(body: Body) -> object:
        (reason,) = problem(authority("POST", "/v1/restrictions", body), 422)
        return reason["field"]

    assert field(restriction(kind="inclusion")) == "policy.kind"
    assert field(restriction(action="black")) == "policy.action"
    assert field(restriction(selector={"zones": ["other"]})) == "policy.selector.zones"
    nodes = [{"key": "colour", "operator": "Exists"}]
    assert field(restriction(selector={"nodes": nodes})) == "policy.selector.nodes[0].key"
    crossing = restriction()
    exterior = crossing["zone"]["area"]["polygon"]["exterior"]
    exterior[1], exterior[2] = exterior[2], exterior[1]
    assert str(field(crossing)).startswith("zone.area.polygon")
    assert field(restriction("x" * 60)) == "name"
    authority("POST", "/v1/restrictions", restriction())
    (reason,) = problem(authority("PATCH", "/v1/restrictions/fair", {"zone": {"area": None}}, If_Match="*"), 422)
    assert reason["field"] == "zone.area"
    assert len(zones(world)) == 1


def test_objects_of_other_clients_are_no_restrictions(authority: User, world: World) -> None:
    world.put(fractus_object("Zone", "park", restriction()["zone"]))
    spec = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["park"]}}
    world.put(fractus_object("Policy", "fair", spec))
    problem(authority("POST", "/v1/restrictions", restriction()), 409)
    problem(authority("GET", "/v1/restrictions/fair"), 404)
    problem(authority("DELETE", "/v1/restrictions/fair", If_Match="*"), 404)
    assert authority("GET", "/v1/restrictions").body["items"] == []
    assert [zone["metadata"]["name"] for zone in zones(world)] == ["park"]


def test_user_without_permission_changes_nothing(authority: User, pilot: User, world: World) -> None:
    problem(pilot("POST", "/v1/restrictions", restriction()), 403)
    assert zones(world) == []
    authority("POST", "/v1/restrictions", restriction())
    problem(pilot("PATCH", "/v1/restrictions/fair", {"policy": {"action": "land"}}, If_Match="*"), 403)
    problem(pilot("DELETE", "/v1/restrictions/fair", If_Match="*"), 403)
    problem(pilot("POST", "/v1/restrictions:impact", restriction()), 403)
    assert len(zones(world)) == 1


def test_user_who_may_write_only_zones_leaves_none(
    authority: User, world: World, management: ManagementServer, namespace: str
) -> None:
    half = User(management, user_token(world, namespace, "half", (), ("fractus-zone-editor",)), namespace)
    wait_for(
        lambda: "policies" in problem(half("POST", "/v1/restrictions", restriction()), 403)[0]["message"], "its role"
    )
    assert zones(world) == []


def test_impact_lists_plans_and_flights(authority: User, pilot: User, world: World, namespace: str) -> None:
    accepted = submitted(pilot)
    name = accepted.body["metadata"]["name"]
    impact = authority("POST", "/v1/restrictions:impact", restriction()).body
    (affected,) = impact["plans"]
    assert (affected["namespace"], affected["name"], affected["drone"]) == (namespace, name, "drone-1")
    assert impact["flights"] == impact["unreadable"] == []
    assert authority("POST", "/v1/restrictions:impact", restriction(north_m=3000)).body["plans"] == []
    assert zones(world) == [], "the question writes nothing"


def test_impact_lists_flights_in_the_air(authority: User, world: World, namespace: str) -> None:
    world.put(traffic(namespace))
    wait_for(lambda: world.grants(namespace), "the Grants")
    assert authority("POST", "/v1/restrictions:impact", restriction()).body["flights"] == []
    world.drone_status("drone-1", "flying")
    expected = [{"namespace": namespace, "application": "traffic", "drone": "drone-1"}]
    try:
        assert authority("POST", "/v1/restrictions:impact", restriction()).body["flights"] == expected
    finally:
        # The drone of the next test must be free.
        world.drone_status("drone-1", "inactive")
        world.api.delete(f"{FRACTUS}/namespaces/{namespace}/applications/traffic")
        wait_for(lambda: not world.grants(namespace), "the Grants to be deleted")


def test_permissions_follow_from_roles(authority: User, pilot: User) -> None:
    assert authority("GET", "/v1/permissions").body == {"publishRestrictions": True, "prioritize": False}
    assert pilot("GET", "/v1/permissions").body == {"publishRestrictions": False, "prioritize": False}


def test_permission_to_prioritize_belongs_to_a_namespace(
    pilot: User, world: World, management: ManagementServer, namespace: str
) -> None:
    user = User(management, user_token(world, namespace, "medic", ("fractus-flightplan-prioritizer",), ()), namespace)
    wait_for(lambda: user("GET", "/v1/permissions").body["prioritize"], "the role of the user")
    elsewhere = User(management, user.token, "default")
    assert elsewhere("GET", "/v1/permissions").body == {"publishRestrictions": False, "prioritize": False}
