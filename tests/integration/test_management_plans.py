"""Flight plans through the management API, on a real API server with the operator and the roles of the chart."""

from __future__ import annotations

import re

import pytest
from control_plane import wait_for
from management_server import ManagementServer, User, path_of, plan, problem, submitted, user_token
from operator_world import World


def test_submitted_plan_is_returned_with_its_decision(pilot: User) -> None:
    accepted = submitted(pilot)
    assert accepted.body["status"]["state"] == "Accepted"
    assert accepted.body["status"]["drone"] == "drone-1"
    assert accepted.headers["Location"].startswith(path_of(accepted))
    assert pilot("GET", path_of(accepted)).body["metadata"]["uid"] == accepted.body["metadata"]["uid"]
    rejected = submitted(pilot)
    assert rejected.body["status"]["state"] == "Rejected"
    assert rejected.body["status"]["rejected"][0]["reason"] == "Reserved"


def test_repeated_submission_returns_the_same_plan(pilot: User) -> None:
    body = plan()
    first = pilot("POST", "/v1/plans", body, Idempotency_Key="monday")
    again = pilot("POST", "/v1/plans", body, Idempotency_Key="monday")
    assert (first.status, again.status) == (201, 201)
    assert again.body["metadata"]["uid"] == first.body["metadata"]["uid"]
    (reason,) = problem(pilot("POST", "/v1/plans", plan(in_s=7200), Idempotency_Key="monday"), 422)
    assert reason["reason"] == "IdempotencyKeyReused"


def test_idempotency_keys_of_users_are_independent(
    pilot: User, world: World, management: ManagementServer, namespace: str
) -> None:
    other = User(management, user_token(world, namespace, "other", ("fractus-flightplan-editor",), ()), namespace)
    wait_for(lambda: other("GET", "/v1/plans").status == 200, "the role of the other pilot")
    body = plan()
    plans = [user("POST", "/v1/plans", body, Idempotency_Key="monday") for user in (pilot, other)]
    assert plans[0].body["metadata"]["name"] != plans[1].body["metadata"]["name"]


def test_check_decides_without_a_reservation(pilot: User) -> None:
    assert pilot("POST", "/v1/plans:check", plan()).body["status"]["state"] == "Accepted"
    assert pilot("GET", "/v1/plans").body["items"] == []
    assert submitted(pilot).body["status"]["state"] == "Accepted"
    assert pilot("POST", "/v1/plans:check", plan()).body["status"]["state"] == "Rejected"


def test_check_of_a_change_does_not_conflict_with_the_plan_itself(pilot: User) -> None:
    created = submitted(pilot)
    longer = plan() | {"window": created.body["spec"]["window"] | {"duration": 20}}
    checked = pilot("POST", f"{path_of(created)}:check", longer)
    assert checked.body["status"]["state"] == "Accepted", checked.body["status"]
    assert pilot("GET", path_of(created)).body["spec"]["window"]["duration"] == 15
    problem(pilot("POST", "/v1/plans/other:check", longer), 404)


def test_change_needs_the_present_version(pilot: User) -> None:
    created = submitted(pilot)
    later = plan(in_s=7200)
    problem(pilot("PUT", path_of(created), later), 428)
    problem(pilot("PATCH", path_of(created), {"window": later["window"]}), 428)
    problem(pilot("DELETE", path_of(created)), 428)
    problem(pilot("PUT", path_of(created), later, If_Match='"1"'), 412)
    problem(pilot("DELETE", path_of(created), If_Match='"1"'), 412)
    present = pilot("GET", path_of(created))
    changed = pilot("PUT", path_of(created), later, If_Match=present.etag)
    assert changed.status == 200
    assert changed.body["spec"]["window"] == later["window"]
    assert changed.body["status"]["decidedFor"] == 2
    problem(pilot("PUT", path_of(created), plan(), If_Match=present.etag), 412)


def test_merge_patch_changes_single_fields(pilot: User) -> None:
    created = submitted(pilot, drone="drone-1")
    patched = pilot("PATCH", path_of(created), {"drone": None, "window": {"duration": 20}}, If_Match="*")
    assert patched.status == 200
    assert "drone" not in patched.body["spec"]
    assert patched.body["spec"]["window"]["duration"] == 20
    assert patched.body["spec"]["window"]["start"] == created.body["spec"]["window"]["start"]
    (reason,) = problem(pilot("PATCH", path_of(created), {"window": {"duration": -1}}, If_Match="*"), 422)
    assert reason["field"] == "window.duration"


def test_plan_is_activated_and_ended(pilot: User) -> None:
    created = submitted(pilot)
    assert pilot("POST", f"{path_of(created)}:activate").body["spec"]["use"] == "InUse"
    ended = pilot("POST", f"{path_of(created)}:end")
    assert (ended.body["spec"]["use"], ended.body["status"]["state"]) == ("Closed", "Ended")
    assert pilot("DELETE", path_of(created), If_Match="*").status == 204
    problem(pilot("GET", path_of(created)), 404)


def test_status_contains_application_and_drone(pilot: User) -> None:
    created = submitted(pilot)
    progress = pilot("GET", f"{path_of(created)}/status").body
    assert progress["plan"]["state"] == "Accepted"
    assert progress["drone"]["flightState"] == "inactive"
    assert "application" not in progress


def test_list_is_paged(pilot: User) -> None:
    names = {submitted(pilot, in_s=3600 * hour).body["metadata"]["name"] for hour in (1, 2, 3)}
    first = pilot("GET", "/v1/plans?limit=2").body
    rest = pilot("GET", f"/v1/plans?limit=2&continue={first['continue']}").body
    assert len(first["items"]) == 2
    assert {item["metadata"]["name"] for item in first["items"] + rest["items"]} == names
    assert "continue" not in rest


def test_permissions_of_the_caller_decide(pilot: User, observer: User) -> None:
    created = submitted(pilot)
    assert observer("GET", path_of(created)).status == 200
    for reply in (
        observer("POST", "/v1/plans", plan()),
        observer("POST", f"{path_of(created)}:end"),
        observer("DELETE", path_of(created), If_Match="*"),
    ):
        assert problem(reply, 403)[0]["reason"] == "Forbidden"
    (reason,) = problem(pilot("POST", "/v1/plans", plan(priorityClass="emergency")), 403)
    assert "prioritize" in reason["message"]


@pytest.mark.parametrize("token", ["", "not-a-token", "ü"])
def test_request_without_valid_token_is_refused(pilot: User, management: ManagementServer, token: str) -> None:
    headers = {"Authorization": f"Bearer {token}".encode().decode("latin-1")} if token else {}
    reply = management.send("GET", "/v1/plans", headers=headers)
    problem(reply, 401)
    assert reply.headers["WWW-Authenticate"] == "Bearer"


def test_invalid_plan_gets_a_reason_with_its_field(pilot: User) -> None:
    body = plan()
    (reason,) = problem(pilot("POST", "/v1/plans", body | {"window": body["window"] | {"duration": "long"}}), 422)
    assert reason["field"] == "window.duration"
    (reason,) = problem(pilot("POST", "/v1/plans", body | {"dryRun": True}), 422)
    assert reason["field"] == "dryRun"
    problem(pilot("POST", "/v1/plans", b"{"), 400)
    problem(pilot("POST", "/v1/plans", b"[" * 100_000), 400)
    problem(pilot("POST", "/v1/plans", b'"' + b"x" * 2**21 + b'"'), 413)
    problem(pilot("GET", "/v1/plans?limit=0"), 422)
    problem(pilot("GET", "/v1/plans?continue=x"), 400)
    problem(pilot("GET", "/v1/nothing"), 404)
    reply = pilot("PATCH", "/v1/plans")
    problem(reply, 405)
    assert reply.headers["Allow"] == "GET, POST"


def test_page_is_served_without_token_and_may_only_contact_the_api(management: ManagementServer) -> None:
    page = management.send("GET", "/")
    assert page.headers["Content-Type"] == "text/html; charset=utf-8"
    assert "connect-src 'self'" in page.headers["Content-Security-Policy"]
    loaded = re.findall(rb'(?:src|href)="(/[^"]+)"', page.content)
    assert len(loaded) > 4
    assert {management.send("GET", path.decode()).status for path in loaded} == {200}
    problem(management.send("GET", "/index.html"), 404)
    problem(management.send("GET", "/assets/../plans.html"), 404)
    problem(management.send("POST", "/", {}), 405)
