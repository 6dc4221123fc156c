"""What the chart lets an agent do in the cluster, and whose certificates it gets."""

from __future__ import annotations

import base64
import copy
import uuid
from collections.abc import Iterator
from typing import Any

import pytest
from control_plane import ControlPlane, wait_for
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.x509.oid import NameOID
from fractus_kube import BlockingClient, KubeError
from operator_world import FRACTUS, SYSTEM, Body, OperatorProcess, World, at, denied, ours

REQUESTS = "/apis/certificates.k8s.io/v1/certificatesigningrequests"

# -- what agents may do --


@pytest.fixture
def agents(control_plane: ControlPlane, world: World, chart: None) -> Iterator[dict[str, BlockingClient]]:
    """Clients with tokens as the agents of drone-1 and edge-1 have them, bound to pods on these nodes."""
    clients = {}
    pods = f"/api/v1/namespaces/{SYSTEM}/pods"
    for node in ("drone-1", "edge-1"):
        name = f"fractus-agent-{node}"
        world.api.delete(f"{pods}/{name}", grace_s=0)
        spec = {"nodeName": node, "serviceAccountName": "fractus-agent", "containers": [{"name": "a", "image": "a"}]}
        pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": name, "namespace": SYSTEM}, "spec": spec}
        uid = world.api.call("POST", pods, pod)["metadata"]["uid"]
        bound = {"kind": "Pod", "apiVersion": "v1", "name": name, "uid": uid}
        request = {"apiVersion": "authentication.k8s.io/v1", "kind": "TokenRequest",
                   "spec": {"expirationSeconds": 600, "boundObjectRef": bound}}  # fmt: skip
        path = f"/api/v1/namespaces/{SYSTEM}/serviceaccounts/fractus-agent/token"
        clients[node] = control_plane.with_token(world.api.call("POST", path, request)["status"]["token"])
    # The API server needs a moment to know a new admission policy: wait until it denies.
    wait_for(lambda: _denied(clients["edge-1"]), "the admission policy to be in force")
    yield clients
    for client in clients.values():
        client.close()


def _denied(client: BlockingClient) -> bool:
    try:
        client.merge(f"{FRACTUS}/drones/drone-1/status?dryRun=All", {"status": {"flightState": "flying"}})
    except KubeError as error:
        return error.status == 403 and "may write the Drone" in str(error)
    return False


def test_an_agent_reports_its_own_drone_only(world: World, agents: dict[str, BlockingClient]) -> None:
    state = {"status": {"flightState": "flying"}}
    agents["drone-1"].merge(f"{FRACTUS}/drones/drone-1/status", state)
    denied(lambda: agents["edge-1"].merge(f"{FRACTUS}/drones/drone-1/status", state), "edge-1 only")
    world.add_drone("drone-2")
    denied(lambda: agents["drone-1"].merge(f"{FRACTUS}/drones/drone-2/status", state), "drone-1 only")


def test_an_agent_registers_its_own_node_only(world: World, agents: dict[str, BlockingClient]) -> None:
    body = copy.deepcopy(world.api.get(f"{FRACTUS}/edgenodes/edge-1"))
    assert body is not None
    fresh = ours("EdgeNode", "edge-1", body["spec"])
    world.api.delete(f"{FRACTUS}/edgenodes/edge-1")
    denied(lambda: agents["drone-1"].call("POST", f"{FRACTUS}/edgenodes", fresh), "drone-1 only")
    agents["edge-1"].call("POST", f"{FRACTUS}/edgenodes", fresh)
    nameless = {**fresh, "metadata": {"generateName": "edge-"}}
    denied(lambda: agents["edge-1"].call("POST", f"{FRACTUS}/edgenodes", nameless), "edge-1 only")
    denied(lambda: agents["edge-1"].delete(f"{FRACTUS}/edgenodes/edge-1"), "cannot delete")


def test_an_agent_makes_its_node_nothing_else_than_its_label_says(
    world: World, agents: dict[str, BlockingClient]
) -> None:
    def refused(node: str, kind: Body, label: str) -> bool:
        path = f"{FRACTUS}/{kind['kind'].lower()}s?dryRun=All"
        try:
            agents[node].call("POST", path, kind)
        except KubeError as error:
            return error.status == 403 and f"has the label fractus.dev/class={label}; its agent" in str(error)
        return False

    drone, edge = ours("Drone", "edge-1", {"services": {}}), ours("EdgeNode", "drone-1", {"location": at(0, 0)})
    wait_for(lambda: refused("edge-1", drone, "edge"), "the refusal of a drone")
    wait_for(lambda: refused("drone-1", edge, "drone"), "the refusal of an edge node")
    world.api.call("POST", f"{FRACTUS}/drones?dryRun=All", drone)


def _grant(world: World, node: str) -> str:
    name = f"t.{uuid.uuid4().hex[:8]}"
    owner = {"namespace": "t", "name": "a", "uid": "u"}
    world.put(ours("Grant", name, {"node": node, "application": owner, "component": "A", "instance": "a"}))
    return f"{FRACTUS}/grants/{name}"


def test_an_agent_reports_on_grants_of_its_node_only(world: World, agents: dict[str, BlockingClient]) -> None:
    mine, other = _grant(world, "drone-1"), _grant(world, "edge-1")
    status = {"status": {"phase": "Active"}}
    agents["drone-1"].merge(f"{mine}/status", status)
    denied(lambda: agents["drone-1"].merge(f"{other}/status", status), "drone-1 only")
    denied(lambda: agents["drone-1"].merge(mine, {"spec": {"component": "B"}}), "cannot patch")
    denied(lambda: agents["drone-1"].merge(f"{FRACTUS}/zones/any", {"spec": {}}), "cannot patch")


def _direct_link(world: World, drone: str, node: str) -> str:
    name = f"t.{uuid.uuid4().hex[:8]}"
    spec = {
        "drone": drone, "node": node, "application": {"namespace": "t", "name": "a", "uid": "u"}, "technology": "WiFi",
        "pairing": {"networkId": "n"}, "range": 120, "bandwidth": 12, "position": at(0, 0),
        "heuristic": {"kind": "preferDirect"},
    }  # fmt: skip
    world.put(ours("DirectLink", name, spec))
    return f"{FRACTUS}/directlinks/{name}"


def test_an_agent_reports_on_direct_links_of_its_node_only(world: World, agents: dict[str, BlockingClient]) -> None:
    ours, other = _direct_link(world, "drone-1", "edge-1"), _direct_link(world, "drone-2", "edge-1")
    agents["drone-1"].merge(f"{ours}/status", {"status": {"phase": "Up"}, "spec": {"range": 1000}})
    agents["edge-1"].merge(f"{ours}/status", {"status": {"switches": 1}})
    agents["edge-1"].merge(f"{other}/status", {"status": {"phase": "Idle"}})
    written = world.api.get(ours)
    assert written is not None
    assert (written["status"], written["spec"]["range"]) == ({"phase": "Up", "switches": 1}, 120)
    denied(lambda: agents["drone-1"].merge(f"{other}/status", {"status": {"phase": "Up"}}), "drone-1 only")
    denied(lambda: agents["drone-1"].merge(ours, {"spec": {"range": 1000}}), "cannot patch")
    denied(lambda: agents["drone-1"].delete(ours), "cannot delete")


def test_a_token_that_is_bound_to_no_node_writes_nothing(
    control_plane: ControlPlane, world: World, agents: dict[str, BlockingClient]
) -> None:
    path = f"/api/v1/namespaces/{SYSTEM}/serviceaccounts/fractus-agent/token"
    request = {"apiVersion": "authentication.k8s.io/v1", "kind": "TokenRequest", "spec": {"expirationSeconds": 600}}
    loose = control_plane.with_token(world.api.call("POST", path, request)["status"]["token"])
    state = {"status": {"flightState": "flying"}}
    denied(lambda: loose.merge(f"{FRACTUS}/drones/drone-1/status", state), "not bound to a node")
    loose.close()


# -- certificates of nodes --


def signing_request(node: str, names: list[x509.GeneralName] | None = None, key: Any = None, **spec: Any) -> Body:
    key = key or ec.generate_private_key(ec.SECP256R1())
    default = [
        x509.UniformResourceIdentifier(f"spiffe://fractus.dev/node/{node}"),
        x509.DNSName(f"{node}.node.fractus.dev"),
    ]
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, node)])
    builder = x509.CertificateSigningRequestBuilder().subject_name(subject)
    builder = builder.add_extension(x509.SubjectAlternativeName(default if names is None else names), critical=False)
    pem = builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)
    return {
        "apiVersion": "certificates.k8s.io/v1",
        "kind": "CertificateSigningRequest",
        "metadata": {"name": f"fractus-{node}-{uuid.uuid4().hex[:8]}", "labels": {"fractus.dev/node": node}},
        "spec": {
            "request": base64.b64encode(pem).decode(),
            "signerName": "fractus.dev/node",
            "usages": ["digital signature", "server auth", "client auth"],
            **spec,
        },
    }


def settled(world: World, body: Body) -> Body:
    """The status of a request once it is signed or denied."""

    def look() -> Body | None:
        status = (world.api.get(f"{REQUESTS}/{body['metadata']['name']}") or {}).get("status") or {}
        denied = any(c["type"] == "Denied" for c in status.get("conditions", ()))
        return status if denied or status.get("certificate") else None

    return wait_for(look, "the request to be settled")


def test_an_agent_gets_the_certificate_of_its_node(
    world: World, operator: OperatorProcess, agents: dict[str, BlockingClient]
) -> None:
    body = signing_request("drone-1")
    agents["drone-1"].call("POST", REQUESTS, body)
    status = settled(world, body)
    certificate = x509.load_pem_x509_certificate(base64.b64decode(status["certificate"]))
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert sorted(n.value for n in names) == ["drone-1.node.fractus.dev", "spiffe://fractus.dev/node/drone-1"]
    authority = world.api.get(f"/api/v1/namespaces/{SYSTEM}/configmaps/fractus-ca") or {}
    certificate.verify_directly_issued_by(x509.load_pem_x509_certificate(authority["data"]["ca.crt"].encode()))
    assert not certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca


FOREIGN = [
    pytest.param({"names": [x509.DNSName("edge-1.node.fractus.dev")]}, "WrongNames", id="another node"),
    pytest.param(
        {"names": [x509.UniformResourceIdentifier("spiffe://fractus.dev/node/drone-1"),
                   x509.DNSName("drone-1.node.fractus.dev"), x509.DNSName("example.org")]},
        "WrongNames", id="one name too many",
    ),
    pytest.param({"names": [x509.UniformResourceIdentifier("spiffe://fractus.dev/ns/a/app/b/component/c/instance/d")]},
                 "WrongNames", id="a component"),
    pytest.param({"usages": ["digital signature", "server auth"]}, "WrongUsages", id="fewer usages"),
    pytest.param({"usages": ["server auth", "client auth", "cert sign"]}, "WrongUsages", id="to sign others"),
    pytest.param({"key": ec.generate_private_key(ec.SECP384R1())}, "WrongKey", id="another curve"),
    pytest.param({"key": rsa.generate_private_key(65537, 2048)}, "WrongKey", id="RSA"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "reason"), FOREIGN)
def test_an_agent_gets_no_other_certificate(
    world: World, operator: OperatorProcess, agents: dict[str, BlockingClient], change: Body, reason: str
) -> None:
    body = signing_request("drone-1", **change)
    agents["drone-1"].call("POST", REQUESTS, body)
    status = settled(world, body)
    assert "certificate" not in status
    assert [(c["type"], c["reason"]) for c in status["conditions"]] == [("Denied", reason)]


def test_no_other_gets_a_certificate_of_a_node(
    world: World, operator: OperatorProcess, agents: dict[str, BlockingClient]
) -> None:
    body = signing_request("drone-1")
    world.api.call("POST", REQUESTS, body)
    assert [c["reason"] for c in settled(world, body)["conditions"]] == ["WrongRequester"]
    denied(lambda: agents["edge-1"].call("POST", REQUESTS, signing_request("drone-1")), "edge-1 only")
    kubelet = signing_request(
        "drone-1", signerName="kubernetes.io/kube-apiserver-client-kubelet", usages=["client auth"]
    )
    denied(lambda: agents["drone-1"].call("POST", REQUESTS, kubelet), "drone-1 only")
