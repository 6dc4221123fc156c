"""`fractus doctor`: findings and remedies for each problem of a cluster."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from fractus_cli.doctor import POLICIES, SERVICES, Finding, examine
from fractus_core.api import KINDS
from fractus_core.api.crd import crd
from fractus_core.identity.authority import Authority

NOW = datetime(2026, 6, 1, tzinfo=UTC)
SYSTEM = "/namespaces/fractus-system"
OPERATOR = f"/apis/apps/v1{SYSTEM}/deployments/fractus-operator"
AGENT = f"/apis/apps/v1{SYSTEM}/daemonsets/fractus-agent"
PODS = f"/api/v1{SYSTEM}/pods"
EVENTS = f"/api/v1{SYSTEM}/events"
CRDS = "/apis/apiextensions.k8s.io/v1/customresourcedefinitions"
GUARD = "/apis/admissionregistration.k8s.io/v1/validatingadmissionpolicies/fractus-pods"
BINDINGS = "/apis/admissionregistration.k8s.io/v1/validatingadmissionpolicybindings"

Body = dict[str, Any]


class Cluster:
    """Fake of a healthy cluster: objects and lists by path. A test changes it to create a problem."""

    def __init__(self) -> None:
        ready = {"readyReplicas": 2, "conditions": [{"type": "ReplicaFailure", "status": "False", "reason": "x"}]}
        counts = {"numberReady": 1, "desiredNumberScheduled": 1, "currentNumberScheduled": 1}
        established = {"status": {"conditions": [{"type": "Established", "status": "True"}]}}
        public = Authority.generate(NOW - timedelta(days=1)).certificate_pem.decode()
        fine = {"conditions": [{"type": "Ready", "status": "True", "reason": "Ready"}]}
        taint = {"taints": [{"key": "fractus.dev/class", "effect": "NoExecute"}]}
        exempt = {
            "key": "kubernetes.io/metadata.name",
            "operator": "NotIn",
            "values": ["kube-system", "fractus-system"],
        }
        guard = {"spec": {"matchConstraints": {"namespaceSelector": {"matchExpressions": [exempt]}}}}
        self.objects: dict[str, Body] = {
            "/version": {"major": "1", "minor": "35+", "gitVersion": "v1.35.4"},
            OPERATOR: {"spec": {"replicas": 2}, "status": ready},
            f"/apis/coordination.k8s.io/v1{SYSTEM}/leases/fractus-operator": {"spec": {"holderIdentity": "operator-1"}},
            **{f"/apis/apps/v1{SYSTEM}/daemonsets/{name}": {"status": dict(counts)} for name in SERVICES},
            f"/api/v1{SYSTEM}/configmaps/fractus-ca": {"data": {"ca.crt": public}},
            GUARD: guard,
        }
        node = {
            "metadata": {"name": "drone-1", "labels": {"fractus.dev/class": "drone"}},
            "spec": taint,
            "status": fine,
        }
        cloud = {"metadata": {"name": "cloud-1", "labels": {"fractus.dev/class": "cloud"}}, "status": fine}
        self.lists: dict[str, list[Body]] = {
            CRDS: [copy.deepcopy(crd(kind)) | established for kind in KINDS],
            "/apis/admissionregistration.k8s.io/v1/validatingadmissionpolicies": [
                {"metadata": {"name": p}} for p in POLICIES
            ],
            BINDINGS: [
                {"metadata": {"name": p}, "spec": {"policyName": p, "validationActions": ["Deny"]}} for p in POLICIES
            ],
            "/api/v1/nodes": [node, cloud],
            "/apis/fractus.dev/v1alpha1/drones": [{"metadata": {"name": "drone-1"}, "status": fine}],
            "/apis/fractus.dev/v1alpha1/depots": [{"metadata": {"name": "base"}}],
        }

    def get(self, path: str) -> Body | None:
        return self.objects.get(path)

    def list(self, path: str, **selectors: str) -> Sequence[Body]:
        bodies = self.lists.get(path, [])
        selector = selectors.get("fieldSelector", "")
        if selector == "spec.hostNetwork=true":
            return [body for body in bodies if body["spec"].get("hostNetwork")]
        if "managed-by" in selectors.get("labelSelector", ""):
            return bodies
        if "labelSelector" in selectors:
            return [b for b in bodies if b["metadata"]["labels"].get("fractus.dev/class") in {"drone", "edge"}]
        name = selector.partition("involvedObject.name=")[2]
        return [body for body in bodies if not name or body["involvedObject"]["name"] == name]


def findings(cluster: Any) -> list[Finding]:
    return list(examine(cluster, NOW))


def test_doctor_reports_only_ok_for_healthy_cluster_objects() -> None:
    assert {finding.level for finding in findings(Cluster())} == {"ok"}


def pod(name: str, namespace: str, **spec: Any) -> Body:
    return {"metadata": {"name": name, "namespace": namespace, "labels": {}}, "spec": spec}


def unscheduled(cluster: Cluster) -> None:
    waiting = pod("fractus-operator-1", "fractus-system")
    waiting["metadata"]["labels"] = {"app.kubernetes.io/component": "operator"}
    message = "0/2 nodes are available: 1 node(s) had untolerated taint {node-role.kubernetes.io/control-plane: }"
    waiting["status"] = {"conditions": [{"type": "PodScheduled", "status": "False", "message": message}]}
    cluster.lists[PODS] = [waiting]


def refused_service(cluster: Cluster) -> None:
    cluster.objects[AGENT]["status"].update(currentNumberScheduled=0, numberReady=0)
    event = {"involvedObject": {"name": "fractus-agent"}, "lastTimestamp": "2026-06-01T00:00:00Z"}
    old = {"involvedObject": {"name": "fractus-agent"}, "lastTimestamp": None, "message": "long gone"}
    other = {"involvedObject": {"name": "other"}, "lastTimestamp": "2026-06-01T01:00:00Z", "message": "of another"}
    message = 'pods "fractus-agent-" is forbidden: violates PodSecurity "restricted:latest": host namespaces'
    cluster.lists[EVENTS] = [old, event | {"message": message}, other]


def refused_operator(cluster: Cluster) -> None:
    message = "exceeded quota: compute"
    failed = {"type": "ReplicaFailure", "status": "True", "reason": "FailedCreate", "message": message}
    cluster.objects[OPERATOR]["status"] = {"conditions": [failed]}


def foreign_pods(cluster: Cluster) -> None:
    everywhere: Body = {"hostNetwork": True, "tolerations": [{"operator": "Exists"}]}
    mirror = pod("static-drone-1", "mirrors", nodeName="drone-1", **everywhere)
    mirror["metadata"]["annotations"] = {"kubernetes.io/config.mirror": "5d8f"}
    other = {"tolerations": [{"key": "node.kubernetes.io/not-ready", "operator": "Exists"}]}
    cluster.lists["/api/v1/pods"] = [
        pod("kube-flannel-ds-x", "kube-flannel", nodeName="drone-1", **everywhere),
        pod("kube-proxy-x", "kube-system", nodeName="drone-1", **everywhere),
        pod("fractus-agent-x", "fractus-system", nodeName="drone-1", **everywhere),
        pod("elsewhere", "calico-system", nodeName="cloud-1", **everywhere),
        pod("own-network", "default", nodeName="drone-1"),
        pod("job-x", "ended", nodeName="drone-1", **everywhere) | {"status": {"phase": "Succeeded"}},
        pod("other-x", "intolerant", nodeName="drone-1", **everywhere | other),
        mirror,
    ]


def older_kinds(cluster: Cluster) -> None:
    (drone,) = (body for body in cluster.lists[CRDS] if body["metadata"]["name"] == "drones.fractus.dev")
    schema = drone["spec"]["versions"][0]["schema"]["openAPIV3Schema"]["properties"]
    del schema["spec"]["properties"]["interfaces"]["items"]["properties"]["range"]


def renamed_node(cluster: Cluster) -> None:
    cluster.lists["/apis/fractus.dev/v1alpha1/drones"].append({"metadata": {"name": "drone-0"}, "status": {}})


def ipv6_first(cluster: Cluster) -> None:
    kinds = (("Hostname", "drone-1"), ("InternalIP", "fd00::7"), ("InternalIP", "10.0.0.7"))
    addresses = [{"type": type_, "address": address} for type_, address in kinds]
    node = cluster.lists["/api/v1/nodes"][0]
    node["status"] = node["status"] | {"addresses": addresses}


def weakly_tainted(cluster: Cluster) -> None:
    """Replace the taint NoExecute by NoSchedule.

    A pod whose spec names the node bypasses NoSchedule, because the kubelet checks only NoExecute.
    """
    cluster.lists["/api/v1/nodes"][0]["spec"] = {"taints": [{"key": "fractus.dev/class", "effect": "NoSchedule"}]}


def audit_only_binding(cluster: Cluster) -> None:
    cluster.lists[BINDINGS][0]["spec"]["validationActions"] = ["Audit"]


def test_doctor_remedy_exempts_all_namespaces_with_foreign_pods() -> None:
    cluster = Cluster()
    foreign_pods(cluster)
    plugin = cluster.lists["/api/v1/pods"][0]
    cluster.lists["/api/v1/pods"].append(plugin | {"metadata": {"name": "cni", "namespace": "cilium"}})
    remedies = {finding.remedy for finding in findings(cluster) if finding.level != "ok"}
    assert len(remedies) == 1, (
        "one remedy covers all namespaces, because a second one would overwrite the setting of the first"
    )
    assert "exemptNamespaces={kube-system,cilium,kube-flannel}" in remedies.pop()


def test_doctor_ignores_failed_deletion_of_operator_pods() -> None:
    cluster = Cluster()
    failed = {"type": "ReplicaFailure", "status": "True", "reason": "FailedDelete", "message": "no"}
    cluster.objects[OPERATOR]["status"]["conditions"] = [failed]
    assert {finding.level for finding in findings(cluster)} == {"ok"}


def _with_gateway(cluster: Cluster) -> None:
    containers = [{"name": "mobility"}, {"name": "gateway"}]
    mobility = cluster.objects[f"/apis/apps/v1{SYSTEM}/daemonsets/fractus-mobility"]
    mobility["spec"] = {"template": {"spec": {"containers": containers}}}


def _program(cluster: Cluster) -> None:
    services = [{"service": "mobility", "interfaces": ["mavlink"], "methods": ["Arm", "GetControl"]}]
    component = {
        "name": "Program",
        "class": "driver",
        "placement": "drone",
        "services": services,
        "container": {"image": "x:1"},
    }
    component["controlPoints"] = [
        {"point": {"depot": "base"}, "navigation": "pathBased", "path": [{"lat": 1.0, "lon": 1.0, "alt": 10.0}]}
    ]
    application = {"apiVersion": "fractus.dev/v1alpha1", "kind": "Application", "spec": {"components": [component]}}
    cluster.lists["/apis/fractus.dev/v1alpha1/applications"] = [
        application | {"metadata": {"name": "survey", "namespace": "city"}}
    ]


def waiting_sidecar(cluster: Cluster) -> None:
    _with_gateway(cluster)
    _program(cluster)
    state = {"waiting": {"reason": "ErrImagePull", "message": "not found"}}
    program = pod("survey-program", "city")
    program["status"] = {"initContainerStatuses": [{"name": "fractus-mavlink", "ready": False, "state": state}]}
    ready = pod("other", "city")
    ready["status"] = {"initContainerStatuses": [{"name": "fractus-mavlink", "ready": True}]}
    cluster.lists["/api/v1/pods"] = [program, ready]


def failed_access(cluster: Cluster) -> None:
    _with_gateway(cluster)
    service = pod("fractus-mobility-x", "fractus-system", nodeName="drone-1")
    state = {"waiting": {"reason": "CrashLoopBackOff", "message": "back-off"}}
    service["status"] = {"initContainerStatuses": [{"name": "gateway-access", "state": state}]}
    cluster.lists[PODS] = [service]


def gateway_without_socket(cluster: Cluster) -> None:
    (drone,) = cluster.lists["/apis/fractus.dev/v1alpha1/drones"]
    condition = {
        "type": "MavlinkGateway",
        "status": "False",
        "reason": "NotServing",
        "message": "The mobility service does not offer the socket",
    }
    drone["status"] = {"conditions": [*drone["status"]["conditions"], condition]}


def test_doctor_accepts_gateway_with_ready_sidecars() -> None:
    cluster = Cluster()
    _with_gateway(cluster)
    _program(cluster)
    assert {finding.level for finding in findings(cluster)} == {"ok"}
    assert "gateway" in {finding.check for finding in findings(cluster)}


def no_certificate(cluster: Cluster) -> None:
    del cluster.objects[f"/api/v1{SYSTEM}/configmaps/fractus-ca"]


def empty_certificate(cluster: Cluster) -> None:
    cluster.objects[f"/api/v1{SYSTEM}/configmaps/fractus-ca"] = {"data": {}}


@pytest.mark.parametrize(
    ("break_cluster", "level", "check", "message", "remedy"),
    [
        (unscheduled, "error", "pods", "fractus-operator-1 is not scheduled: 0/2 nodes", "fractus.dev/cloud=true"),
        (refused_service, "error", "services", "violates PodSecurity", "pod-security.kubernetes.io/enforce=privileged"),
        (refused_operator, "error", "operator", "cannot be created: exceeded quota", "ResourceQuota"),
        (foreign_pods, "warning", "admission", "kube-flannel: pods in the host network", "exemptNamespaces={kube-system,kube-flannel}"),
        (older_kinds, "error", "kinds", "Drone has no spec.interfaces.range", "helm upgrade --install fractus-crds"),
        (renamed_node, "warning", "nodes", "drone drone-0 has no node", "kubectl delete drone drone-0"),
        (ipv6_first, "error", "nodes", "drone-1 has fd00::7 as first address", "--node-ip"),
        (weakly_tainted, "warning", "nodes", "drone-1 has no taint fractus.dev/class with the effect NoExecute", "=drone:NoExecute"),
        (_program, "warning", "gateway", "no gateway for the MAVLink programs of city/survey", "--set gateway.enabled=true"),
        (waiting_sidecar, "warning", "gateway", "city/survey-program: the sidecar fractus-mavlink is not ready: ErrImagePull: not found", "kubectl -n city logs survey-program -c fractus-mavlink"),
        (failed_access, "error", "pods", "fractus-mobility-x on drone-1: CrashLoopBackOff", "logs fractus-mobility-x"),
        (gateway_without_socket, "warning", "hardware", "drone-1: MavlinkGateway: NotServing: The mobility service does not offer the socket", "kubectl describe drone drone-1"),
        (no_certificate, "error", "certificates", "the ConfigMap fractus-ca, from which nodes read", "logs deployment/fractus-operator"),
        (empty_certificate, "error", "certificates", "of the authority, has no ca.crt", "restores it within 10 s"),
        (audit_only_binding, "error", "admission", f"{POLICIES[0]}: not in force", "helm upgrade --install fractus "),
    ],
)  # fmt: skip
def test_doctor_finds_problem_and_prints_remedy(
    break_cluster: Callable[[Cluster], None], level: str, check: str, message: str, remedy: str
) -> None:
    cluster = Cluster()
    break_cluster(cluster)
    problems = [finding for finding in findings(cluster) if finding.level != "ok"]
    assert [(f.level, f.check) for f in problems] == [(level, check)]
    assert message in problems[0].message
    assert remedy in problems[0].remedy
