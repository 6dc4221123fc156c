"""What the operator remembers of Pods and Nodes: a small part of large objects, so that thousands fit."""

from __future__ import annotations

import functools
import sys
import types
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import NamedTuple

from fractus_core.api.names import CLASS_LABEL
from fractus_core.planning.inventory import Host, amount_of

from fractus_operator.cluster.kinds import Body
from fractus_operator.cluster.labels import (
    APPLICATION_LABEL,
    COMPONENT_LABEL,
    FINISHED_FORMAT,
    FINISHED_LABEL,
    INSTANCE_LABEL,
    MANAGED_BY,
    MANAGED_LABEL,
)

_MAX_LOG = 400
"""Characters of a failed container's last log lines, or of a refusal, that are kept."""
FINISHED_DEADLINE_S = 1
"""The shortest `activeDeadlineSeconds` that a pod takes, counted from its start: the kubelet stops a pod that runs."""
_CANNOT_START = frozenset({"ImagePullBackOff", "ErrImagePull", "InvalidImageName", "CreateContainerConfigError"})
REPLICA_FAILURE = "ReplicaFailure"
"""The condition of a Deployment whose pods cannot be made, with the reason REFUSED, or cannot be deleted."""
REFUSED = "FailedCreate"
_ENDED = frozenset({"Succeeded", "Failed"})
_KEPT_LABELS = (APPLICATION_LABEL, COMPONENT_LABEL, INSTANCE_LABEL, MANAGED_LABEL)


class PlannedRequest(NamedTuple):
    """A planned instance: its name, its node, and what it asks of it."""

    instance: str
    node: str
    amounts: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class PodView:
    """A Pod, as far as it matters here.

    Attributes:
        requests: what it asks of its node, in base units.
        deployment: name of the Deployment that made it, through a ReplicaSet; None for a pod of other making.
        daemon_set: name of the DaemonSet that made it, and `revision`, which of its templates it was made from.
        finished_at: since when it is stopped, and only kept for its logs; None before.
        failure: how its container failed last: exit code and last log lines; empty if it never did.
        unschedulable_since: since when the scheduler has found no node for it, if so.
        unschedulable_message: what the scheduler said.
    """

    namespace: str
    name: str
    node: str | None
    labels: Mapping[str, str]
    requests: Mapping[str, float]
    ready: bool
    finished: bool
    terminating: bool
    ip: str | None
    deployment: str | None = None
    daemon_set: str | None = None
    revision: str = ""
    finished_at: datetime | None = None
    failure: str = ""
    unschedulable_since: datetime | None = None
    unschedulable_message: str = ""

    @property
    def instance(self) -> str | None:
        """The planned instance that the pod is."""
        return self.labels.get(INSTANCE_LABEL)

    @property
    def application(self) -> str | None:
        """The application that the pod belongs to, as its label says."""
        return self.labels.get(APPLICATION_LABEL)

    @property
    def ours(self) -> bool:
        """Whether a Deployment of the operator made it, or did before it left its pods alone."""
        return self.labels.get(MANAGED_LABEL) == MANAGED_BY and self.deployment in {None, self.instance}

    @property
    def takes_calls(self) -> bool:
        """Whether it is ready, has an address, and is not about to end."""
        return self.ready and not self.terminating and bool(self.ip)

    @property
    def component(self) -> str | None:
        """The component that the pod runs."""
        return self.labels.get(COMPONENT_LABEL)


def read_pod(body: Body) -> PodView:
    """The view of a Pod."""
    metadata, spec, status = body["metadata"], body["spec"], body.get("status") or {}
    labels = metadata.get("labels") or {}
    conditions = {c["type"]: c for c in status.get("conditions") or ()}
    ready = conditions.get("Ready", {}).get("status") == "True"
    scheduled = conditions.get("PodScheduled", {})
    unschedulable = scheduled.get("status") == "False" and scheduled.get("reason") == "Unschedulable"
    since = scheduled.get("lastTransitionTime") if unschedulable else None
    return PodView(
        namespace=metadata["namespace"],
        name=metadata["name"],
        node=spec.get("nodeName"),
        labels={key: labels[key] for key in _KEPT_LABELS if key in labels},
        requests=_requests(spec),
        ready=ready,
        finished=status.get("phase") in _ENDED,
        terminating="deletionTimestamp" in metadata,
        ip=status.get("podIP"),
        deployment=_deployment(metadata),
        daemon_set=daemon_set(metadata),
        revision=revision_hash(metadata),
        finished_at=_finished_at(labels) if _stops(spec, status) else None,
        failure=_failure(status),
        unschedulable_since=datetime.fromisoformat(since) if since else None,
        unschedulable_message=scheduled.get("message", "") if unschedulable else "",
    )


def _stops(spec: Body, status: Body) -> bool:
    """Whether a pod has ended, or its kubelet ends it: a label alone hides no pod that runs."""
    return status.get("phase") in _ENDED or spec.get("activeDeadlineSeconds") == FINISHED_DEADLINE_S


def _finished_at(labels: Mapping[str, str]) -> datetime | None:
    if FINISHED_LABEL not in labels:
        return None
    try:
        return datetime.strptime(labels[FINISHED_LABEL], FINISHED_FORMAT).replace(tzinfo=UTC)
    except ValueError:
        # Everyone with access to the namespace may write it: such a pod is not kept.
        return datetime.min.replace(tzinfo=UTC)


def _failure(status: Body) -> str:
    for container in status.get("containerStatuses") or ():
        ended = (container.get("state") or {}).get("terminated") or (container.get("lastState") or {}).get("terminated")
        if ended and ended.get("exitCode"):
            lines = " | ".join(str(ended.get("message") or ended.get("reason") or "").split("\n"))[-_MAX_LOG:].strip(
                " |"
            )
            return f"exit code {ended['exitCode']}" + (f": {lines}" if lines else "")
        waiting = (container.get("state") or {}).get("waiting") or {}
        if waiting.get("reason") in _CANNOT_START:
            return f"{waiting['reason']}: {waiting.get('message', '')}".rstrip(": ")
    return ""


def _deployment(metadata: Body) -> str | None:
    """ReplicaSets are named after their Deployment: NAME-HASH."""
    owner = _controller(metadata, "ReplicaSet")
    return owner.rpartition("-")[0] if owner is not None else None


def daemon_set(metadata: Body) -> str | None:
    """The DaemonSet that controls an object."""
    return _controller(metadata, "DaemonSet")


def revision_hash(metadata: Body) -> str:
    """Which of its controller's templates a pod was made from, or a ControllerRevision keeps."""
    return str((metadata.get("labels") or {}).get("controller-revision-hash", ""))


def refusal_of(deployment: Body) -> str:
    """Why the API server refuses pods of a Deployment, such as a quota or Pod Security; empty where it does not."""
    for condition in (deployment.get("status") or {}).get("conditions") or ():
        if (condition["type"], condition["status"], condition.get("reason")) == (REPLICA_FAILURE, "True", REFUSED):
            return str(condition.get("message") or REFUSED)[:_MAX_LOG]
    return ""


def refusals(deployments: Iterable[Body]) -> dict[str, str]:
    """The same by name, of those Deployments whose pods are refused."""
    found = ((body["metadata"]["name"], refusal_of(body)) for body in deployments)
    return {name: why for name, why in found if why}


def _controller(metadata: Body, kind: str) -> str | None:
    for owner in metadata.get("ownerReferences") or ():
        if owner.get("controller") and (owner.get("apiVersion"), owner.get("kind")) == ("apps/v1", kind):
            return str(owner["name"])
    return None


def _requests(spec: Body) -> dict[str, float]:
    """Effective requests of a Pod, as the scheduler counts them: of all that runs at a time, or of the pod as a whole, and overhead.

    An init container that is restarted always, such as the proxy of a service mesh, runs on beside those that follow.
    """
    total: dict[str, float] = {"pods": 1.0}
    most: dict[str, float] = {}
    for container in spec.get("initContainers") or ():
        for resource, amount in _asked(container).items():
            beside = total.get(resource, 0.0) + amount
            most[resource] = max(most.get(resource, 0.0), beside)
            if container.get("restartPolicy") == "Always":
                total[resource] = beside
    for container in spec.get("containers") or ():
        for resource, amount in _asked(container).items():
            total[resource] = total.get(resource, 0.0) + amount
    for resource, amount in most.items():
        total[resource] = max(total.get(resource, 0.0), amount)
    total |= _asked(spec)
    for resource, amount in (spec.get("overhead") or {}).items():
        total[resource] = total.get(resource, 0.0) + amount_of(amount)
    return total


def _asked(part: Body) -> dict[str, float]:
    resources = part.get("resources") or {}
    return {name: amount_of(q) for name, q in (resources.get("requests") or {}).items()}


def read_host(body: Body) -> Host:
    """The view of a Node; its heartbeats change nothing here."""
    metadata, spec, status = body["metadata"], body.get("spec") or {}, body.get("status") or {}
    ready = any(c["type"] == "Ready" and c["status"] == "True" for c in status.get("conditions") or ())
    return Host(
        name=metadata["name"],
        labels={sys.intern(name): value for name, value in (metadata.get("labels") or {}).items()},
        allocatable=_allocatable(tuple((status.get("allocatable") or {}).items())),
        ready=ready,
        schedulable=not spec.get("unschedulable", False),
        guarded=any(t["key"] == CLASS_LABEL and t["effect"] == "NoExecute" for t in spec.get("taints") or ()),
    )


@functools.lru_cache(maxsize=256)
def _allocatable(quantities: tuple[tuple[str, str], ...]) -> Mapping[str, float]:
    """What a node offers, in base units: one mapping for all nodes of a make."""
    return types.MappingProxyType({name: amount_of(quantity) for name, quantity in quantities})
