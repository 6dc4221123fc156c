"""Admission: bad manifests, pods on foreign nodes, and attempts with the operator's token."""

from __future__ import annotations

import copy
import uuid
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml
from chart import operator_token
from control_plane import ControlPlane, wait_for
from fractus_runtime.kubernetes import BlockingClient, ContentType, KubeError
from operator_world import (
    FRACTUS,
    NODES,
    SYSTEM,
    Body,
    OperatorProcess,
    World,
    at,
    component,
    denied,
    fractus_object,
    navigator,
    traffic,
)

# -- bad manifests --


def _unknown_egress(spec: Body) -> None:
    spec["components"][1]["egress"] = ["ImageCheker"]


def _no_mission(spec: Body) -> None:
    del spec["components"][0]


def _latitude_95(spec: Body) -> None:
    spec["components"][0]["controlPoints"][0]["path"][0]["lat"] = 95


def _crossing_region(spec: Body) -> None:
    ring = [at(0, 0), at(50, 50), at(0, 50), at(50, 0)]
    point = {"point": {"depot": "base"}, "navigation": "regionBased", "region": {"polygon": {"exterior": ring}}}
    spec["components"][0]["controlPoints"] = [point]


def _zero_replicas(spec: Body) -> None:
    spec["components"][4]["replicas"] = 0


def _unknown_method(spec: Body) -> None:
    spec["components"][0]["services"][0]["methods"] = ["Arm", "Loop"]


def _two_drivers(spec: Body) -> None:
    spec["components"].append({**copy.deepcopy(spec["components"][0]), "name": "CoPilot"})


def _empty_path(spec: Body) -> None:
    spec["components"][0]["controlPoints"][0]["path"] = []


def _negative_radius(spec: Body) -> None:
    spec["components"][2]["locations"][0]["radius"] = -5


def _unknown_depot(spec: Body) -> None:
    spec["components"][0]["controlPoints"][0]["point"] = {"depot": "bse"}


BAD_APPLICATIONS: list[tuple[Callable[[Body], None], str]] = [
    (_unknown_egress, "egress"),
    (_no_mission, "pointsOfInterest"),
    (_latitude_95, "lat"),
    (_crossing_region, "region"),
    (_zero_replicas, "replicas"),
    (_unknown_method, "methods"),
    (_two_drivers, "driver"),
    (_empty_path, "path"),
    (_negative_radius, "radius"),
    (_unknown_depot, "depot"),
]


@pytest.mark.parametrize(("spoil", "field"), BAD_APPLICATIONS, ids=[s.__name__.strip("_") for s, _ in BAD_APPLICATIONS])
def test_bad_application_is_refused_without_child_objects(
    world: World, operator: OperatorProcess, namespace: str, spoil: Callable[[Body], None], field: str
) -> None:
    manifest = traffic(namespace)
    spoil(manifest["spec"])
    try:
        world.put(manifest)
    except KubeError as refusal:
        assert field in str(refusal)
        assert refusal.status in (400, 422)
    else:
        wait_for(lambda: world.condition(namespace, "Ready").get("status") == "False", "Ready=False")
        condition = world.condition(namespace, "Ready")
        assert condition["reason"] == "Invalid"
        assert field in condition["message"]
        assert world.status(namespace)["phase"] == "Invalid"
    assert world.children(namespace) == {}


def test_policy_with_invalid_or_unknown_zone_is_not_ready(world: World, operator: OperatorProcess) -> None:
    ring = [at(0, 0), at(50, 50), at(0, 50), at(50, 0)]
    world.put(fractus_object("Zone", "bowtie", {"area": {"polygon": {"exterior": ring}}}))
    world.put(
        fractus_object(
            "Policy", "nowhere", {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["nowhere"]}}
        )
    )
    world.put(
        fractus_object(
            "Policy", "knot", {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["bowtie"]}}
        )
    )

    teeth = [*((0.02 * i, 100.0 * (i % 2)) for i in range(400)), (9.0, 101.0), (-1.0, 101.0)]
    for name, corners in (("north", teeth), ("east", [(y, x) for x, y in teeth])):
        world.put(
            fractus_object("Zone", name, {"area": {"polygon": {"exterior": [at(*corner) for corner in corners]}}})
        )
    both = {"type": "GeofenceControl", "kind": "inclusion", "selector": {"zones": ["north", "east"]}}
    world.put(fractus_object("Policy", "both", both))

    def ready(plural: str, name: str) -> Body | None:
        conditions = ((world.api.get(f"{FRACTUS}/{plural}/{name}") or {}).get("status") or {}).get("conditions") or ()
        return next((c for c in conditions if c["type"] == "Ready"), None)

    zone = wait_for(lambda: ready("zones", "bowtie"), "the zone's condition")
    assert (zone["status"], zone["reason"]) == ("False", "Invalid")
    assert "spec.area.polygon.exterior" in zone["message"]
    missing = wait_for(lambda: ready("policies", "nowhere"), "the policy's condition")
    assert (missing["status"], missing["reason"]) == ("False", "ZoneMissing")
    assert "spec.selector.zones[0]" in missing["message"]
    knot = wait_for(lambda: ready("policies", "knot"), "the policy's condition")
    assert (knot["status"], knot["reason"]) == ("False", "ZoneInvalid")
    crossed = wait_for(lambda: ready("policies", "both"), "the policy's condition")
    assert (crossed["status"], crossed["reason"]) == ("False", "ZoneInvalid")
    assert "cross more than 50000 times" in crossed["message"]


def test_policy_whose_zone_is_far_from_depots_has_condition_until_a_depot_is_near(
    world: World, operator: OperatorProcess
) -> None:
    world.put(fractus_object("Zone", "far", {"area": {"circle": {"center": {"lat": 22.9, "lon": 39.4}, "radius": 50}}}))
    spec = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["far"]}}
    world.put(fractus_object("Policy", "far", spec))

    def conditions() -> dict[str, Body]:
        status = (world.api.get(f"{FRACTUS}/policies/far") or {}).get("status") or {}
        return {c["type"]: c for c in status.get("conditions") or ()}

    far = wait_for(lambda: conditions().get("FarFromDepots"), "the condition of the policy")
    assert "more than 100 km from every Depot: far; check latitude" in far["message"]
    assert conditions()["Ready"]["status"] == "True"
    events = f"/api/v1/namespaces/default/events?fieldSelector=involvedObject.name=far,reason={far['reason']}"
    wait_for(lambda: (world.api.get(events) or {}).get("items"), "an Event")
    world.put(fractus_object("Depot", "near-far", {"location": {"lat": 22.9, "lon": 39.4}, "radius": 30}))
    wait_for(lambda: "FarFromDepots" not in conditions(), "the end of the condition")


def test_corrected_application_is_deployed(world: World, operator: OperatorProcess, namespace: str) -> None:
    manifest = traffic(namespace, "traffic", navigator(), component("DataStore", "cloud"))
    manifest["spec"]["components"][0]["controlPoints"][0]["point"] = {"depot": "late"}
    world.put(manifest)
    world.phase(namespace, "Invalid")
    world.put(fractus_object("Depot", "late", {"location": at(0, 0), "radius": 30}))
    world.phase(namespace, "Deploying")


# -- pods on drones and edge nodes --


def test_pod_with_node_name_of_drone_is_refused(world: World, chart: None, namespace: str) -> None:
    """A pod with `nodeName` bypasses the scheduler, and a kubelet enforces only NoExecute taints of its node."""
    drone = "/api/v1/nodes/drone-1"
    pods = f"/api/v1/namespaces/{namespace}/pods?dryRun=All"

    def named(node: str) -> Callable[[], object]:
        spec = {"nodeName": node, "hostNetwork": True, "containers": [{"name": "a", "image": "a"}]}
        pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "named"}, "spec": spec}
        return lambda: world.api.call("POST", pods, pod)

    def refused(node: str) -> bool:
        try:
            named(node)()
        except KubeError as error:
            return "instead of nodeName" in str(error)
        return False

    wait_for(lambda: refused("drone-1"), "the admission policy to be in force")
    denied(named("edge-1"), "edge-1 is a drone or an edge node, for which the scheduler places pods")
    named("cloud-1")()
    # The policy ignores cloud nodes, and guarded nodes, whose NoExecute taint the kubelet enforces itself.
    for label in ("fractus.dev/cloud", "fractus.dev/guarded"):
        world.api.merge(drone, {"metadata": {"labels": {label: "true"}}})
        try:
            wait_for(lambda: not refused("drone-1"), "the policy to ignore the labelled node")
        finally:
            world.api.merge(drone, {"metadata": {"labels": {label: None}}})
        wait_for(lambda: refused("drone-1"), "the policy to apply to the node again")


# -- the operator's own permissions --


def test_operator_reads_no_secret(control_plane: ControlPlane, world: World, chart: None, namespace: str) -> None:
    """The only exception is the Secret with the authority's key. Patches and deletions would return the content."""
    client = control_plane.with_token(operator_token(world))
    for place in (namespace, "kube-system", SYSTEM):
        secrets = f"/api/v1/namespaces/{place}/secrets"
        body = {"apiVersion": "v1", "kind": "Secret", "metadata": {"name": "theirs", "namespace": place}}
        world.api.apply(f"{secrets}/theirs", body)
        try:
            for method, path, verb in (
                ("GET", secrets, "list"),
                ("GET", f"{secrets}?watch=true", "watch"),
                ("GET", f"{secrets}/theirs", "get"),
                ("DELETE", f"{secrets}?dryRun=All", "deletecollection"),
            ):
                denied(partial(client.call, method, path), f'cannot {verb} resource "secrets"')
            denied(partial(client.merge, f"{secrets}/theirs", {}), 'cannot patch resource "secrets"')
            denied(partial(client.apply, f"{secrets}/theirs", body), 'cannot patch resource "secrets"')
        finally:
            world.api.delete(f"{secrets}/theirs")
    denied(partial(client.call, "GET", "/api/v1/secrets"), 'cannot list resource "secrets"')


def test_operator_writes_only_objects_that_it_has_created(
    control_plane: ControlPlane, world: World, chart: None, namespace: str
) -> None:
    foreign_path = f"/api/v1/namespaces/{namespace}/secrets/theirs"
    body = {"apiVersion": "v1", "kind": "Secret", "metadata": {"name": "theirs", "namespace": namespace}}
    world.api.apply(foreign_path, body)
    ours_too = {"metadata": {"labels": {"app.kubernetes.io/managed-by": "fractus"}}}
    client = control_plane.with_token(operator_token(world))
    message = "may write only secrets that it has created"
    try:
        wait_for(lambda: _probe_refused(client), "the admission policy to be in force")
        secrets = foreign_path.rpartition("/")[0]
        labelled = body | {"metadata": body["metadata"] | ours_too["metadata"], "type": "Opaque"}
        denied(lambda: client.call("PUT", foreign_path, labelled), message)
        denied(lambda: client.delete(foreign_path), message)
        denied(lambda: client.call("POST", secrets, body | {"metadata": {"name": "fresh"}}), message)
        container = {"name": "main", "image": "registry.test/theirs:1"}
        pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "theirs"}, "spec": {"containers": [container]}}
        pods = f"/api/v1/namespaces/{namespace}/pods"
        world.api.apply(f"{pods}/theirs", pod)
        message = message.replace("secrets", "pods")
        denied(lambda: client.merge(f"{pods}/theirs", {"spec": {"activeDeadlineSeconds": 1}}), message)
        denied(lambda: client.merge(f"{pods}/theirs", ours_too), message)
        denied(lambda: client.delete(f"{pods}/theirs"), message)
        world.api.apply(f"{pods}/ours", pod | {"metadata": {"name": "ours", **ours_too["metadata"]}})
        other = [{"op": "replace", "path": "/spec/containers/0/image", "value": "registry.test/other:1"}]
        change = ContentType.JSON_PATCH
        denied(
            lambda: client.call("PATCH", f"{pods}/ours", other, content_type=change), "but not change their containers"
        )
        client.merge(f"{pods}/ours", {"spec": {"activeDeadlineSeconds": 1}})
        node = "/api/v1/nodes/edge-1"
        labels = "may write only the location labels of nodes"
        denied(lambda: client.merge(node, {"spec": {"unschedulable": True}}), labels)
        denied(lambda: client.merge(node, {"metadata": {"labels": {"fractus.dev/class": "cloud"}}}), labels)
        denied(lambda: client.merge(node, {"metadata": {"labels": {"kubernetes.io/os": "x"}}}), labels)
        # Annotations are used by network plugins. Finalizers would keep a Node, and owner references could delete it.
        for field, value in (
            ("annotations", {"flannel.alpha.coreos.com/public-ip": "192.0.2.1"}),
            ("finalizers", ["a/b"]),
        ):
            denied(lambda field=field, value=value: client.merge(node, {"metadata": {field: value}}), labels)
        client.merge(node, {"metadata": {"labels": {"fractus.dev/geohash": "sx1"}}})
        guarded = {"metadata": {"labels": {"fractus.dev/guarded": "true"}}}
        denied(lambda: client.merge(node, guarded), "may mark a node as guarded only if")
        world.api.merge(node, {"spec": {"taints": [{"key": "fractus.dev/class", "effect": "NoExecute"}]}})
        client.merge(node, guarded)
        world.api.merge(node, {"spec": {"taints": []}})
        client.merge(node, {"metadata": {"labels": {"fractus.dev/geohash": "sx2"}}})
        client.merge(node, {"metadata": {"labels": {"fractus.dev/guarded": None}}})
        world.put(traffic(namespace))
        path = world.path(traffic(namespace))
        denied(
            lambda: client.merge(path, {"spec": {"components": [component("A", "cloud")]}}), "may not write the spec"
        )
        client.merge(path, {"metadata": {"finalizers": []}})
    finally:
        client.close()


def test_operator_writes_only_config_map_of_its_authority(
    control_plane: ControlPlane, world: World, chart: None
) -> None:
    """Users apply manifests from ConfigMaps in the same namespace, and pods read kube-root-ca.crt."""
    maps = f"/api/v1/namespaces/{SYSTEM}/configmaps"

    def config_map(name: str) -> Body:
        labels = {"app.kubernetes.io/managed-by": "fractus"}
        return {
            "apiVersion": "v1",
            "kind": "ConfigMap",
            "metadata": {"name": name, "labels": labels},
            "data": {"a": "b"},
        }

    world.api.apply(f"{maps}/fractus-demo-applications", config_map("fractus-demo-applications"))
    client = control_plane.with_token(operator_token(world))
    try:
        wait_for(lambda: _probe_refused(client), "the admission policy to be in force")
        for name in ("fractus-demo-applications", "kube-root-ca.crt"):
            denied(partial(client.merge, f"{maps}/{name}", {"data": {"a": "c"}}), 'cannot patch resource "configmaps"')
            denied(partial(client.apply, f"{maps}/{name}", config_map(name)), 'cannot patch resource "configmaps"')
            denied(partial(client.call, "GET", f"{maps}/{name}"), 'cannot get resource "configmaps"')
            denied(partial(client.delete, f"{maps}/{name}"), 'cannot delete resource "configmaps"')
        denied(lambda: client.call("POST", maps, config_map("theirs")), "may write only the ConfigMap fractus-ca")
        generated = config_map("x") | {"metadata": {"generateName": "fractus-ca"}}
        denied(lambda: client.call("POST", maps, generated), "may write only the ConfigMap fractus-ca")
        client.apply(f"{maps}/fractus-ca", config_map("fractus-ca"))
        # A user may remove the labels. The operator must be able to restore the certificate nevertheless.
        world.api.apply(f"{maps}/fractus-ca", config_map("fractus-ca") | {"metadata": {"name": "fractus-ca"}})
        client.apply(f"{maps}/fractus-ca", config_map("fractus-ca"))
    finally:
        client.close()
        for name in ("fractus-demo-applications", "fractus-ca"):
            world.api.delete(f"{maps}/{name}")


def test_operator_deletes_only_pods_of_services_in_system_namespace(
    control_plane: ControlPlane, world: World, chart: None
) -> None:
    client = control_plane.with_token(operator_token(world))
    pods = f"/api/v1/namespaces/{SYSTEM}/pods"

    def delete(name: str) -> object:
        return client.call("DELETE", f"{pods}/{name}", {"dryRun": ["All"]})

    try:
        wait_for(lambda: _probe_refused(client), "the admission policy to be in force")
        wait_for(lambda: world.api.get(f"/api/v1/namespaces/{SYSTEM}/serviceaccounts/default"), "the default account")
        for name, part, permitted in (
            ("fractus", "agent", True),
            ("fractus", "operator", False),
            ("fractus", "view", False),
            ("fractus-demo", "vehicle", False),
            ("other", "agent", False),
        ):
            labels = {"app.kubernetes.io/name": name, "app.kubernetes.io/component": part}
            world.bound_pod(SYSTEM, f"{name}-{part}", "cloud-1", labels)
            if permitted:
                delete(f"{name}-{part}")
            else:
                denied(partial(delete, f"{name}-{part}"), "may write only pods that it has created")
    finally:
        client.close()


_MADE = {
    "Service": ("v1", "services"),
    "EndpointSlice": ("discovery.k8s.io/v1", "endpointslices"),
    "NetworkPolicy": ("networking.k8s.io/v1", "networkpolicies"),
    "PodDisruptionBudget": ("policy/v1", "poddisruptionbudgets"),
}


_RESTRICTED = {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}, "readOnlyRootFilesystem": True}
_COMMAND = {"exec": {"command": ["true"]}}
_SIDECAR: dict[str, Any] = {
    "name": "fractus-mavlink",
    "image": "registry.test/mobility:1",
    "restartPolicy": "Always",
    "startupProbe": _COMMAND,
    "securityContext": _RESTRICTED,
}
_PRIVILEGED_SIDECARS: tuple[dict[str, Any], ...] = (
    _SIDECAR | {"name": "first"},
    {"name": "fractus-mavlink", "image": "registry.test/mobility:1", "securityContext": _RESTRICTED},
    _SIDECAR | {"securityContext": {}},
    _SIDECAR | {"ports": [{"containerPort": 1, "hostPort": 1}]},
)


def test_operator_token_cannot_escalate_with_pods_or_secrets(
    control_plane: ControlPlane, world: World, chart: None, namespace: str
) -> None:
    """Try to create Pods and Secrets that would give control of the cluster. They have the operator's label."""
    client = control_plane.with_token(operator_token(world))
    mine = {"app.kubernetes.io/managed-by": "fractus"}

    restricted = _RESTRICTED

    def deployment(place: str = namespace, container: dict[str, Any] | None = None, **pod: Any) -> Callable[[], object]:
        main = {"name": "main", "image": "registry.test/theirs:1", "securityContext": restricted} | (container or {})
        spec = {
            "automountServiceAccountToken": False,
            "securityContext": {"runAsNonRoot": True, "runAsUser": 10001, "seccompProfile": {"type": "RuntimeDefault"}},
            "containers": [main],
        } | pod
        body = {
            "apiVersion": "apps/v1",
            "kind": "Deployment",
            "metadata": {"name": "theirs", "namespace": place, "labels": mine},
            "spec": {
                "selector": {"matchLabels": {"a": "b"}},
                "template": {"metadata": {"labels": {"a": "b"}}, "spec": spec},
            },
        }
        return lambda: client.call("POST", f"/apis/apps/v1/namespaces/{place}/deployments?dryRun=All", body)

    def secret(name: str, place: str = namespace, **more: Any) -> Callable[[], object]:
        data = {"tls.crt": "eA==", "tls.key": "eA=="}
        body = {"type": "kubernetes.io/tls", "data": data} | more
        body |= {"apiVersion": "v1", "kind": "Secret"}
        body["metadata"] = {"name": name, "labels": mine} | more.get("metadata", {})
        return lambda: client.call("POST", f"/api/v1/namespaces/{place}/secrets?dryRun=All", body)

    account = {"annotations": {"kubernetes.io/service-account.name": "default"}}
    host = {"name": "host", "hostPath": {"path": "/"}}
    token = {"name": "token", "projected": {"sources": [{"serviceAccountToken": {"path": "token"}}]}}
    root = {"runAsNonRoot": True, "runAsUser": 0, "seccompProfile": {"type": "RuntimeDefault"}}
    try:
        wait_for(lambda: _probe_refused(client), "the admission policy to be in force")
        # The API server accepts the unchanged objects, so the changed field causes each of the following refusals.
        deployment()()
        secret("traffic-navigator-tls")()
        for place in ("kube-system", SYSTEM, NODES):
            denied(deployment(place), "may not run pods in the namespace")
        for pod in (
            {"automountServiceAccountToken": True},
            {"serviceAccountName": "privileged"},
        ):
            denied(deployment(**pod), "without a service account")
        for pod in (
            {"hostNetwork": True},
            {"hostPID": True},
            {"nodeName": "cloud-1"},
            {"priorityClassName": "system-cluster-critical"},
            {"volumes": [host]},
            {"volumes": [token]},
        ):
            denied(deployment(**pod), "do not share resources of the node")
        deployment(initContainers=[_SIDECAR])()
        for pod in ({"securityContext": root}, *({"initContainers": [s]} for s in _PRIVILEGED_SIDECARS)):
            denied(deployment(**pod), "one unprivileged container")
        for probe in ({"startupProbe": {"tcpSocket": {"port": 1}}}, {"lifecycle": {"postStart": _COMMAND}}):
            denied(deployment(initContainers=[_SIDECAR | probe]), "without probes and hooks")
        for spec_change in (
            {"privileged": True},
            {"allowPrivilegeEscalation": False},
            {"allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"], "add": ["NET_RAW"]}},
            {"allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]}, "runAsUser": 0},
        ):  # fmt: skip
            denied(deployment(container={"securityContext": spec_change}), "one unprivileged container")
        confined = {"runAsNonRoot": True, "runAsUser": 10001, "seccompProfile": {"type": "RuntimeDefault"}}
        for more in ({"seLinuxOptions": {"type": "spc_t"}}, {"appArmorProfile": {"type": "Unconfined"}}):
            denied(deployment(securityContext=confined | more), "only confined pods")
            denied(deployment(container={"securityContext": restricted | more}), "only confined pods")
        denied(
            deployment(securityContext=confined | {"sysctls": [{"name": "a.b", "value": "1"}]}),
            "only confined pods",
        )
        unmasked = {"securityContext": restricted | {"procMount": "Unmasked"}}
        denied(deployment(container=unmasked, hostUsers=False), "only confined pods")
        beyond = {"httpGet": {"host": "169.254.169.254", "port": 80}}
        for called in ({"livenessProbe": beyond}, {"lifecycle": {"postStart": beyond}}):
            denied(deployment(container=called), "without probes and hooks")
        claim = {"name": "gpu", "resourceClaimName": "autopilot-link"}
        block = {"name": "disk", "persistentVolumeClaim": {"claimName": "disk"}}
        for changed in (
            deployment(runtimeClassName="unconfined"),
            deployment(resourceClaims=[claim]),
            deployment(schedulerName="theirs"),
            deployment(container={"volumeDevices": [{"name": "disk", "devicePath": "/d"}]}, volumes=[block]),
        ):
            denied(changed, "default runtime and scheduler, without devices")
        certificates = "only Secrets with certificates of instances"
        denied(
            secret("theirs-tls", type="kubernetes.io/service-account-token", data={}, metadata=account), certificates
        )
        denied(secret("theirs-tls", type="Opaque"), certificates)
        denied(
            secret("bootstrap-token-abcdef", "kube-system", type="bootstrap.kubernetes.io/token", data={}), certificates
        )
        denied(secret("theirs"), certificates)
        denied(secret("fractus-ca"), certificates)
        for place in (SYSTEM, NODES, "kube-system", "kube-public", "kube-node-lease"):
            denied(secret("theirs-tls", place), certificates)
        # The operator must not read or write objects that give rights.
        for path in (
            f"/api/v1/namespaces/{SYSTEM}/serviceaccounts/fractus-node/token",
            "/apis/rbac.authorization.k8s.io/v1/clusterrolebindings",
            f"/apis/rbac.authorization.k8s.io/v1/namespaces/{namespace}/rolebindings",
            f"/api/v1/namespaces/{namespace}/pods",
            f"/api/v1/namespaces/{namespace}/configmaps",
        ):
            denied(lambda path=path: client.call("POST", path, {}), "forbidden")
    finally:
        client.close()


def test_operator_token_cannot_redirect_foreign_traffic(
    control_plane: ControlPlane, world: World, chart: None, namespace: str
) -> None:
    """Try to create objects that would redirect traffic of other users. The objects have the operator's label."""
    client = control_plane.with_token(operator_token(world))
    mine = {"app.kubernetes.io/managed-by": "fractus"}

    def made(kind: str, spec: dict[str, Any], place: str = namespace, **more: Any) -> Callable[[], object]:
        api, plural = _MADE[kind]
        labels = mine | {"fractus.dev/application": "a"} | more.pop("labels", {})
        body = {"apiVersion": api, "kind": kind, "metadata": {"name": "theirs", "labels": labels}, **more}
        body |= {"spec": spec} if spec else {}
        group = f"/apis/{api}" if "/" in api else f"/api/{api}"
        return lambda: client.call("POST", f"{group}/namespaces/{place}/{plural}?dryRun=All", body)

    def endpoints(**changed: Any) -> Callable[[], object]:
        target = {"kind": "Pod", "name": "p", "namespace": namespace} | changed.pop("target", {})
        names = {
            "kubernetes.io/service-name": "theirs",
            "endpointslice.kubernetes.io/managed-by": "operator.fractus.dev",
        } | changed
        found = [{"addresses": ["10.1.2.3"], "targetRef": target}]
        return made("EndpointSlice", {}, addressType="IPv4", endpoints=found, labels=names)

    own_labels = {"fractus.dev/application": "a"}
    try:
        wait_for(lambda: _probe_refused(client), "the admission policy to be in force")
        ports = [{"port": 80}]
        for selector in ({"selector": own_labels}, {}):
            made("Service", {"ports": ports, **selector})()
        for spec in (
            {"ports": ports, "selector": {"app": "bank"}},
            {"ports": ports, "selector": own_labels, "type": "LoadBalancer"},
            {"ports": ports, "selector": own_labels, "type": "NodePort"},
            {"ports": ports, "selector": own_labels, "externalIPs": ["192.0.2.1"]},
            {"type": "ExternalName", "externalName": "bank.test"},
        ):
            denied(made("Service", spec), "cluster-internal Services for pods of applications")
        endpoints()()
        names = {
            "kubernetes.io/service-name": "theirs",
            "endpointslice.kubernetes.io/managed-by": "operator.fractus.dev",
        }
        for no_pods in ([], None):
            made("EndpointSlice", {}, addressType="IPv4", endpoints=no_pods, labels=names)()
        for changed in (
            {"kubernetes.io/service-name": "bank"},
            {"endpointslice.kubernetes.io/managed-by": "endpointslice-controller.k8s.io"},
            {"target": {"kind": "Node"}},
            {"target": {"namespace": "elsewhere"}},
        ):
            denied(endpoints(**changed), "EndpointSlices for pods of applications")
        _leads_no_other_s_traffic(world, client, namespace)
        made("NetworkPolicy", {"podSelector": {"matchLabels": own_labels}, "policyTypes": ["Ingress"]})()
        for spec in (
            {"podSelector": {}, "policyTypes": ["Ingress"]},
            {"podSelector": {"matchLabels": {"app": "bank"}}, "policyTypes": ["Ingress"]},
            {"podSelector": {"matchLabels": own_labels}, "policyTypes": ["Egress"]},
        ):
            denied(made("NetworkPolicy", spec), "NetworkPolicies for pods of applications")
        made("PodDisruptionBudget", {"maxUnavailable": 0, "selector": {"matchLabels": own_labels}})()
        every = {"maxUnavailable": 0, "selector": {"matchLabels": {"app": "bank"}}}
        denied(made("PodDisruptionBudget", every), "PodDisruptionBudgets for pods of applications")
        denied(
            made("Service", {"ports": ports, "selector": own_labels}, "kube-system"),
            "may not run pods in the namespace",
        )
    finally:
        client.close()


def _leads_no_other_s_traffic(world: World, client: BlockingClient, namespace: str) -> None:
    """Check that the operator adds no EndpointSlice to a Service that another client created."""
    services = f"/api/v1/namespaces/{namespace}/services"
    slices = f"/apis/discovery.k8s.io/v1/namespaces/{namespace}/endpointslices"

    def ends(address: str) -> list[Body]:
        return [{"addresses": [address], "targetRef": {"kind": "Pod", "name": "p", "namespace": namespace}}]

    def lead(name: str, query: str = "") -> object:
        labels = {
            "app.kubernetes.io/managed-by": "fractus",
            "fractus.dev/application": "a",
            "kubernetes.io/service-name": name,
            "endpointslice.kubernetes.io/managed-by": "operator.fractus.dev",
        }
        body: Body = {"apiVersion": "discovery.k8s.io/v1", "kind": "EndpointSlice", "addressType": "IPv4"}
        body |= {"metadata": {"name": name, "labels": labels}, "endpoints": ends("10.1.2.3")}
        return client.call("POST", f"{slices}{query}", body)

    def refused(name: str) -> bool:
        try:
            lead(name, "?dryRun=All")
        except KubeError as error:
            return f"did not create the Service {name} and may not direct its traffic" in str(error)
        return False

    for name, labels in (("bank", {}), ("ours", {"app.kubernetes.io/managed-by": "fractus"})):
        metadata = {"name": name, "labels": labels}
        body = {"apiVersion": "v1", "kind": "Service", "metadata": metadata, "spec": {"ports": [{"port": 80}]}}
        world.api.call("POST", services, body)
    wait_for(lambda: refused("bank"), "the admission policy to know the Service")
    lead("ours")
    # When the Service has another owner, the operator cannot change the addresses of its own older EndpointSlice.
    world.api.merge(f"{services}/ours", {"metadata": {"labels": {"app.kubernetes.io/managed-by": "helm"}}})
    wait_for(lambda: refused("ours"), "the admission policy to know the new owner of the Service")
    elsewhere = {"endpoints": ends("10.1.2.4")}
    denied(lambda: client.merge(f"{slices}/ours", elsewhere), "did not create the Service ours")


def _probe_refused(client: BlockingClient) -> bool:
    try:
        client.merge("/api/v1/nodes/cloud-1", {"metadata": {"labels": {"probe": uuid.uuid4().hex}}})
    except KubeError as error:
        return error.status == 403 and "location labels" in str(error)
    return False


def test_operator_works_with_permissions_of_the_chart(
    control_plane: ControlPlane, world: World, chart: None, namespace: str, tmp_path: Path
) -> None:
    token = operator_token(world)
    config = yaml.safe_load(control_plane.kubeconfig.read_text())
    config["users"][0]["user"] = {"token": token}
    kubeconfig = tmp_path / "operator.kubeconfig"
    kubeconfig.write_text(yaml.safe_dump(config))
    operator = OperatorProcess(kubeconfig, tmp_path / "operator.log")
    operator.start()
    try:
        world.put(traffic(namespace))
        wait_for(lambda: len(world.pods(namespace)) == 7, operator.log)
        world.run_pods(namespace)
        world.phase(namespace, "Waiting")
        grant = f"{FRACTUS}/grants/{namespace}.traffic-navigator/status"
        world.api.merge(grant, {"status": {"phase": "Complete"}})
        world.phase(namespace, "Completed")
        wait_for(
            lambda: all("fractus.dev/finished" in pod["metadata"]["labels"] for pod in world.pods(namespace)),
            operator.log,
        )
        assert len(world.pods(namespace)) == 7
        world.api.delete(world.path(traffic(namespace)))
        wait_for(lambda: world.application(namespace) is None and not world.children(namespace), operator.log)
    finally:
        operator.stop()
    assert "forbidden" not in operator.log().lower()
    assert "ERROR" not in operator.log()
