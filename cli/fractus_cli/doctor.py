"""`fractus doctor`: what a cluster lacks to fly, and how to fix it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from typing import Literal

import click
from cryptography import x509
from fractus_core.api import KINDS
from fractus_core.api.crd import crd
from fractus_core.api.names import CLASS_LABEL as CLASS
from fractus_core.api.names import CLOUD_LABEL

from fractus_cli.output import output_option, printable
from fractus_cli.reading import (
    EXIT_PROBLEM,
    GROUP,
    SYSTEM,
    Body,
    Cluster,
    cluster,
    conditions_of,
    kubeconfig_option,
)

MIN_VERSION = (1, 32)
"""The oldest Kubernetes that the charts take."""
SERVICES = ("fractus-agent", "fractus-mobility", "fractus-camera")
POLICIES = (
    "fractus-agent",
    "fractus-agent-kind",
    "fractus-agent-token",
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
)
EXPIRY = timedelta(days=30)
_LISTED = 5
_HELM = f"helm upgrade --install fractus charts/fractus -n {SYSTEM}"
_APPS = f"/apis/apps/v1/namespaces/{SYSTEM}"
_CRDS = f"helm upgrade --install fractus-crds charts/fractus-crds -n {SYSTEM} --create-namespace"
_ADMISSION = "/apis/admissionregistration.k8s.io/v1"


@dataclass(frozen=True, slots=True)
class Finding:
    """What was found of one thing.

    Attributes:
        level: error: Fractus does not work without it; warning: it works, but not as it should.
        check: which check found it.
        message: one sentence.
        remedy: what to do; empty where nothing is wrong.
    """

    level: Literal["ok", "warning", "error"]
    check: str
    message: str
    remedy: str = ""


@click.command()
@output_option
@kubeconfig_option
def doctor(output: str, config: str | None) -> int:
    """Check a cluster: its version, kinds, charts, images, nodes and certificates; say what is missing and how to fix it.

    Exits with 2 where something is missing that Fractus does not work without.
    """
    with cluster(config) as found:
        findings = list(examine(found, datetime.now(UTC)))
    if output == "json":
        click.echo(json.dumps([asdict(finding) for finding in findings]))
    else:
        for finding in findings:
            click.echo(printable(f"{finding.level:8} {finding.check}: {finding.message}"))
            if finding.remedy:
                click.echo(printable(f"         {finding.remedy}"))
    return EXIT_PROBLEM if any(finding.level == "error" for finding in findings) else 0


def examine(found: Cluster, now: datetime) -> Iterator[Finding]:
    """All findings of a cluster, in the order in which they are to be fixed.

    Raises:
        KubeError: the API server refused something, or could not be reached.
    """
    checks: Sequence[Callable[[], Iterator[Finding]]] = (
        lambda: _version(found.get("/version") or {}),
        lambda: _kinds(found),
        lambda: _operator(found),
        lambda: _services(found),
        lambda: _admission(found),
        lambda: _strangers(found),
        lambda: _pods(found.list(f"/api/v1/namespaces/{SYSTEM}/pods")),
        lambda: _authority(found.get(f"/api/v1/namespaces/{SYSTEM}/configmaps/fractus-ca"), now),
        lambda: _nodes(found),
        lambda: _rules(found),
    )
    for check in checks:
        yield from check()


def _version(version: Body) -> Iterator[Finding]:
    numbers = (int(re.sub(r"\D.*", "", str(version.get(part) or "0")) or 0) for part in ("major", "minor"))
    if tuple(numbers) < MIN_VERSION:
        needed = ".".join(map(str, MIN_VERSION))
        message = f"{version.get('gitVersion')} lacks selectable fields of kinds and node names in tokens"
        yield Finding("error", "version", message, f"upgrade Kubernetes to {needed} or newer")
    else:
        yield Finding("ok", "version", f"Kubernetes {version.get('gitVersion')}")


def _kinds(found: Cluster) -> Iterator[Finding]:
    bodies = found.list("/apis/apiextensions.k8s.io/v1/customresourcedefinitions")
    known = {body["metadata"]["name"]: conditions_of(body).get("Established", {}).get("status") for body in bodies}
    missing = [f"{k.PLURAL}.fractus.dev" for k in KINDS if known.get(f"{k.PLURAL}.fractus.dev") != "True"]
    if missing:
        yield Finding("error", "kinds", f"{', '.join(missing)}: not there", _CRDS)
    schemas = {body["metadata"]["name"]: _schema(body) for body in bodies}
    lacking = [
        f"{kind.KIND} has no {field}"
        for kind in KINDS
        if f"{kind.PLURAL}.fractus.dev" not in missing
        for field in _lacking(_schema(crd(kind)), schemas[f"{kind.PLURAL}.fractus.dev"])
    ]
    if lacking:
        more = f" and {len(lacking) - _LISTED} more" if len(lacking) > _LISTED else ""
        yield Finding("error", "kinds", f"of another release: {', '.join(lacking[:_LISTED])}{more}", _CRDS)
    elif not missing:
        yield Finding("ok", "kinds", f"all {len(KINDS)} are there")


def _schema(definition: Body) -> Body:
    """What the served version of a kind consists of."""
    version: Body = next((v for v in definition["spec"]["versions"] if v.get("served")), {})
    found: Body = (version.get("schema") or {}).get("openAPIV3Schema") or {}
    return found


def _lacking(ours: Body, theirs: Body, above: str = "") -> Iterator[str]:
    """The fields of a schema that another one does not have: the API server would drop them."""
    for name, field in (ours.get("properties") or {}).items():
        known = (theirs.get("properties") or {}).get(name)
        if known is None:
            yield f"{above}{name}"
        else:
            yield from _lacking(field, known, f"{above}{name}.")
    if isinstance(ours.get("items"), dict):
        yield from _lacking(ours["items"], theirs.get("items") or {}, above)


def _operator(found: Cluster) -> Iterator[Finding]:
    deployment = found.get(f"{_APPS}/deployments/fractus-operator")
    if deployment is None:
        yield Finding("error", "operator", "the chart fractus is not installed", _HELM)
        return
    ready, wanted = (deployment.get("status") or {}).get("readyReplicas", 0), deployment["spec"].get("replicas", 1)
    lease = found.get(f"/apis/coordination.k8s.io/v1/namespaces/{SYSTEM}/leases/fractus-operator") or {}
    leader = (lease.get("spec") or {}).get("holderIdentity")
    logs = f"kubectl -n {SYSTEM} logs deployment/fractus-operator"
    failed = conditions_of(deployment).get("ReplicaFailure", {})
    if failed.get("status") == "True" and failed.get("reason") == "FailedCreate":
        yield Finding("error", "operator", f"its pods cannot be made: {failed.get('message')}", _cure(failed))
    elif not ready or not leader:
        yield Finding("error", "operator", f"{ready} of {wanted} ready, leader: {leader or 'none'}", logs)
    elif ready < wanted:
        yield Finding("warning", "operator", f"{ready} of {wanted} ready, {leader} leads", logs)
    else:
        yield Finding("ok", "operator", f"{ready} of {wanted} ready, {leader} leads")


def _services(found: Cluster) -> Iterator[Finding]:
    for name in SERVICES:
        body = found.get(f"{_APPS}/daemonsets/{name}")
        if body is None:
            yield Finding("warning", "services", f"{name} is not installed", f"{_HELM} (its values enable it)")
            continue
        status = body.get("status") or {}
        ready, wanted = status.get("numberReady", 0), status.get("desiredNumberScheduled", 0)
        if status.get("currentNumberScheduled", 0) < wanted:
            failed = _not_made(found, name)
            message = f"pods of {name} cannot be made: {failed.get('message', 'nothing says why')}"
            yield Finding("error", "services", message, _cure(failed))
        elif ready < wanted:
            remedy = f"kubectl -n {SYSTEM} describe pods -l app.kubernetes.io/component={name.removeprefix('fractus-')}"
            yield Finding("warning", "services", f"{name} is ready on {ready} of {wanted} nodes", remedy)
        else:
            yield Finding("ok", "services", f"{name} is ready on all {wanted} nodes")


def _not_made(found: Cluster, daemon_set: str) -> Body:
    """The last event that says why a DaemonSet's pods are not made; empty where none does."""
    selector = f"reason=FailedCreate,involvedObject.kind=DaemonSet,involvedObject.name={daemon_set}"
    events = found.list(f"/api/v1/namespaces/{SYSTEM}/events", fieldSelector=selector)
    return max(events, key=lambda event: str(event.get("lastTimestamp") or ""), default={})


def _cure(failed: Body) -> str:
    """What to do where the API server refuses pods of the system."""
    if "PodSecurity" in str(failed.get("message")):
        return f"kubectl label namespace {SYSTEM} pod-security.kubernetes.io/enforce=privileged --overwrite"
    return f"kubectl -n {SYSTEM} get events --field-selector reason=FailedCreate; see its ResourceQuota and LimitRange, too"


def _admission(found: Cluster) -> Iterator[Finding]:
    policies = found.list(f"{_ADMISSION}/validatingadmissionpolicies")
    bindings = found.list(f"{_ADMISSION}/validatingadmissionpolicybindings")
    denied = {b["spec"]["policyName"] for b in bindings if "Deny" in (b["spec"].get("validationActions") or ())}
    missing = set(POLICIES) - denied.intersection(body["metadata"]["name"] for body in policies)
    if missing:
        yield Finding("error", "admission", f"{', '.join(sorted(missing))}: not in force", _HELM)
    else:
        yield Finding("ok", "admission", f"all {len(POLICIES)} policies are in force")


def _strangers(found: Cluster) -> Iterator[Finding]:
    """Pods such as those of a network plugin, that were there before the policies that keep them off drones and edge nodes."""
    judged = found.get(f"{_ADMISSION}/validatingadmissionpolicies/fractus-pods") or {}
    selector = ((judged.get("spec") or {}).get("matchConstraints") or {}).get("namespaceSelector") or {}
    exempt = [name for e in selector.get("matchExpressions") or () for name in e.get("values") or ()]
    nodes = found.list("/api/v1/nodes", labelSelector=f"{CLASS} in (drone, edge)")
    guarded = {node["metadata"]["name"] for node in nodes}
    pods = found.list("/api/v1/pods", fieldSelector="spec.hostNetwork=true") if exempt and guarded else ()
    refused = {
        pod["metadata"]["namespace"]: f"{pod['metadata']['name']} on {pod['spec']['nodeName']}"
        for pod in pods
        if pod["spec"].get("nodeName") in guarded and pod["metadata"]["namespace"] not in exempt and _is_judged(pod)
    }
    # The value replaces the one before: each remedy is that for all.
    listed = ",".join(n for n in (*exempt, *sorted(refused)) if n != SYSTEM)
    remedy = f"where they are the cluster's own: {_HELM} --reuse-values --set 'admission.exemptNamespaces={{{listed}}}'"
    for namespace, name in sorted(refused.items()):
        message = f"{namespace}: pods in the node's network, such as {name}, are refused when they are made again"
        yield Finding("warning", "admission", message, remedy)


def _is_judged(pod: Body) -> bool:
    """Whether the policy `fractus-pods` judges such a pod when it is made again: one that tolerates the taint, by no kubelet."""
    ended = (pod.get("status") or {}).get("phase") in {"Succeeded", "Failed"}
    mirror = "kubernetes.io/config.mirror" in (pod["metadata"].get("annotations") or {})
    tolerates = any(t.get("key", "") in {"", CLASS} for t in pod["spec"].get("tolerations") or ())
    return tolerates and not ended and not mirror


def _pods(pods: Sequence[Body]) -> Iterator[Finding]:
    for pod in pods:
        scheduled = conditions_of(pod).get("PodScheduled", {})
        if scheduled.get("status") == "False":
            message = f"{pod['metadata']['name']} has no node: {scheduled.get('message', '')}".rstrip(": ")
            yield Finding("error", "pods", message, _places(pod))
        name, containers = pod["metadata"]["name"], (pod.get("status") or {}).get("containerStatuses") or ()
        waiting = [c["state"]["waiting"] for c in containers if "waiting" in (c.get("state") or {})]
        for why in waiting:
            reason = why.get("reason", "")
            image = "Image" in reason
            remedy = "check image.registry, image.tag and imagePullSecrets of the chart" if image else ""
            remedy = remedy or f"kubectl -n {SYSTEM} logs {name} --previous"
            if reason != "ContainerCreating":
                where = (pod.get("spec") or {}).get("nodeName", "no node")
                message = f"{name} on {where}: {reason}: {why.get('message', '')}".rstrip(": ")
                yield Finding("error", "images" if image else "pods", message, remedy)


def _places(pod: Body) -> str:
    """What to do for a pod that no node takes."""
    if (pod["metadata"].get("labels") or {}).get("app.kubernetes.io/component") not in {"operator", "view"}:
        return f"kubectl -n {SYSTEM} describe pod {pod['metadata']['name']}"
    return (
        f"it needs a node that is neither a drone nor an edge node, or has {CLOUD_LABEL}=true; where that has taints, set"
        " operator.tolerations of the chart"
    )


def _authority(secret: Body | None, now: datetime) -> Iterator[Finding]:
    text = ((secret or {}).get("data") or {}).get("ca.crt", "")
    if not text:
        message, remedy = "there is no authority yet", "the operator makes it when it starts: see the check operator"
        yield Finding("error", "certificates", message, remedy)
        return
    try:
        ends = min(c.not_valid_after_utc for c in x509.load_pem_x509_certificates(text.encode()))
    except ValueError as error:
        remedy = f"kubectl -n {SYSTEM} get configmap fractus-ca -o yaml"
        yield Finding("error", "certificates", f"the authority cannot be read: {error}", remedy)
        return
    if ends - now < EXPIRY:
        level: Literal["warning", "error"] = "error" if ends < now else "warning"
        remedy = "delete the Secret fractus-ca while nothing flies; the operator makes another authority"
        yield Finding(level, "certificates", f"the authority expires at {ends:%Y-%m-%d}", remedy)
    else:
        yield Finding("ok", "certificates", f"the authority is valid until {ends:%Y-%m-%d}")


def _nodes(found: Cluster) -> Iterator[Finding]:
    described = {
        "drone": {body["metadata"]["name"]: body for body in found.list(f"{GROUP}/drones")},
        "edge": {body["metadata"]["name"]: body for body in found.list(f"{GROUP}/edgenodes")},
    }
    classes: set[str] = set()
    nodes = found.list("/api/v1/nodes")
    names = {node["metadata"]["name"] for node in nodes}
    for of_class, bodies in described.items():
        for name in sorted(set(bodies) - names):
            kind = "drone" if of_class == "drone" else "edgenode"
            message = f"there is no node of the name of {kind} {name}: it was renamed or removed"
            yield Finding("warning", "nodes", message, f"where it does not come back: kubectl delete {kind} {name}")
    for node in nodes:
        name, labels = node["metadata"]["name"], node["metadata"].get("labels") or {}
        of_class = labels.get(CLASS, "")
        classes |= {of_class, "cloud"} if labels.get(CLOUD_LABEL) == "true" else {of_class}
        if of_class not in {"", "drone", "edge", "cloud"}:
            remedy = f"kubectl label node {name} {CLASS}=drone --overwrite (or edge, or cloud)"
            yield Finding("error", "nodes", f"{name}: the class {of_class} means nothing", remedy)
        elif of_class in described:
            yield from _node(node, of_class, described[of_class].get(name))
    for of_class in ("drone", "cloud"):
        if of_class not in classes:
            remedy = f"kubectl label node NODE {CLASS}={of_class}"
            level: Literal["warning", "error"] = "error" if of_class == "drone" else "warning"
            yield Finding(level, "nodes", f"no node has the label {CLASS}={of_class}", remedy)


def _node(node: Body, of_class: str, body: Body | None) -> Iterator[Finding]:
    """The findings of one drone or edge node."""
    name, before = node["metadata"]["name"], []
    if conditions_of(node).get("Ready", {}).get("status") != "True":
        before.append(Finding("warning", "nodes", f"{name} is out of reach", "check its power, link and kubelet"))
    addresses = (node.get("status") or {}).get("addresses") or ()
    address = next((str(a.get("address")) for a in addresses if a.get("type") == "InternalIP"), "")
    if ":" in address:
        message = f"{name} has the address {address} first, and its services listen on IPv4"
        before.append(
            Finding("error", "nodes", message, "give the node an IPv4 address first (--node-ip of its kubelet)")
        )
    effects = {t["effect"] for t in (node.get("spec") or {}).get("taints") or () if t["key"] == CLASS}
    if (node["metadata"].get("labels") or {}).get(CLOUD_LABEL) == "true":
        if effects:
            message = f"{name} has the label {CLOUD_LABEL}, but its taint {CLASS} keeps the cloud's pods away"
            before.append(Finding("warning", "nodes", message, f"kubectl taint node {name} {CLASS}-"))
        elif of_class == "drone":
            message = f"{name} is of the cloud, too: any pod there can reach its autopilot"
            before.append(
                Finding("warning", "nodes", message, "only for a simulated drone; else give it a node of its own")
            )
    elif "NoExecute" not in effects:
        remedy = f"kubectl taint node {name} {CLASS}={of_class}:NoExecute"
        message = (
            f"{name} has no taint {CLASS} with the effect NoExecute: other pods may run there, also with its network"
        )
        before.append(Finding("warning", "nodes", message, remedy))
    if body is None:
        kind = "Drone" if of_class == "drone" else "EdgeNode"
        remedy = (
            f"put its description on the node as /etc/fractus/node.yaml, and see kubectl -n {SYSTEM} logs of its agent"
        )
        before.append(Finding("error", "nodes", f"{name} has no {kind}: its agent has not registered it", remedy))
    else:
        for type_, condition in sorted(conditions_of(body).items()):
            # Services that wait for a landing, and missions, are as they should be.
            if condition["status"] != "True" and type_ not in {"ServicesCurrent", "OnMission"}:
                message = f"{name}: {type_}: {condition['reason']}: {condition.get('message', '')}".rstrip(": ")
                remedy = f"kubectl describe {'drone' if of_class == 'drone' else 'edgenode'} {name}"
                before.append(Finding("error" if type_ == "Ready" else "warning", "hardware", message, remedy))
    yield from before or [Finding("ok", "nodes", f"{name} is a {of_class} node, described and ready")]


def _rules(found: Cluster) -> Iterator[Finding]:
    for plural in ("zones", "policies"):
        for body in found.list(f"{GROUP}/{plural}"):
            ready = conditions_of(body).get("Ready", {})
            if ready.get("status") == "False":
                name = f"{plural}/{body['metadata']['name']}"
                yield Finding(
                    "error", "policies", f"{name}: {ready.get('message')}", f"correct it: kubectl edit {name}"
                )
    if not found.list(f"{GROUP}/depots"):
        yield Finding("warning", "depots", "there is none", "apply a Depot: drones start from it (examples)")
