"""`fractus doctor`: find problems of a cluster and print their remedies."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from typing import Literal, TypeVar

import click
from cryptography import x509
from fractus_core import plausibility
from fractus_core.api import KINDS, Application, Depot, EdgeNode, InvalidObject, Policy, Resource, Zone
from fractus_core.api.crd import crd
from fractus_core.api.names import CLASS_LABEL as CLASS
from fractus_core.api.names import CLOUD_LABEL

from fractus_cli.cluster_reader import (
    EXIT_PROBLEM,
    GROUP,
    SYSTEM,
    Body,
    ClusterReader,
    conditions_of,
    kubeconfig_option,
    open_cluster,
)
from fractus_cli.output import output_option, printable

R = TypeVar("R", bound=Resource)

MIN_VERSION = (1, 32)
"""Minimum Kubernetes version that the charts require."""
SERVICES = ("fractus-agent", "fractus-mobility", "fractus-camera")
POLICIES = (
    "fractus-agent",
    "fractus-agent-kind",
    "fractus-agent-token",
    "fractus-drone-names",
    "fractus-edge-names",
    "fractus-pods",
    "fractus-pod-nodes",
    "fractus-operator",
    "fractus-operator-nodes",
    "fractus-operator-slices",
    "fractus-flight-pods",
    "fractus-flight-pod-status",
    "fractus-flight-nodes",
    "fractus-flight-system",
    "fractus-flight-node-status",
    "fractus-flight-kinds",
    "fractus-flight-priority",
    "fractus-flight-reservation",
    "fractus-flight-applications",
    "fractus-template-approval",
)
SIDECAR = "fractus-mavlink"
"""Container of the operator that connects a MAVLink program to the gateway of its drone."""
EXPIRY = timedelta(days=30)
_LISTED = 5
_HELM = f"helm upgrade --install fractus charts/fractus -n {SYSTEM}"
_APPS = f"/apis/apps/v1/namespaces/{SYSTEM}"
_CRDS = f"helm upgrade --install fractus-crds charts/fractus-crds -n {SYSTEM} --create-namespace"
_ADMISSION = "/apis/admissionregistration.k8s.io/v1"


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of a check.

    Attributes:
        level: `ok`, `warning` (Fractus works with restrictions) or `error` (Fractus does not work).
        check: Name of the check.
        message: One sentence.
        remedy: Command or action that fixes the problem. Empty if there is no problem.
    """

    level: Literal["ok", "warning", "error"]
    check: str
    message: str
    remedy: str = ""


@click.command()
@output_option
@kubeconfig_option
def doctor(output: str, config: str | None) -> int:
    """Check version, CRDs, charts, images, nodes and certificates of a cluster, and print a remedy for each problem.

    The exit code is 2 if there is an error, which prevents Fractus from working.
    """
    with open_cluster(config) as cluster:
        findings = list(examine(cluster, datetime.now(UTC)))
    if output == "json":
        click.echo(json.dumps([asdict(finding) for finding in findings]))
    else:
        for finding in findings:
            click.echo(printable(f"{finding.level:8} {finding.check}: {finding.message}"))
            if finding.remedy:
                click.echo(printable(f"         {finding.remedy}"))
    return EXIT_PROBLEM if any(finding.level == "error" for finding in findings) else 0


def examine(cluster: ClusterReader, now: datetime) -> Iterator[Finding]:
    """Run all checks on a cluster, in the order in which problems must be fixed.

    Raises:
        KubeError: The API server rejected a request or is unreachable.
    """
    yield from _version(cluster.get("/version") or {})
    yield from _kinds(cluster)
    yield from _operator(cluster)
    yield from _services(cluster)
    yield from _admission(cluster)
    yield from _foreign_pods(cluster)
    yield from _pods(cluster.list(f"/api/v1/namespaces/{SYSTEM}/pods"))
    yield from _gateway(cluster)
    yield from _authority(cluster.get(f"/api/v1/namespaces/{SYSTEM}/configmaps/fractus-ca"), now)
    yield from _nodes(cluster)
    yield from _policies(cluster)


def _version(version: Body) -> Iterator[Finding]:
    numbers = (int(re.sub(r"\D.*", "", str(version.get(part) or "0")) or 0) for part in ("major", "minor"))
    if tuple(numbers) < MIN_VERSION:
        required = ".".join(map(str, MIN_VERSION))
        message = f"{version.get('gitVersion')} does not support selectable CRD fields and node names in tokens"
        yield Finding("error", "version", message, f"upgrade Kubernetes to {required} or newer")
    else:
        yield Finding("ok", "version", f"Kubernetes {version.get('gitVersion')}")


def _kinds(cluster: ClusterReader) -> Iterator[Finding]:
    bodies = cluster.list("/apis/apiextensions.k8s.io/v1/customresourcedefinitions")
    established = {
        body["metadata"]["name"]: conditions_of(body).get("Established", {}).get("status") for body in bodies
    }
    missing = [f"{k.PLURAL}.fractus.dev" for k in KINDS if established.get(f"{k.PLURAL}.fractus.dev") != "True"]
    if missing:
        yield Finding("error", "kinds", f"{', '.join(missing)}: not installed", _CRDS)
    schemas = {body["metadata"]["name"]: _schema(body) for body in bodies}
    missing_fields = [
        f"{kind.KIND} has no {field}"
        for kind in KINDS
        if f"{kind.PLURAL}.fractus.dev" not in missing
        for field in _missing_fields(_schema(crd(kind)), schemas[f"{kind.PLURAL}.fractus.dev"])
    ]
    if missing_fields:
        more = f" and {len(missing_fields) - _LISTED} more" if len(missing_fields) > _LISTED else ""
        yield Finding("error", "kinds", f"CRDs of another release: {', '.join(missing_fields[:_LISTED])}{more}", _CRDS)
    elif not missing:
        yield Finding("ok", "kinds", f"all {len(KINDS)} kinds are installed")


def _schema(definition: Body) -> Body:
    """Return the schema of the served version of a kind."""
    version: Body = next((v for v in definition["spec"]["versions"] if v.get("served")), {})
    schema: Body = (version.get("schema") or {}).get("openAPIV3Schema") or {}
    return schema


def _missing_fields(expected: Body, installed: Body, prefix: str = "") -> Iterator[str]:
    """Yield the fields that are missing in the installed schema. The API server drops the values of missing fields."""
    for name, field in (expected.get("properties") or {}).items():
        installed_field = (installed.get("properties") or {}).get(name)
        if installed_field is None:
            yield f"{prefix}{name}"
        else:
            yield from _missing_fields(field, installed_field, f"{prefix}{name}.")
    if isinstance(expected.get("items"), dict):
        yield from _missing_fields(expected["items"], installed.get("items") or {}, prefix)


def _operator(cluster: ClusterReader) -> Iterator[Finding]:
    deployment = cluster.get(f"{_APPS}/deployments/fractus-operator")
    if deployment is None:
        yield Finding("error", "operator", "chart fractus is not installed", _HELM)
        return
    ready = (deployment.get("status") or {}).get("readyReplicas", 0)
    desired = deployment["spec"].get("replicas", 1)
    lease = cluster.get(f"/apis/coordination.k8s.io/v1/namespaces/{SYSTEM}/leases/fractus-operator") or {}
    leader = (lease.get("spec") or {}).get("holderIdentity")
    logs = f"kubectl -n {SYSTEM} logs deployment/fractus-operator"
    failed = conditions_of(deployment).get("ReplicaFailure", {})
    if failed.get("status") == "True" and failed.get("reason") == "FailedCreate":
        yield Finding("error", "operator", f"pods cannot be created: {failed.get('message')}", _creation_remedy(failed))
    elif not ready or not leader:
        yield Finding("error", "operator", f"{ready} of {desired} ready, leader: {leader or 'none'}", logs)
    elif ready < desired:
        yield Finding("warning", "operator", f"{ready} of {desired} ready, leader: {leader}", logs)
    else:
        yield Finding("ok", "operator", f"{ready} of {desired} ready, leader: {leader}")


def _services(cluster: ClusterReader) -> Iterator[Finding]:
    for name in SERVICES:
        body = cluster.get(f"{_APPS}/daemonsets/{name}")
        if body is None:
            yield Finding(
                "warning", "services", f"{name} is not installed", f"{_HELM} (with the values that enable it)"
            )
            continue
        status = body.get("status") or {}
        ready = status.get("numberReady", 0)
        desired = status.get("desiredNumberScheduled", 0)
        if status.get("currentNumberScheduled", 0) < desired:
            failed = _creation_failure(cluster, name)
            message = f"pods of {name} cannot be created: {failed.get('message', 'reason unknown')}"
            yield Finding("error", "services", message, _creation_remedy(failed))
        elif ready < desired:
            remedy = f"kubectl -n {SYSTEM} describe pods -l app.kubernetes.io/component={name.removeprefix('fractus-')}"
            yield Finding("warning", "services", f"{name} is ready on {ready} of {desired} nodes", remedy)
        else:
            yield Finding("ok", "services", f"{name} is ready on all {desired} nodes")


def _creation_failure(cluster: ClusterReader, daemon_set: str) -> Body:
    """Return the latest FailedCreate event of a DaemonSet, or an empty object."""
    selector = f"reason=FailedCreate,involvedObject.kind=DaemonSet,involvedObject.name={daemon_set}"
    events = cluster.list(f"/api/v1/namespaces/{SYSTEM}/events", fieldSelector=selector)
    return max(events, key=lambda event: str(event.get("lastTimestamp") or ""), default={})


def _creation_remedy(failed: Body) -> str:
    """Return the remedy for pods of Fractus that the API server rejects."""
    if "PodSecurity" in str(failed.get("message")):
        return f"kubectl label namespace {SYSTEM} pod-security.kubernetes.io/enforce=privileged --overwrite"
    return f"kubectl -n {SYSTEM} get events --field-selector reason=FailedCreate; also check its ResourceQuota and LimitRange"


def _admission(cluster: ClusterReader) -> Iterator[Finding]:
    policies = cluster.list(f"{_ADMISSION}/validatingadmissionpolicies")
    bindings = cluster.list(f"{_ADMISSION}/validatingadmissionpolicybindings")
    denied = {b["spec"]["policyName"] for b in bindings if "Deny" in (b["spec"].get("validationActions") or ())}
    missing = set(POLICIES) - denied.intersection(body["metadata"]["name"] for body in policies)
    if missing:
        yield Finding("error", "admission", f"{', '.join(sorted(missing))}: not in force", _HELM)
    else:
        yield Finding("ok", "admission", f"all {len(POLICIES)} policies are in force")


def _foreign_pods(cluster: ClusterReader) -> Iterator[Finding]:
    """Find running pods, for example of a network plugin, that the admission policies will reject when the pods are recreated."""
    policy = cluster.get(f"{_ADMISSION}/validatingadmissionpolicies/fractus-pods") or {}
    selector = ((policy.get("spec") or {}).get("matchConstraints") or {}).get("namespaceSelector") or {}
    exempt = [name for e in selector.get("matchExpressions") or () for name in e.get("values") or ()]
    nodes = cluster.list("/api/v1/nodes", labelSelector=f"{CLASS} in (drone, edge)")
    protected = {node["metadata"]["name"] for node in nodes}
    pods = cluster.list("/api/v1/pods", fieldSelector="spec.hostNetwork=true") if exempt and protected else ()
    examples = {
        pod["metadata"]["namespace"]: f"{pod['metadata']['name']} on {pod['spec']['nodeName']}"
        for pod in pods
        if pod["spec"].get("nodeName") in protected
        and pod["metadata"]["namespace"] not in exempt
        and _is_subject_to_policy(pod)
    }
    # A new value of `exemptNamespaces` replaces the previous value, so each remedy lists all namespaces.
    listed = ",".join(n for n in (*exempt, *sorted(examples)) if n != SYSTEM)
    remedy = f"if they belong to the cluster: {_HELM} --reuse-values --set 'admission.exemptNamespaces={{{listed}}}'"
    for namespace, name in sorted(examples.items()):
        message = f"{namespace}: pods in the host network, such as {name}, will be rejected when they are recreated"
        yield Finding("warning", "admission", message, remedy)


def _is_subject_to_policy(pod: Body) -> bool:
    """Return True if the admission policy `fractus-pods` will apply to a pod when it is recreated.

    The policy applies to pods that tolerate the taint of drones and edge nodes, except mirror pods. Pods that have
    ended are not recreated.
    """
    ended = (pod.get("status") or {}).get("phase") in {"Succeeded", "Failed"}
    mirror = "kubernetes.io/config.mirror" in (pod["metadata"].get("annotations") or {})
    tolerates = any(t.get("key", "") in {"", CLASS} for t in pod["spec"].get("tolerations") or ())
    return tolerates and not ended and not mirror


def _pods(pods: Sequence[Body]) -> Iterator[Finding]:
    for pod in pods:
        scheduled = conditions_of(pod).get("PodScheduled", {})
        if scheduled.get("status") == "False":
            message = f"{pod['metadata']['name']} is not scheduled: {scheduled.get('message', '')}".rstrip(": ")
            yield Finding("error", "pods", message, _scheduling_remedy(pod))
        name = pod["metadata"]["name"]
        node = (pod.get("spec") or {}).get("nodeName", "no node")
        status = pod.get("status") or {}
        for container in (*(status.get("initContainerStatuses") or ()), *(status.get("containerStatuses") or ())):
            waiting = (container.get("state") or {}).get("waiting")
            if waiting is None or waiting.get("reason") in {"ContainerCreating", "PodInitializing"}:
                continue
            reason = waiting.get("reason", "")
            message = f"{name} on {node}: {reason}: {waiting.get('message', '')}".rstrip(": ")
            if "Image" in reason:
                remedy = "check image.registry, image.tag and imagePullSecrets of the chart"
                yield Finding("error", "images", message, remedy)
            else:
                yield Finding("error", "pods", message, f"kubectl -n {SYSTEM} logs {name} --previous")


def _scheduling_remedy(pod: Body) -> str:
    """Return the remedy for a pod that cannot be scheduled."""
    if (pod["metadata"].get("labels") or {}).get("app.kubernetes.io/component") not in {
        "operator",
        "view",
        "management",
    }:
        return f"kubectl -n {SYSTEM} describe pod {pod['metadata']['name']}"
    return (
        f"add a node that is neither a drone nor an edge node, or label a node {CLOUD_LABEL}=true; if that node has taints, set"
        " operator.tolerations of the chart"
    )


def _gateway(cluster: ClusterReader) -> Iterator[Finding]:
    """Check the gateway for MAVLink programs and the sidecars of their pods."""
    body = cluster.get(f"{_APPS}/daemonsets/fractus-mobility") or {}
    template = ((body.get("spec") or {}).get("template") or {}).get("spec") or {}
    installed = any(container.get("name") == "gateway" for container in template.get("containers") or ())
    programs = [
        f"{application.metadata.namespace}/{application.name}"
        for application in _valid(cluster, Application)
        if any(component.uses_mavlink for component in application.spec.components)
    ]
    if programs and not installed:
        listed = ", ".join(sorted(programs)[:_LISTED])
        remedy = f"{_HELM} --reuse-values --set gateway.enabled=true"
        yield Finding("warning", "gateway", f"no gateway for the MAVLink programs of {listed}", remedy)
    if not installed:
        return
    waiting = list(_waiting_sidecars(cluster))
    yield from waiting
    if not waiting:
        yield Finding("ok", "gateway", "installed, and the sidecars of all MAVLink programs are ready")


def _waiting_sidecars(cluster: ClusterReader) -> Iterator[Finding]:
    for pod in cluster.list("/api/v1/pods", labelSelector="app.kubernetes.io/managed-by=fractus"):
        status = pod.get("status") or {}
        if status.get("phase") in {"Succeeded", "Failed"} or "deletionTimestamp" in pod["metadata"]:
            continue
        for container in status.get("initContainerStatuses") or ():
            if container.get("name") != SIDECAR or container.get("ready"):
                continue
            name = pod["metadata"]["name"]
            namespace = pod["metadata"]["namespace"]
            state = (container.get("state") or {}).get("waiting") or {}
            reason = ": ".join(filter(None, (state.get("reason"), state.get("message"))))
            message = f"{namespace}/{name}: the sidecar {SIDECAR} is not ready" + (f": {reason}" if reason else "")
            yield Finding("warning", "gateway", message, f"kubectl -n {namespace} logs {name} -c {SIDECAR}")


def _authority(config_map: Body | None, now: datetime) -> Iterator[Finding]:
    text = ((config_map or {}).get("data") or {}).get("ca.crt", "")
    if not text:
        state = "does not exist" if config_map is None else "has no ca.crt"
        remedy = (
            "a running operator restores it within 10 s; see the result of the check `operator`, and"
            f" kubectl -n {SYSTEM} logs deployment/fractus-operator"
        )
        message = f"the ConfigMap fractus-ca, from which nodes read the certificate of the authority, {state}"
        yield Finding("error", "certificates", message, remedy)
        return
    try:
        ends = min(c.not_valid_after_utc for c in x509.load_pem_x509_certificates(text.encode()))
    except ValueError as error:
        remedy = f"kubectl -n {SYSTEM} get configmap fractus-ca -o yaml"
        yield Finding("error", "certificates", f"invalid certificate authority: {error}", remedy)
        return
    if ends - now < EXPIRY:
        level: Literal["warning", "error"] = "error" if ends < now else "warning"
        remedy = "delete the Secret fractus-ca while no drone flies; the operator creates a new certificate authority"
        yield Finding(level, "certificates", f"the certificate authority expires at {ends:%Y-%m-%d}", remedy)
    else:
        yield Finding("ok", "certificates", f"the certificate authority is valid until {ends:%Y-%m-%d}")


def _nodes(cluster: ClusterReader) -> Iterator[Finding]:
    described = {
        "drone": {body["metadata"]["name"]: body for body in cluster.list(f"{GROUP}/drones")},
        "edge": {body["metadata"]["name"]: body for body in cluster.list(f"{GROUP}/edgenodes")},
    }
    classes: set[str] = set()
    nodes = cluster.list("/api/v1/nodes")
    names = {node["metadata"]["name"] for node in nodes}
    for node_class, bodies in described.items():
        for name in sorted(set(bodies) - names):
            kind = "drone" if node_class == "drone" else "edgenode"
            message = f"{kind} {name} has no node: the node was renamed or removed"
            yield Finding("warning", "nodes", message, f"if the node does not return: kubectl delete {kind} {name}")
    for name in sorted(described["drone"].keys() & described["edge"].keys()):
        message = f"{name} is the name of a Drone and of an EdgeNode, but a node is either a drone or an edge node"
        yield Finding("error", "nodes", message, f"kubectl delete drone {name} (or edgenode {name})")
    for node in nodes:
        name = node["metadata"]["name"]
        labels = node["metadata"].get("labels") or {}
        node_class = labels.get(CLASS, "")
        classes |= {node_class, "cloud"} if labels.get(CLOUD_LABEL) == "true" else {node_class}
        if node_class not in {"", "drone", "edge", "cloud"}:
            remedy = f"kubectl label node {name} {CLASS}=drone --overwrite (or edge, or cloud)"
            yield Finding("error", "nodes", f"{name}: unknown node class {node_class}", remedy)
        elif node_class in described:
            yield from _node(node, node_class, described[node_class].get(name))
    for node_class in ("drone", "cloud"):
        if node_class not in classes:
            remedy = f"kubectl label node NODE {CLASS}={node_class}"
            level: Literal["warning", "error"] = "error" if node_class == "drone" else "warning"
            yield Finding(level, "nodes", f"no node has the label {CLASS}={node_class}", remedy)


def _node(node: Body, node_class: str, body: Body | None) -> Iterator[Finding]:
    """Check one drone or edge node."""
    name = node["metadata"]["name"]
    findings: list[Finding] = []
    if conditions_of(node).get("Ready", {}).get("status") != "True":
        findings.append(
            Finding("warning", "nodes", f"{name} is not ready", "check its power, network link and kubelet")
        )
    addresses = (node.get("status") or {}).get("addresses") or ()
    address = next((str(a.get("address")) for a in addresses if a.get("type") == "InternalIP"), "")
    if ":" in address:
        message = f"{name} has {address} as first address, but its services listen on IPv4"
        findings.append(
            Finding("error", "nodes", message, "give the node an IPv4 address first (--node-ip of its kubelet)")
        )
    effects = {t["effect"] for t in (node.get("spec") or {}).get("taints") or () if t["key"] == CLASS}
    if (node["metadata"].get("labels") or {}).get(CLOUD_LABEL) == "true":
        if effects:
            message = f"{name} has the label {CLOUD_LABEL}, but its taint {CLASS} keeps cloud pods away"
            findings.append(Finding("warning", "nodes", message, f"kubectl taint node {name} {CLASS}-"))
        elif node_class == "drone":
            message = f"{name} is also a cloud node: any pod on it can reach the autopilot"
            findings.append(
                Finding("warning", "nodes", message, "use a separate cloud node, except for a simulated drone")
            )
    elif "NoExecute" not in effects:
        remedy = f"kubectl taint node {name} {CLASS}={node_class}:NoExecute"
        message = (
            f"{name} has no taint {CLASS} with the effect NoExecute: other pods may run on it, also in the host network"
        )
        findings.append(Finding("warning", "nodes", message, remedy))
    if body is None:
        kind = "Drone" if node_class == "drone" else "EdgeNode"
        remedy = f"store its description on the node as /etc/fractus/node.yaml, and check the log of its agent (kubectl -n {SYSTEM} logs)"
        findings.append(Finding("error", "nodes", f"{name} has no {kind}: its agent has not registered it", remedy))
    else:
        for type_, condition in sorted(conditions_of(body).items()):
            # ServicesCurrent is False while services wait for a landing, and OnMission without a mission. Neither is a problem.
            if condition["status"] != "True" and type_ not in {"ServicesCurrent", "OnMission"}:
                message = f"{name}: {type_}: {condition['reason']}: {condition.get('message', '')}".rstrip(": ")
                remedy = f"kubectl describe {'drone' if node_class == 'drone' else 'edgenode'} {name}"
                findings.append(Finding("error" if type_ == "Ready" else "warning", "hardware", message, remedy))
    yield from findings or [Finding("ok", "nodes", f"{name} is a {node_class} node, registered and ready")]


def _policies(cluster: ClusterReader) -> Iterator[Finding]:
    for plural in ("zones", "policies"):
        for body in cluster.list(f"{GROUP}/{plural}"):
            ready = conditions_of(body).get("Ready", {})
            if ready.get("status") == "False":
                name = f"{plural}/{body['metadata']['name']}"
                yield Finding(
                    "error", "policies", f"{name}: {ready.get('message')}", f"correct it: kubectl edit {name}"
                )
    notes = plausibility.notes(
        depots=list(_valid(cluster, Depot)),
        zones=list(_valid(cluster, Zone)),
        edge_nodes=_valid(cluster, EdgeNode),
        policies=_valid(cluster, Policy),
        applications=list(_valid(cluster, Application)),
    )
    for note in notes:
        yield Finding("warning", "policies", note, "correct the object if this is a mistake")
    if not cluster.list(f"{GROUP}/depots"):
        yield Finding("warning", "depots", "there is no Depot", "apply a Depot, the base of drones (see examples)")


def _valid(cluster: ClusterReader, kind: type[R]) -> Iterator[R]:
    """Yield the valid objects of a kind. Another finding reports the invalid ones."""
    for body in cluster.list(f"{GROUP}/{kind.PLURAL}"):
        with contextlib.suppress(InvalidObject):
            yield kind.from_body(body)
