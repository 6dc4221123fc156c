"""What the API server and the operator allow no one: bad manifests, foreign certificates, foreign nodes."""

from __future__ import annotations

import base64
import copy
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from chart import operator_token
from control_plane import ControlPlane, wait_for
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.x509.oid import NameOID
from fractus_kube import BlockingClient, ContentType, KubeError
from operator_world import FRACTUS, SYSTEM, OperatorProcess, World, at, component, navigator, ours, traffic

Body = dict[str, Any]
REQUESTS = "/apis/certificates.k8s.io/v1/certificatesigningrequests"


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
def test_a_bad_application_is_refused_and_nothing_is_made(
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


def test_a_crossing_zone_and_an_unknown_zone_are_not_ready(world: World, operator: OperatorProcess) -> None:
    ring = [at(0, 0), at(50, 50), at(0, 50), at(50, 0)]
    world.put(ours("Zone", "bowtie", {"area": {"polygon": {"exterior": ring}}}))
    world.put(
        ours("Policy", "nowhere", {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["nowhere"]}})
    )
    world.put(
        ours("Policy", "knot", {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["bowtie"]}})
    )

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


def test_a_corrected_application_is_deployed(world: World, operator: OperatorProcess, namespace: str) -> None:
    manifest = traffic(namespace, "traffic", navigator(), component("DataStore", "cloud"))
    manifest["spec"]["components"][0]["controlPoints"][0]["point"] = {"depot": "late"}
    world.put(manifest)
    world.phase(namespace, "Invalid")
    world.put(ours("Depot", "late", {"location": at(0, 0), "radius": 30}))
    world.phase(namespace, "Deploying")


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


def denied(attempt: Callable[[], object], words: str) -> None:
    with pytest.raises(KubeError) as refusal:
        attempt()
    assert refusal.value.status == 403, refusal.value
    assert words in str(refusal.value)


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


# -- the operator's own permissions --


def test_the_operator_writes_nothing_that_it_has_not_made(
    control_plane: ControlPlane, world: World, chart: None, namespace: str
) -> None:
    theirs = f"/api/v1/namespaces/{namespace}/secrets/theirs"
    body = {"apiVersion": "v1", "kind": "Secret", "metadata": {"name": "theirs", "namespace": namespace}}
    world.api.apply(theirs, body)
    ours_too = {"metadata": {"labels": {"app.kubernetes.io/managed-by": "fractus"}}}
    client = control_plane.with_token(operator_token(world))
    made = "writes only the secrets that it has made itself"
    try:
        wait_for(lambda: _probe_refused(client), "the admission policy to be in force")
        # A patch would answer with the whole Secret: what is refused is not told either.
        denied(lambda: client.merge(theirs, {}), made)
        denied(lambda: client.merge(theirs, ours_too), made)
        denied(lambda: client.apply(theirs, body | {"data": {}}), made)
        denied(lambda: client.delete(theirs), made)
        denied(lambda: client.apply(theirs.replace("theirs", "fresh"), body | {"metadata": {"name": "fresh"}}), made)
        container = {"name": "main", "image": "registry.test/theirs:1"}
        pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "theirs"}, "spec": {"containers": [container]}}
        pods = f"/api/v1/namespaces/{namespace}/pods"
        world.api.apply(f"{pods}/theirs", pod)
        made = made.replace("secrets", "pods")
        denied(lambda: client.merge(f"{pods}/theirs", {"spec": {"activeDeadlineSeconds": 1}}), made)
        denied(lambda: client.merge(f"{pods}/theirs", ours_too), made)
        denied(lambda: client.delete(f"{pods}/theirs"), made)
        world.api.apply(f"{pods}/ours", pod | {"metadata": {"name": "ours", **ours_too["metadata"]}})
        other = [{"op": "replace", "path": "/spec/containers/0/image", "value": "registry.test/other:1"}]
        change = ContentType.JSON_PATCH
        denied(
            lambda: client.call("PATCH", f"{pods}/ours", other, content_type=change), "does not change what they run"
        )
        client.merge(f"{pods}/ours", {"spec": {"activeDeadlineSeconds": 1}})
        node, labels = "/api/v1/nodes/edge-1", "writes only the location labels of nodes"
        denied(lambda: client.merge(node, {"spec": {"unschedulable": True}}), labels)
        denied(lambda: client.merge(node, {"metadata": {"labels": {"fractus.dev/class": "cloud"}}}), labels)
        denied(lambda: client.merge(node, {"metadata": {"labels": {"kubernetes.io/os": "x"}}}), labels)
        client.merge(node, {"metadata": {"labels": {"fractus.dev/geohash": "sx1"}}})
        world.put(traffic(namespace))
        path = world.path(traffic(namespace))
        denied(
            lambda: client.merge(path, {"spec": {"components": [component("A", "cloud")]}}), "does not write the spec"
        )
        client.merge(path, {"metadata": {"finalizers": []}})
    finally:
        client.close()


_MADE = {
    "Service": ("v1", "services"),
    "EndpointSlice": ("discovery.k8s.io/v1", "endpointslices"),
    "NetworkPolicy": ("networking.k8s.io/v1", "networkpolicies"),
    "PodDisruptionBudget": ("policy/v1", "poddisruptionbudgets"),
}


def test_who_has_the_operator_s_token_gets_no_further(
    control_plane: ControlPlane, world: World, chart: None, namespace: str
) -> None:
    """Pods and Secrets that carry the operator's label, and would give their maker the cluster."""
    client = control_plane.with_token(operator_token(world))
    mine = {"app.kubernetes.io/managed-by": "fractus"}

    def deployment(place: str = namespace, container: dict[str, Any] | None = None, **pod: Any) -> Callable[[], object]:
        restricted = {
            "allowPrivilegeEscalation": False,
            "capabilities": {"drop": ["ALL"]},
            "readOnlyRootFilesystem": True,
        }
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
        # As it is, it would be let in: what follows is refused for what it says.
        deployment()()
        secret("traffic-navigator-tls")()
        for place in ("kube-system", SYSTEM):
            denied(deployment(place), "runs nothing in the namespace")
        for pod in (
            {"automountServiceAccountToken": True},
            {"serviceAccountName": "privileged"},
        ):
            denied(deployment(**pod), "without an account")
        for pod in (
            {"hostNetwork": True},
            {"hostPID": True},
            {"nodeName": "cloud-1"},
            {"priorityClassName": "system-cluster-critical"},
            {"volumes": [host]},
            {"volumes": [token]},
        ):
            denied(deployment(**pod), "share nothing with their node")
        for pod in ({"securityContext": root}, {"initContainers": [{"name": "first", "image": "x"}]}):
            denied(deployment(**pod), "one container without privileges")
        for given in (
            {"privileged": True},
            {"allowPrivilegeEscalation": False},
            {"allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"], "add": ["NET_RAW"]}},
            {"allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]}, "runAsUser": 0},
        ):  # fmt: skip
            denied(deployment(container={"securityContext": given}), "one container without privileges")
        certificates = "certificates of instances only"
        denied(
            secret("theirs-tls", type="kubernetes.io/service-account-token", data={}, metadata=account), certificates
        )
        denied(secret("theirs-tls", type="Opaque"), certificates)
        denied(
            secret("bootstrap-token-abcdef", "kube-system", type="bootstrap.kubernetes.io/token", data={}), certificates
        )
        denied(secret("theirs"), certificates)
        denied(secret("fractus-ca"), certificates)
        denied(secret("theirs-tls", SYSTEM), certificates)
        # Nor does it read or write what gives rights.
        for path in (
            f"/api/v1/namespaces/{SYSTEM}/serviceaccounts/fractus-agent/token",
            "/apis/rbac.authorization.k8s.io/v1/clusterrolebindings",
            f"/apis/rbac.authorization.k8s.io/v1/namespaces/{namespace}/rolebindings",
            f"/api/v1/namespaces/{namespace}/pods",
            f"/api/v1/namespaces/{namespace}/configmaps",
        ):
            denied(lambda path=path: client.call("POST", path, {}), "forbidden")
    finally:
        client.close()


def test_who_has_the_operator_s_token_moves_no_traffic(
    control_plane: ControlPlane, world: World, chart: None, namespace: str
) -> None:
    """Objects that carry the operator's label, and would give their maker the traffic of others."""
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

    own = {"fractus.dev/application": "a"}
    try:
        wait_for(lambda: _probe_refused(client), "the admission policy to be in force")
        ports = [{"port": 80}]
        for selector in ({"selector": own}, {}):
            made("Service", {"ports": ports, **selector})()
        for spec in (
            {"ports": ports, "selector": {"app": "bank"}},
            {"ports": ports, "selector": own, "type": "LoadBalancer"},
            {"ports": ports, "selector": own, "type": "NodePort"},
            {"ports": ports, "selector": own, "externalIPs": ["192.0.2.1"]},
            {"type": "ExternalName", "externalName": "bank.test"},
        ):
            denied(made("Service", spec), "inside the cluster, for pods of applications")
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
            denied(endpoints(**changed), "EndpointSlices of pods of applications")
        made("NetworkPolicy", {"podSelector": {"matchLabels": own}, "policyTypes": ["Ingress"]})()
        for spec in (
            {"podSelector": {}, "policyTypes": ["Ingress"]},
            {"podSelector": {"matchLabels": {"app": "bank"}}, "policyTypes": ["Ingress"]},
            {"podSelector": {"matchLabels": own}, "policyTypes": ["Egress"]},
        ):
            denied(made("NetworkPolicy", spec), "NetworkPolicies for pods of applications")
        made("PodDisruptionBudget", {"maxUnavailable": 0, "selector": {"matchLabels": own}})()
        every = {"maxUnavailable": 0, "selector": {"matchLabels": {"app": "bank"}}}
        denied(made("PodDisruptionBudget", every), "PodDisruptionBudgets for pods of applications")
        denied(made("Service", {"ports": ports, "selector": own}, "kube-system"), "runs nothing in the namespace")
    finally:
        client.close()


def _probe_refused(client: BlockingClient) -> bool:
    try:
        client.merge("/api/v1/nodes/cloud-1", {"metadata": {"labels": {"probe": uuid.uuid4().hex}}})
    except KubeError as error:
        return error.status == 403 and "location labels" in str(error)
    return False


def test_the_operator_does_its_work_with_the_chart_s_permissions(
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
