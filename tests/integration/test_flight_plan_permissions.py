"""Permissions for templates and flight plans: approval by an authority, and priority classes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import chart as fractus_chart
import pytest
from control_plane import ControlPlane, wait_for
from fractus_runtime.kubernetes import BlockingClient, KubeError
from operator_world import FRACTUS, World

Body = dict[str, Any]
RBAC = "/apis/rbac.authorization.k8s.io/v1"
TEMPLATES = f"{FRACTUS}/applicationtemplates"
PLANS = f"{FRACTUS}/namespaces/default/flightplans"
ROLES = {
    "developer": ["fractus-applicationtemplate-editor"],
    "authority": ["fractus-applicationtemplate-approver"],
    "pilot": ["fractus-flightplan-editor"],
    "rescuer": ["fractus-flightplan-editor", "fractus-flightplan-prioritizer"],
}
COMPONENT = {
    "name": "Navigator",
    "placement": "drone",
    "class": "driver",
    "services": [{"service": "mobility", "methods": ["Arm", "Goto"]}],
    "controlPoints": [{"navigation": "pathBased", "path": [{"lat": 50.0, "lon": 4.0}]}],
    "container": {"image": "registry.example/app@sha256:" + "0" * 64},
}


def template(upper: float = 40) -> Body:
    spec = {"navigation": "path", "altitudes": {"upper": upper}, "template": {"components": [COMPONENT]}}
    meta = {"name": "survey"}
    return {"apiVersion": "fractus.dev/v1alpha1", "kind": "ApplicationTemplate", "metadata": meta, "spec": spec}


def plan(**more: Any) -> Body:
    window = {"start": "2026-12-01T10:00:00Z", "duration": 15}
    spec = {"template": "survey", "waypoints": [{"lat": 50.0, "lon": 4.0}], "window": window} | more
    meta = {"name": "flight", "namespace": "default"}
    return {"apiVersion": "fractus.dev/v1alpha1", "kind": "FlightPlan", "metadata": meta, "spec": spec}


@pytest.fixture
def users(control_plane: ControlPlane, world: World, chart: None) -> Iterator[dict[str, BlockingClient]]:
    """Return clients of users, each with the ClusterRoles of `ROLES`."""
    clients = {}
    accounts = "/api/v1/namespaces/default/serviceaccounts"
    for user, roles in ROLES.items():
        world.api.apply(
            f"{accounts}/{user}", {"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": user}}
        )
        for role in roles:
            name = f"{user}-{role}"
            world.api.apply(
                f"{RBAC}/clusterrolebindings/{name}",
                {
                    "apiVersion": "rbac.authorization.k8s.io/v1", "kind": "ClusterRoleBinding", "metadata": {"name": name},
                    "roleRef": {"apiGroup": "rbac.authorization.k8s.io", "kind": "ClusterRole", "name": role},
                    "subjects": [{"kind": "ServiceAccount", "name": user, "namespace": "default"}],
                },
            )  # fmt: skip
        request = {"apiVersion": "authentication.k8s.io/v1", "kind": "TokenRequest", "spec": {"expirationSeconds": 600}}
        token = world.api.call("POST", f"{accounts}/{user}/token", request)["status"]["token"]
        clients[user] = control_plane.with_token(token)
    for path in (f"{TEMPLATES}/survey", f"{PLANS}/flight"):
        world.api.delete(path)
    # The API server enforces a new admission policy after a delay.
    wait_for(lambda: "prioritize" in refused(clients["pilot"], plan(priorityClass="elevated")), "the policies")
    yield clients
    for client in clients.values():
        client.close()


def refused(client: BlockingClient, body: Body) -> str:
    """Return why a user may not create a flight plan, or an empty string."""
    try:
        client.call("POST", PLANS, body, params={"dryRun": "All"})
    except KubeError as error:
        return str(error)
    return ""


def approve(client: BlockingClient, user: str, generation: int) -> Body:
    approval = {"generation": generation, "by": user, "at": "2026-12-01T09:00:00Z"}
    return client.merge(f"{TEMPLATES}/survey/status", {"status": {"approval": approval}})


def account(user: str) -> str:
    return f"system:serviceaccount:default:{user}"


def test_template_is_approved_by_authority_only(users: dict[str, BlockingClient], world: World) -> None:
    users["developer"].call("POST", TEMPLATES, template())
    for user in ("developer", "pilot"):
        with pytest.raises(KubeError) as denied:
            approve(users[user], account(user), 1)
        assert denied.value.status == 403
    assert approve(users["authority"], account("authority"), 1)["status"]["approval"]["generation"] == 1


def test_template_created_with_an_approval_is_not_approved(users: dict[str, BlockingClient]) -> None:
    approval = {"generation": 1, "by": account("authority"), "at": "2026-12-01T09:00:00Z"}
    created = users["developer"].call("POST", TEMPLATES, template() | {"status": {"approval": approval}})
    assert "status" not in created


def test_writer_of_status_without_the_verb_cannot_approve(users: dict[str, BlockingClient], world: World) -> None:
    users["developer"].call("POST", TEMPLATES, template())
    rule = {
        "apiGroups": ["fractus.dev"],
        "resources": ["applicationtemplates/status"],
        "verbs": ["update", "patch", "get"],
    }
    meta = {"name": "status-writer"}
    role = {"apiVersion": "rbac.authorization.k8s.io/v1", "kind": "ClusterRole", "metadata": meta, "rules": [rule]}
    world.api.apply(f"{RBAC}/clusterroles/status-writer", role)
    binding = {
        "apiVersion": "rbac.authorization.k8s.io/v1", "kind": "ClusterRoleBinding", "metadata": meta,
        "roleRef": {"apiGroup": "rbac.authorization.k8s.io", "kind": "ClusterRole", "name": "status-writer"},
        "subjects": [{"kind": "ServiceAccount", "name": "pilot", "namespace": "default"}],
    }  # fmt: skip
    world.api.apply(f"{RBAC}/clusterrolebindings/status-writer", binding)
    try:
        report = {"status": {"observedGeneration": 1}}
        wait_for(lambda: permitted(users["pilot"], report), "the role")
        with pytest.raises(KubeError, match="ask for the verb approve on applicationtemplates"):
            approve(users["pilot"], account("pilot"), 1)
        approve(users["authority"], account("authority"), 1)
        with pytest.raises(KubeError, match="ask for the verb approve on applicationtemplates"):
            users["pilot"].merge(f"{TEMPLATES}/survey/status", {"status": {"approval": None}})
        users["pilot"].merge(f"{TEMPLATES}/survey/status", report)
    finally:
        world.api.delete(f"{RBAC}/clusterrolebindings/status-writer")


def permitted(client: BlockingClient, patch: Body) -> bool:
    try:
        client.merge(f"{TEMPLATES}/survey/status", patch)
    except KubeError:
        return False
    return True


def test_approval_names_its_author_and_the_present_generation(users: dict[str, BlockingClient]) -> None:
    users["developer"].call("POST", TEMPLATES, template())
    with pytest.raises(KubeError, match="by must be the user who approves: system:serviceaccount:default:authority"):
        approve(users["authority"], "somebody", 1)
    users["developer"].merge(f"{TEMPLATES}/survey", {"spec": template(upper=50)["spec"]})
    with pytest.raises(KubeError, match="generation must be the present generation, 2; read the template again"):
        approve(users["authority"], account("authority"), 1)
    approve(users["authority"], account("authority"), 2)


@pytest.mark.parametrize("priority", ["elevated", "emergency"])
def test_higher_priority_class_needs_permission(users: dict[str, BlockingClient], priority: str) -> None:
    message = refused(users["pilot"], plan(priorityClass=priority))
    assert f"may not use priorityClass {priority}; remove it, or ask for the verb prioritize on flightplans" in message
    assert refused(users["pilot"], plan(priorityClass="normal")) == ""
    assert refused(users["pilot"], plan()) == ""
    assert refused(users["rescuer"], plan(priorityClass=priority)) == ""


def test_plan_of_higher_class_can_be_ended_but_not_changed_by_others(users: dict[str, BlockingClient]) -> None:
    users["rescuer"].call("POST", PLANS, plan(priorityClass="elevated"))
    for change in (
        {"priorityClass": "emergency"},
        {"priorityClass": "emergency", "use": "Closed"},
        {"use": "InUse"},
        {"waypoints": [{"lat": 50.1, "lon": 4.0}]},
    ):
        with pytest.raises(KubeError, match="ask for the verb prioritize"):
            users["pilot"].merge(f"{PLANS}/flight", {"spec": change})
    users["pilot"].merge(f"{PLANS}/flight", {"metadata": {"labels": {"team": "a"}}})
    users["rescuer"].merge(f"{PLANS}/flight", {"spec": {"use": "InUse"}})
    users["pilot"].merge(f"{PLANS}/flight", {"spec": {"use": "Closed"}})
    users["pilot"].merge(f"{PLANS}/flight", {"spec": {"priorityClass": "normal"}})


def test_editor_of_plans_cannot_write_their_status(users: dict[str, BlockingClient]) -> None:
    users["pilot"].call("POST", PLANS, plan())
    with pytest.raises(KubeError) as denied:
        users["pilot"].merge(f"{PLANS}/flight/status", {"status": {"state": "Accepted"}})
    assert denied.value.status == 403


@pytest.mark.parametrize("before", [False, True])
def test_dry_run_cannot_become_a_plan_or_the_reverse(users: dict[str, BlockingClient], before: bool) -> None:
    users["pilot"].call("POST", PLANS, plan(dryRun=before))
    with pytest.raises(KubeError, match=r"spec\.dryRun cannot change; create another FlightPlan"):
        users["pilot"].merge(f"{PLANS}/flight", {"spec": {"dryRun": not before}})
    users["pilot"].merge(f"{PLANS}/flight", {"spec": {"use": "Closed", "dryRun": before}})


def test_only_the_operator_removes_the_landing_finalizer(
    users: dict[str, BlockingClient], control_plane: ControlPlane, world: World
) -> None:
    users["pilot"].call("POST", PLANS, plan())
    operator = control_plane.with_token(fractus_chart.operator_token(world))
    try:
        operator.merge(f"{PLANS}/flight", {"metadata": {"finalizers": ["fractus.dev/landing"]}})
        users["pilot"].delete(f"{PLANS}/flight")
        with pytest.raises(KubeError, match="keeps the airspace until the drone has landed"):
            users["pilot"].merge(f"{PLANS}/flight", {"metadata": {"finalizers": []}})
        operator.merge(f"{PLANS}/flight", {"metadata": {"finalizers": []}})
    finally:
        operator.close()
    assert world.api.get(f"{PLANS}/flight") is None


def test_operator_reports_on_templates_and_cannot_approve_them(
    users: dict[str, BlockingClient], control_plane: ControlPlane, world: World
) -> None:
    users["developer"].call("POST", TEMPLATES, template())
    approve(users["authority"], account("authority"), 1)
    ready = {
        "type": "Ready",
        "status": "True",
        "reason": "Approved",
        "message": "",
        "lastTransitionTime": "2026-12-01T09:00:00Z",
    }
    header = {"apiVersion": "fractus.dev/v1alpha1", "kind": "ApplicationTemplate", "metadata": {"name": "survey"}}
    operator = control_plane.with_token(fractus_chart.operator_token(world))
    try:
        applied = operator.apply(f"{TEMPLATES}/survey/status", header | {"status": {"conditions": [ready]}})
        assert applied["status"]["approval"]["generation"] == 1
        with pytest.raises(KubeError, match="ask for the verb approve on applicationtemplates"):
            operator.merge(f"{TEMPLATES}/survey/status", {"status": {"approval": None}})
    finally:
        operator.close()
