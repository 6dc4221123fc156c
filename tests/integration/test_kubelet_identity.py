"""Permissions of the certificates of kubelets and components: NodeRestriction, and no access to objects of Fractus."""

from __future__ import annotations

import base64
import uuid
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
from control_plane import ControlPlane, wait_for
from fractus_core.api import KINDS
from fractus_core.identity.authority import Authority
from fractus_runtime.kubernetes import BlockingClient, KubeError, with_certificate
from operator_world import FRACTUS, NODES, SYSTEM, Body, OperatorProcess, World, denied
from test_agent_permissions import REQUESTS, settled, signing_request

TOKENS = {"apiVersion": "authentication.k8s.io/v1", "kind": "TokenRequest"}


@pytest.fixture
def kubelet(control_plane: ControlPlane, world: World, chart: None) -> Iterator[BlockingClient]:
    """API client with the certificate of the kubelet of drone-1."""
    client = control_plane.as_user("kubelet", "system:node:drone-1", ("system:nodes",))
    yield client
    client.close()


@pytest.fixture
def pod_on(world: World, namespace: str) -> Callable[..., Body]:
    """Function that creates a pod on a node, like the scheduler and the DaemonSet controller."""

    def make(node: str, place: str = namespace, **spec: object) -> Body:
        return world.bound_pod(place, f"p-{uuid.uuid4().hex[:8]}", node, **spec)

    return make


def permitted(attempt: Callable[[], object]) -> bool:
    """Return True if the API server permits a request. It receives pods through a watch, with a delay."""
    try:
        attempt()
    except KubeError as error:
        assert error.status in (403, 404), error
        return False
    return True


def test_kubelet_has_no_access_to_objects_of_fractus(world: World, kubelet: BlockingClient, namespace: str) -> None:
    for kind in KINDS:
        scope = f"/namespaces/{namespace}" if kind.NAMESPACED else ""
        path = f"{FRACTUS}{scope}/{kind.PLURAL}"
        denied(lambda path=path: kubelet.list(path), "cannot list")
        denied(lambda path=path: kubelet.list(path, watch="true", timeoutSeconds="1"), "cannot watch")
        denied(lambda path=path: kubelet.get(f"{path}/drone-1"), "cannot get")
        denied(lambda path=path: kubelet.call("POST", path, {}), "cannot create")
        denied(lambda path=path: kubelet.merge(f"{path}/drone-1", {"metadata": {}}), "cannot patch")
        denied(lambda path=path: kubelet.merge(f"{path}/drone-1/status", {"status": {}}), "cannot patch")
        denied(lambda path=path: kubelet.delete(f"{path}/drone-1"), "cannot delete")
    denied(lambda: kubelet.get(f"{FRACTUS}/namespaces/{NODES}/nodegrants/drone-1"), "cannot get")


def test_kubelet_reads_only_certificates_of_its_pods(
    world: World, kubelet: BlockingClient, namespace: str, pod_on: Callable[..., Body]
) -> None:
    secrets = f"/api/v1/namespaces/{namespace}/secrets"
    for name in ("mine", "theirs"):
        secret = {"apiVersion": "v1", "kind": "Secret", "metadata": {"name": name}, "stringData": {"tls.key": name}}
        world.api.apply(f"{secrets}/{name}", secret)
    for name, node in (("mine", "drone-1"), ("theirs", "edge-1")):
        pod_on(node, volumes=[{"name": "tls", "secret": {"secretName": name}}])
    wait_for(lambda: permitted(lambda: kubelet.get(f"{secrets}/mine")), "the API server to receive the pod of drone-1")
    denied(lambda: kubelet.get(f"{secrets}/theirs"), "no relationship found")
    denied(lambda: kubelet.get(f"/api/v1/namespaces/{SYSTEM}/secrets/fractus-ca"), "no relationship found")
    denied(lambda: kubelet.list(secrets), "cannot list")


def test_kubelet_gets_only_tokens_of_its_agent(
    world: World, kubelet: BlockingClient, pod_on: Callable[..., Body]
) -> None:
    def token(account: str, pod: Body, place: str = SYSTEM) -> object:
        bound = {"kind": "Pod", "apiVersion": "v1", "name": pod["metadata"]["name"], "uid": pod["metadata"]["uid"]}
        request = TOKENS | {"spec": {"expirationSeconds": 600, "boundObjectRef": bound}}
        return kubelet.call("POST", f"/api/v1/namespaces/{place}/serviceaccounts/{account}/token", request)

    own_pod, other_pod = (pod_on(node, SYSTEM, serviceAccountName="fractus-node") for node in ("drone-1", "edge-1"))
    operator = pod_on("cloud-1", SYSTEM, serviceAccountName="fractus-operator")
    wait_for(lambda: permitted(lambda: token("fractus-node", own_pod)), "the API server to receive the pod of drone-1")
    denied(lambda: token("fractus-node", other_pod), "pod")
    denied(lambda: token("fractus-operator", operator), "forbidden")
    denied(lambda: token("fractus-operator", own_pod), "forbidden")
    # An agent may request a token of its node's account. The kubelet may not, because none of its pods uses this account.
    denied(lambda: token("drone-1", own_pod, NODES), "forbidden")
    node = {"kind": "Node", "apiVersion": "v1", "name": "drone-1"}
    loose = TOKENS | {"spec": {"boundObjectRef": node}}
    denied(
        lambda: kubelet.call("POST", f"/api/v1/namespaces/{NODES}/serviceaccounts/drone-1/token", loose), "forbidden"
    )


def test_kubelet_gets_no_node_certificate(world: World, operator: OperatorProcess, kubelet: BlockingClient) -> None:
    body = signing_request("drone-1")
    kubelet.call("POST", REQUESTS, body)
    status = settled(world, body)
    assert "certificate" not in status
    assert [(c["type"], c["reason"]) for c in status["conditions"]] == [("Denied", "WrongRequester")]
    approval = {"status": {"conditions": [{"type": "Approved", "status": "True", "reason": "x", "message": "x"}]}}
    path = f"{REQUESTS}/{body['metadata']['name']}"
    for part in ("approval", "status"):
        denied(lambda part=part: kubelet.merge(f"{path}/{part}", approval), "cannot patch")


def test_kubelet_creates_only_mirror_pods_of_its_node(
    world: World, kubelet: BlockingClient, namespace: str, pod_on: Callable[..., Body]
) -> None:
    labels = {"fractus.dev/application": "traffic", "app.kubernetes.io/managed-by": "fractus"}
    pods = f"/api/v1/namespaces/{namespace}/pods"

    def pod(node: str, **annotations: str) -> Body:
        metadata = {"name": "theirs", "labels": labels, "annotations": annotations}
        spec = {"nodeName": node, "containers": [{"name": "a", "image": "a"}]}
        return {"apiVersion": "v1", "kind": "Pod", "metadata": metadata, "spec": spec}

    denied(lambda: kubelet.call("POST", pods, pod("drone-1")), "can only create mirror pods")
    record = {"kubernetes.io/config.mirror": "x"}
    denied(
        lambda: kubelet.call("POST", pods, pod("edge-1", **record)),
        "can only create pods with spec.nodeName set to itself",
    )
    other = pod_on("edge-1")["metadata"]["name"]
    denied(
        lambda: kubelet.merge(f"{pods}/{other}/status", {"status": {"phase": "Failed"}}), "can only update pod status"
    )
    denied(lambda: kubelet.delete(f"{pods}/{other}"), "can only delete pods")
    for part in ("", "/status"):
        path = f"/api/v1/nodes/edge-1{part}"
        denied(
            lambda path=path: kubelet.merge(path, {"metadata": {"labels": {"a": "b"}}}), "is not allowed to modify node"
        )


def test_component_certificate_is_refused_by_api_server(
    control_plane: ControlPlane, world: World, tmp_path: Path
) -> None:
    """Pods of Applications mount no token, so a component could only try its own certificate."""
    now = datetime.now(UTC)
    issued = Authority.generate(now).issue_component("spiffe://fractus.dev/ns/n/app/a/component/C/instance/i", now)
    for name, value in issued.items():
        (tmp_path / name).write_bytes(base64.b64decode(value))
    certificate = (tmp_path / "tls.crt", tmp_path / "tls.key")
    client = BlockingClient(with_certificate(control_plane.server, control_plane.ca, certificate), "component")
    try:
        for path in (f"{FRACTUS}/drones", f"{FRACTUS}/grants", f"/api/v1/namespaces/{SYSTEM}/secrets"):
            with pytest.raises(KubeError) as refusal:
                client.list(path)
            assert refusal.value.status == 401, refusal.value
    finally:
        client.close()
