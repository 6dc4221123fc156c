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
from fractus_core.api.names import CLASS_LABEL as CLASS
from fractus_core.api.names import CLOUD_LABEL

from fractus_cli.output import output_option
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
    "fractus-pods",
    "fractus-operator",
    "fractus-flight-pods",
    "fractus-flight-nodes",
    "fractus-flight-system",
    "fractus-flight-node-status",
    "fractus-flight-kinds",
)
EXPIRY = timedelta(days=30)
_HELM = f"helm upgrade --install fractus charts/fractus -n {SYSTEM}"
_APPS = f"/apis/apps/v1/namespaces/{SYSTEM}"
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
            remedy = f"\n         {finding.remedy}" if finding.remedy else ""
            click.echo(f"{finding.level:8} {finding.check}: {finding.message}{remedy}")
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
        remedy = f"helm upgrade --install fractus-crds charts/fractus-crds -n {SYSTEM} --create-namespace"
        yield Finding("error", "kinds", f"{', '.join(missing)}: not there", remedy)
    else:
        yield Finding("ok", "kinds", f"all {len(KINDS)} are there")


def _operator(found: Cluster) -> Iterator[Finding]:
    deployment = found.get(f"{_APPS}/deployments/fractus-operator")
    if deployment is None:
        yield Finding("error", "operator", "the chart fractus is not installed", _HELM)
        return
    ready, wanted = (deployment.get("status") or {}).get("readyReplicas", 0), deployment["spec"].get("replicas", 1)
    lease = found.get(f"/apis/coordination.k8s.io/v1/namespaces/{SYSTEM}/leases/fractus-operator") or {}
    leader = (lease.get("spec") or {}).get("holderIdentity")
    logs = f"kubectl -n {SYSTEM} logs deployment/fractus-operator"
    if not ready or not leader:
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
        if ready < wanted:
            remedy = f"kubectl -n {SYSTEM} describe pods -l app.kubernetes.io/component={name.removeprefix('fractus-')}"
            yield Finding("warning", "services", f"{name} is ready on {ready} of {wanted} nodes", remedy)
        else:
            yield Finding("ok", "services", f"{name} is ready on all {wanted} nodes")


def _admission(found: Cluster) -> Iterator[Finding]:
    missing = {
        name
        for plural in ("validatingadmissionpolicies", "validatingadmissionpolicybindings")
        for name in set(POLICIES) - {body["metadata"]["name"] for body in found.list(f"{_ADMISSION}/{plural}")}
    }
    if missing:
        yield Finding("error", "admission", f"{', '.join(sorted(missing))}: not in force", _HELM)
    else:
        yield Finding("ok", "admission", f"all {len(POLICIES)} policies are in force")


def _pods(pods: Sequence[Body]) -> Iterator[Finding]:
    for pod in pods:
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
    for node in found.list("/api/v1/nodes"):
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
    tainted = any(t["key"] == CLASS for t in (node.get("spec") or {}).get("taints") or ())
    if (node["metadata"].get("labels") or {}).get(CLOUD_LABEL) == "true":
        if tainted:
            message = f"{name} has the label {CLOUD_LABEL}, but its taint {CLASS} keeps the cloud's pods away"
            before.append(Finding("warning", "nodes", message, f"kubectl taint node {name} {CLASS}-"))
        elif of_class == "drone":
            message = f"{name} is of the cloud, too: any pod there can reach its autopilot"
            before.append(
                Finding("warning", "nodes", message, "only for a simulated drone; else give it a node of its own")
            )
    elif not tainted:
        remedy = f"kubectl taint node {name} {CLASS}={of_class}:NoExecute"
        before.append(Finding("warning", "nodes", f"{name} has no taint {CLASS}: other pods may run there", remedy))
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
