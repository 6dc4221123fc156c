"""Permissions of agents in the cluster, and the certificates that they can get."""

from __future__ import annotations

import base64
import copy
import uuid
from collections.abc import Iterator
from typing import Any

import pytest
from chart import operator_token, path_of, render
from control_plane import ControlPlane, wait_for
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.x509.oid import NameOID
from fractus_core.api.grants import pack
from fractus_operator.kinds import NODE_GRANTS, ROLE, ROLE_BINDING, SERVICE_ACCOUNT
from fractus_operator.node_objects import ACCOUNT_KINDS, account_object, header
from fractus_runtime.kubernetes import BlockingClient, ContentType, Kind, KubeError
from operator_world import FRACTUS, NODES, SYSTEM, Body, OperatorProcess, World, at, denied, fractus_object

REQUESTS = "/apis/certificates.k8s.io/v1/certificatesigningrequests"

OLD = {"ServiceAccount", "ClusterRole", "ClusterRoleBinding", "Role", "RoleBinding"}

# -- permissions of agents --


@pytest.fixture
def agents(control_plane: ControlPlane, world: World, chart: None) -> Iterator[dict[str, BlockingClient]]:
    """Return clients with the tokens of the agents of drone-1 and edge-1, bound to pods on these nodes."""
    clients = {}
    pods = f"/api/v1/namespaces/{SYSTEM}/pods"
    for node in ("drone-1", "edge-1"):
        name = f"fractus-agent-{node}"
        world.api.delete(f"{pods}/{name}", grace_s=0)
        spec = {"nodeName": node, "serviceAccountName": "fractus-node", "containers": [{"name": "a", "image": "a"}]}
        pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": name, "namespace": SYSTEM}, "spec": spec}
        uid = world.api.call("POST", pods, pod)["metadata"]["uid"]
        bound = {"kind": "Pod", "apiVersion": "v1", "name": name, "uid": uid}
        request = {"apiVersion": "authentication.k8s.io/v1", "kind": "TokenRequest",
                   "spec": {"expirationSeconds": 600, "boundObjectRef": bound}}  # fmt: skip
        path = f"/api/v1/namespaces/{SYSTEM}/serviceaccounts/fractus-node/token"
        clients[node] = control_plane.with_token(world.api.call("POST", path, request)["status"]["token"])
    # The API server enforces a new admission policy after a delay. Wait until the policy denies a request.
    wait_for(lambda: _denied(clients["edge-1"]), "the admission policy to be in force")
    yield clients
    for client in clients.values():
        client.close()


def _denied(client: BlockingClient) -> bool:
    try:
        client.merge(f"{FRACTUS}/drones/drone-1/status?dryRun=All", {"status": {"flightState": "flying"}})
    except KubeError as error:
        return error.status == 403 and "may write only the Drone" in str(error)
    return False


def test_agent_writes_status_of_its_own_drone_only(world: World, agents: dict[str, BlockingClient]) -> None:
    state = {"status": {"flightState": "flying"}}
    agents["drone-1"].merge(f"{FRACTUS}/drones/drone-1/status", state)
    denied(
        lambda: agents["edge-1"].merge(f"{FRACTUS}/drones/drone-1/status", state),
        "only the Drone or EdgeNode of edge-1",
    )
    world.add_drone("drone-2")
    denied(
        lambda: agents["drone-1"].merge(f"{FRACTUS}/drones/drone-2/status", state),
        "only the Drone or EdgeNode of drone-1",
    )


@pytest.mark.parametrize(("kind", "other"), [("EdgeNode", "drone-1"), ("Drone", "edge-1")])
def test_drone_and_edge_node_of_one_name_are_refused(
    world: World, agents: dict[str, BlockingClient], kind: str, other: str
) -> None:
    path = f"{FRACTUS}/{kind.lower()}s?dryRun=All"
    spec: Body = {"location": at(0, 0)} if kind == "EdgeNode" else {"services": {}}

    def refused() -> bool:
        try:
            world.api.call("POST", path, fractus_object(kind, other, spec))
        except KubeError as error:
            return error.status == 422 and f" {other}, and a node is either a drone or an edge node" in str(error)
        return False

    wait_for(refused, "the refusal of the second object")
    world.api.call("POST", path, fractus_object(kind, "another-name", spec))


def test_agent_registers_its_own_node_only(world: World, agents: dict[str, BlockingClient]) -> None:
    body = copy.deepcopy(world.api.get(f"{FRACTUS}/edgenodes/edge-1"))
    assert body is not None
    fresh = fractus_object("EdgeNode", "edge-1", body["spec"])
    world.api.delete(f"{FRACTUS}/edgenodes/edge-1")
    denied(
        lambda: agents["drone-1"].call("POST", f"{FRACTUS}/edgenodes", fresh), "only the Drone or EdgeNode of drone-1"
    )
    agents["edge-1"].call("POST", f"{FRACTUS}/edgenodes", fresh)
    nameless = {**fresh, "metadata": {"generateName": "edge-"}}
    denied(
        lambda: agents["edge-1"].call("POST", f"{FRACTUS}/edgenodes", nameless), "only the Drone or EdgeNode of edge-1"
    )
    denied(lambda: agents["edge-1"].delete(f"{FRACTUS}/edgenodes/edge-1"), "cannot delete")


def test_agent_registers_only_the_kind_of_its_node_label(world: World, agents: dict[str, BlockingClient]) -> None:
    def refused(node: str, kind: Body, label: str) -> bool:
        path = f"{FRACTUS}/{kind['kind'].lower()}s?dryRun=All"
        try:
            agents[node].call("POST", path, kind)
        except KubeError as error:
            return error.status == 403 and f"has the label fractus.dev/class={label}; its agent" in str(error)
        return False

    drone = fractus_object("Drone", "edge-1", {"services": {}})
    edge = fractus_object("EdgeNode", "drone-1", {"location": at(0, 0)})
    registered = [f"{FRACTUS}/drones/drone-1", f"{FRACTUS}/edgenodes/edge-1"]
    bodies = [world.api.get(path) or {} for path in registered]
    for path in registered:
        world.api.delete(path)
    wait_for(lambda: refused("edge-1", drone, "edge"), "the refusal of a Drone")
    wait_for(lambda: refused("drone-1", edge, "drone"), "the refusal of an EdgeNode")
    world.api.call("POST", f"{FRACTUS}/drones?dryRun=All", drone)
    for body in bodies:
        world.put(fractus_object(body["kind"], body["metadata"]["name"], body["spec"]))


def _grant(world: World, node: str) -> str:
    name = f"t.{uuid.uuid4().hex[:8]}"
    owner = {"namespace": "t", "name": "a", "uid": "u"}
    world.put(fractus_object("Grant", name, {"node": node, "application": owner, "component": "A", "instance": "a"}))
    return f"{FRACTUS}/grants/{name}"


def test_agent_has_no_rights_on_grants(world: World, agents: dict[str, BlockingClient]) -> None:
    mine = _grant(world, "drone-1")
    agent = agents["drone-1"]
    copied = [{"op": "copy", "from": "/spec/identity", "path": "/status/phase"}]
    denied(lambda: agent.get(mine), "cannot get")
    denied(lambda: agent.list(f"{FRACTUS}/grants", fieldSelector="spec.node=drone-1"), "cannot list")
    denied(lambda: agent.list(f"{FRACTUS}/grants", watch="true", timeoutSeconds="1"), "cannot watch")
    denied(lambda: agent.merge(f"{mine}/status", {"status": {"phase": "Active"}}), "cannot patch")
    denied(lambda: agent.call("PATCH", f"{mine}/status", copied, content_type=ContentType.JSON_PATCH), "cannot patch")
    denied(lambda: agent.merge(mine, {"spec": {"component": "B"}}), "cannot patch")
    denied(lambda: agent.list(f"{FRACTUS}/namespaces/{NODES}/nodegrants"), "cannot list")
    denied(lambda: agent.get(f"{FRACTUS}/namespaces/{NODES}/nodegrants/drone-1"), "cannot get")
    denied(lambda: agent.merge(f"{FRACTUS}/zones/any", {"spec": {}}), "cannot patch")


def token_request(node: str = "drone-1", **spec: Any) -> Body:
    bound = {"kind": "Node", "apiVersion": "v1", "name": node}
    request_spec = {"expirationSeconds": 3600, "boundObjectRef": bound} | spec
    return {"apiVersion": "authentication.k8s.io/v1", "kind": "TokenRequest", "spec": request_spec}


def token_path(node: str, namespace: str = NODES) -> str:
    return f"/api/v1/namespaces/{namespace}/serviceaccounts/{node}/token"


@pytest.fixture
def accounts(control_plane: ControlPlane, world: World, agents: dict[str, BlockingClient]) -> None:
    """Create the accounts and objects of drone-1 and edge-1 with the operator's token."""
    operator = control_plane.with_token(operator_token(world))
    for node in agents:
        for path, body in node_objects(node).items():
            wait_for(lambda path=path, body=body: operator.call("POST", path, body), f"{body['kind']} {node}")
    operator.close()


def node_objects(node: str) -> dict[str, Body]:
    """Return the objects that the operator creates for a node, by the path of their collection."""
    objects = {kind.path(NODES): account_object(kind, node) for kind in ACCOUNT_KINDS}
    spec = {"count": 0, "packed": pack(())}
    return objects | {NODE_GRANTS.path(NODES): header(NODE_GRANTS, node) | {"spec": spec}}


def test_agent_reads_and_updates_only_node_grants_of_its_node(
    control_plane: ControlPlane, agents: dict[str, BlockingClient], accounts: None
) -> None:
    token = agents["drone-1"].call("POST", token_path("drone-1"), token_request())["status"]["token"]
    node = control_plane.with_token(token)
    path = f"{FRACTUS}/namespaces/{NODES}/nodegrants"
    status = {"status": {"observedGeneration": 1, "grants": []}}
    assert node.get(f"{path}/drone-1")
    assert len(node.list(path, fieldSelector="metadata.name=drone-1")) == 1
    node.merge(f"{path}/drone-1/status", status)
    denied(lambda: node.get(f"{path}/edge-1"), "cannot get")
    denied(lambda: node.list(path), "cannot list")
    denied(lambda: node.list(path, fieldSelector="metadata.name=edge-1"), "cannot list")
    denied(lambda: node.list(f"{FRACTUS}/nodegrants", fieldSelector="metadata.name=drone-1"), "cannot list")
    denied(lambda: node.merge(f"{path}/edge-1/status", status), "cannot patch")
    denied(lambda: node.merge(f"{path}/drone-1", {"spec": {"count": 1}}), "cannot patch")
    denied(lambda: node.delete(f"{path}/drone-1"), "cannot delete")
    denied(lambda: node.list(f"{FRACTUS}/grants"), "cannot list")
    denied(lambda: node.call("POST", token_path("drone-1"), token_request()), "cannot create")
    node.close()


@pytest.mark.parametrize(
    ("path", "request_", "words"),
    [
        pytest.param(
            token_path("edge-1"), token_request("edge-1"), "only tokens of the account of drone-1", id="another node"
        ),
        pytest.param(
            token_path("edge-1"), token_request(), "only tokens of the account of drone-1", id="another account"
        ),
        pytest.param(token_path("drone-1"), token_request("edge-1"), "bound to the Node drone-1", id="bound elsewhere"),
        pytest.param(
            token_path("drone-1"), token_request(boundObjectRef=None), "bound to the Node drone-1", id="loose"
        ),
        pytest.param(token_path("drone-1"), token_request(expirationSeconds=3601), "for at most one hour", id="longer"),
        pytest.param(token_path("default"), token_request(), "only tokens of the account of drone-1", id="default"),
        pytest.param(token_path("fractus-node", SYSTEM), token_request(), "cannot create", id="its own"),
        pytest.param(token_path("fractus-operator", SYSTEM), token_request(), "cannot create", id="the operator"),
    ],
)
def test_agent_gets_no_other_token(
    agents: dict[str, BlockingClient], accounts: None, path: str, request_: Body, words: str
) -> None:
    denied(lambda: agents["drone-1"].call("POST", path, request_), words)


def _rules(node: str, *more: Body, **changed: Any) -> Body:
    role = account_object(ROLE, node)
    return role | {"rules": [{**rule, **changed} for rule in role["rules"]] + list(more)}


PODS = {"apiGroups": [""], "resources": ["pods"], "verbs": ["get"]}
"""Additional permission for the role. The operator has it, because the API server refuses to grant what the requester lacks."""


@pytest.mark.parametrize(
    ("kind", "body", "words"),
    [
        pytest.param(ROLE, _rules("n", resourceNames=["m"]), "node that it is named after", id="another node"),
        pytest.param(ROLE, _rules("n", resourceNames=[]), "node that it is named after", id="all nodes"),
        pytest.param(ROLE, _rules("n", verbs=["patch"]), "node that it is named after", id="other verbs"),
        pytest.param(ROLE, _rules("n", {**PODS}), "node that it is named after", id="more"),
        pytest.param(
            ROLE, account_object(ROLE, "n") | {"metadata": {"name": "n"}}, "that it has created", id="not labelled"
        ),
        pytest.param(
            ROLE_BINDING,
            account_object(ROLE_BINDING, "drone-1")
            | {"subjects": [{"kind": "ServiceAccount", "name": "m", "namespace": NODES}]},
            "node that it is named after",
            id="another account",
        ),
        pytest.param(
            ROLE_BINDING,
            account_object(ROLE_BINDING, "drone-1")
            | {"subjects": [{"kind": "User", "apiGroup": "rbac.authorization.k8s.io", "name": "drone-1"}]},
            "node that it is named after",
            id="a user",
        ),
        pytest.param(
            SERVICE_ACCOUNT,
            account_object(SERVICE_ACCOUNT, "n") | {"automountServiceAccountToken": True},
            "without Secrets",
            id="mounted",
        ),
    ],
)
def test_operator_token_cannot_grant_other_rights(
    control_plane: ControlPlane, world: World, accounts: None, kind: Kind, body: Body, words: str
) -> None:
    client = control_plane.with_token(operator_token(world))
    try:
        denied(lambda: client.call("POST", kind.path(NODES), body), words)
    finally:
        client.close()


def test_operator_creates_accounts_only_in_node_namespace(
    control_plane: ControlPlane, world: World, accounts: None
) -> None:
    client = control_plane.with_token(operator_token(world))
    try:
        for kind in (*ACCOUNT_KINDS, NODE_GRANTS):
            denied(lambda kind=kind: client.call("POST", kind.path(SYSTEM), {}), "cannot create")
        denied(lambda: client.delete(ROLE.path(NODES, "fractus:operator")), "that it has created")
        denied(lambda: client.call("POST", token_path("drone-1"), token_request()), "cannot create")
        path = NODE_GRANTS.path(NODES, "drone-1", "status")
        denied(lambda: client.merge(path, {"status": {"observedGeneration": 3}}), "reports of agents")
    finally:
        client.close()


def test_agents_of_previous_release_keep_account_until_replaced(
    control_plane: ControlPlane, world: World, agents: dict[str, BlockingClient]
) -> None:
    connected = ("--dry-run=server", f"--kubeconfig={control_plane.kubeconfig}")

    def old() -> list[Body]:
        return [
            body for body in render(*connected) if body["metadata"]["name"] == "fractus-agent" and body["kind"] in OLD
        ]

    assert not old()
    pods = f"/api/v1/namespaces/{SYSTEM}/pods"
    world.api.apply(
        f"/api/v1/namespaces/{SYSTEM}/serviceaccounts/fractus-agent",
        {"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": "fractus-agent", "namespace": SYSTEM}},
    )
    spec = {"nodeName": "edge-2", "serviceAccountName": "fractus-agent", "containers": [{"name": "a", "image": "a"}]}
    pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "old", "namespace": SYSTEM}, "spec": spec}
    uid = world.api.call("POST", pods, pod)["metadata"]["uid"]
    made = old()
    assert {body["kind"] for body in made} == OLD
    for body in made:
        world.api.apply(path_of(body), body)
    bound = {"kind": "Pod", "apiVersion": "v1", "name": "old", "uid": uid}
    request = token_request(boundObjectRef=bound, expirationSeconds=600)
    path = f"/api/v1/namespaces/{SYSTEM}/serviceaccounts/fractus-agent/token"
    agent = control_plane.with_token(world.api.call("POST", path, request)["status"]["token"])
    mine = _grant(world, "edge-2")
    other = _grant(world, "drone-1")
    status = {"status": {"phase": "Complete"}}
    wait_for(lambda: agent.get(mine), "the right to read Grants")
    agent.merge(f"{mine}/status", status)
    denied(lambda: agent.merge(f"{other}/status", status), "only on Grants of edge-2")
    denied(lambda: agent.call("POST", token_path("edge-2"), token_request("edge-2")), "cannot create")
    agent.close()
    world.api.delete(f"{pods}/old", grace_s=0)
    for body in made:
        world.api.delete(path_of(body))
    assert not old()


def _direct_link(world: World, drone: str, node: str) -> str:
    name = f"t.{uuid.uuid4().hex[:8]}"
    spec = {
        "drone": drone, "node": node, "application": {"namespace": "t", "name": "a", "uid": "u"}, "technology": "WiFi",
        "pairing": {"networkId": "n"}, "range": 120, "bandwidth": 12, "position": at(0, 0),
        "heuristic": {"kind": "preferDirect"},
    }  # fmt: skip
    world.put(fractus_object("DirectLink", name, spec))
    return f"{FRACTUS}/directlinks/{name}"


def test_agent_writes_status_of_direct_links_of_its_node_only(world: World, agents: dict[str, BlockingClient]) -> None:
    link = _direct_link(world, "drone-1", "edge-1")
    other = _direct_link(world, "drone-2", "edge-1")
    agents["drone-1"].merge(f"{link}/status", {"status": {"phase": "Up"}, "spec": {"range": 1000}})
    agents["edge-1"].merge(f"{link}/status", {"status": {"switches": 1}})
    agents["edge-1"].merge(f"{other}/status", {"status": {"phase": "Idle"}})
    written = world.api.get(link)
    assert written is not None
    assert (written["status"], written["spec"]["range"]) == ({"phase": "Up", "switches": 1}, 120)
    denied(
        lambda: agents["drone-1"].merge(f"{other}/status", {"status": {"phase": "Up"}}),
        "only on direct links of drone-1",
    )
    denied(lambda: agents["drone-1"].merge(link, {"spec": {"range": 1000}}), "cannot patch")
    denied(lambda: agents["drone-1"].delete(link), "cannot delete")


def test_token_without_bound_node_writes_nothing(
    control_plane: ControlPlane, world: World, agents: dict[str, BlockingClient]
) -> None:
    path = f"/api/v1/namespaces/{SYSTEM}/serviceaccounts/fractus-node/token"
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
    """Wait until the request is signed or denied, and return its status."""

    def look() -> Body | None:
        status = (world.api.get(f"{REQUESTS}/{body['metadata']['name']}") or {}).get("status") or {}
        denied = any(c["type"] == "Denied" for c in status.get("conditions", ()))
        return status if denied or status.get("certificate") else None

    return wait_for(look, "the request to be settled")


def test_agent_gets_certificate_of_its_node(
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
def test_agent_gets_no_other_certificate(
    world: World, operator: OperatorProcess, agents: dict[str, BlockingClient], change: Body, reason: str
) -> None:
    body = signing_request("drone-1", **change)
    agents["drone-1"].call("POST", REQUESTS, body)
    status = settled(world, body)
    assert "certificate" not in status
    assert [(c["type"], c["reason"]) for c in status["conditions"]] == [("Denied", reason)]


def test_node_certificate_is_refused_to_other_requesters(
    world: World, operator: OperatorProcess, agents: dict[str, BlockingClient]
) -> None:
    body = signing_request("drone-1")
    world.api.call("POST", REQUESTS, body)
    assert [c["reason"] for c in settled(world, body)["conditions"]] == ["WrongRequester"]
    denied(lambda: agents["edge-1"].call("POST", REQUESTS, signing_request("drone-1")), "only certificates of edge-1")
    kubelet = signing_request(
        "drone-1", signerName="kubernetes.io/kube-apiserver-client-kubelet", usages=["client auth"]
    )
    denied(lambda: agents["drone-1"].call("POST", REQUESTS, kubelet), "only certificates of drone-1")
