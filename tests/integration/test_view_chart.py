"""Live view as a workload of the chart: objects and permissions."""

from __future__ import annotations

from typing import Any

import chart as fractus_chart
import pytest
from control_plane import ControlPlane
from fractus_runtime.kubernetes import KubeError
from fractus_view.cluster import KINDS
from operator_world import FRACTUS, SYSTEM, World

Body = dict[str, Any]


def view_objects(*arguments: str) -> dict[str, Body]:
    """Return the objects of the live view that the chart renders, by kind."""
    bodies = fractus_chart.render(*arguments)
    label = "app.kubernetes.io/component"
    return {body["kind"]: body for body in bodies if body["metadata"].get("labels", {}).get(label) == "view"}


def test_view_is_rendered_only_if_enabled_and_without_write_permissions() -> None:
    assert view_objects() == {}
    objects = view_objects("--set", "view.enabled=true", "--set", "view.hostnames={view.example.org}")
    assert set(objects) == {
        "ServiceAccount", "ClusterRole", "ClusterRoleBinding", "Role", "RoleBinding", "Deployment", "Service", "NetworkPolicy",
    }  # fmt: skip
    (rule,) = objects["ClusterRole"]["rules"]
    assert set(rule["resources"]) == {kind.PLURAL for kind in KINDS}
    assert set(rule["verbs"]) == {"list", "watch"}
    pod = objects["Deployment"]["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    assert pod["securityContext"]["runAsNonRoot"] is True
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]},
    }  # fmt: skip
    assert "--hostname=view.example.org" in container["args"]
    (volume,) = pod["volumes"]
    assert volume["secret"]["secretName"] == "fractus-view"
    assert all(container[probe]["httpGet"]["path"] == "/healthz" for probe in ("readinessProbe", "livenessProbe"))
    open_ = objects["NetworkPolicy"]["spec"]["ingress"][0]["ports"]
    (served,) = objects["Service"]["spec"]["ports"]
    assert [port["port"] for port in open_] == [port["name"] for port in container["ports"]] == ["http", "metrics"]
    assert served["targetPort"] == "http", "the Service exposes the metrics port, which needs no token"
    assert f"--metrics=:{container['ports'][1]['containerPort']}" in container["args"]


def test_view_account_may_read_logs_only_if_verdicts_are_shown() -> None:
    shown = view_objects("--set", "view.enabled=true")
    granted = {(resource, *rule["verbs"]) for rule in shown["Role"]["rules"] for resource in rule["resources"]}
    assert granted == {("pods", "list"), ("pods/log", "get")}
    assert f"--system-namespace={SYSTEM}" in shown["Deployment"]["spec"]["template"]["spec"]["containers"][0]["args"]
    hidden = view_objects("--set", "view.enabled=true", "--set", "view.verdicts=false")
    assert not hidden.keys() & {"Role", "RoleBinding"}


def test_view_of_one_namespace_may_read_logs_only_on_request() -> None:
    city = ("--set", "view.enabled=true", "--set", "view.namespace=city")
    assert not view_objects(*city).keys() & {"Role", "RoleBinding"}
    assert view_objects(*city, "--set", "view.verdicts=true").keys() >= {"Role", "RoleBinding"}


def test_view_has_pod_monitor_if_enabled() -> None:
    monitored = ("--set", "metrics.podMonitor.enabled=true")
    assert view_objects(*monitored) == {}
    (endpoint,) = view_objects("--set", "view.enabled=true", *monitored)["PodMonitor"]["spec"]["podMetricsEndpoints"]
    assert endpoint["port"] == "metrics"


def test_view_account_may_only_list_displayed_kinds(control_plane: ControlPlane, world: World) -> None:
    objects = view_objects("--set", "view.enabled=true")
    access = [objects[kind] for kind in ("ServiceAccount", "ClusterRole", "ClusterRoleBinding", "Role", "RoleBinding")]
    for body in access:
        world.api.apply(fractus_chart.path_of(body), body)
    try:
        request = {"apiVersion": "authentication.k8s.io/v1", "kind": "TokenRequest", "spec": {"expirationSeconds": 600}}
        path = f"/api/v1/namespaces/{SYSTEM}/serviceaccounts/fractus-view/token"
        api = control_plane.with_token(str(world.api.call("POST", path, request)["status"]["token"]))
        for kind in KINDS:
            api.list(f"{FRACTUS}/{kind.PLURAL}")
        api.list(f"/api/v1/namespaces/{SYSTEM}/pods")
        for refused in (
            f"{FRACTUS}/grants",
            "/api/v1/secrets",
            f"/api/v1/namespaces/{SYSTEM}/secrets",
            "/api/v1/pods",
            "/api/v1/nodes",
        ):
            with pytest.raises(KubeError) as error:
                api.list(refused)
            assert error.value.status == 403
        with pytest.raises(KubeError) as error:
            api.merge(f"{FRACTUS}/drones/drone-1", {"spec": {"depot": "elsewhere"}})
        assert error.value.status == 403
    finally:
        for body in access:
            world.api.delete(fractus_chart.path_of(body))
