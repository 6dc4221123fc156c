"""Views of Pods and Nodes that contain only the fields the operator uses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import NamedTuple

from fractus_core.api.names import CLASS_LABEL
from fractus_core.api.plans import DeploymentPlanSpec, PlannedInstance
from fractus_core.planning.inventory import Host, amount_of

from fractus_operator.kinds import Body
from fractus_operator.labels import (
    APPLICATION_LABEL,
    COMPONENT_LABEL,
    FINISHED_FORMAT,
    FINISHED_LABEL,
    INSTANCE_LABEL,
    MANAGED_BY,
    MANAGED_LABEL,
    SIDECAR,
)

_MAX_LOG = 400
"""Maximum length of the kept log lines of a failed container, and of a message why pods cannot be created."""
FINISHED_DEADLINE_S = 1
"""Value of `activeDeadlineSeconds` that stops a running pod.

The API server accepts no smaller value. The time counts from the start of the pod.
"""
_NO_IMAGE = frozenset({"ImagePullBackOff", "ErrImagePull", "ErrImageNeverPull"})
_CANNOT_START = _NO_IMAGE | {"InvalidImageName", "CreateContainerConfigError"}
_LOAD_IMAGE = "push the image to a registry that the node can reach, or load it (`fractus cluster load-image` on an embedded cluster)"
REPLICA_FAILURE = "ReplicaFailure"
"""Condition type of a Deployment whose pods cannot be created (reason REFUSED) or deleted."""
REFUSED = "FailedCreate"
_ENDED = frozenset({"Succeeded", "Failed"})
_KEPT_LABELS = (APPLICATION_LABEL, COMPONENT_LABEL, INSTANCE_LABEL, MANAGED_LABEL)


class PlannedRequest(NamedTuple):
    """The resource requests of a planned instance on its node."""

    instance: str
    node: str
    amounts: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class PodView:
    """A Pod.

    Attributes:
        requests: Effective resource requests in base units.
        deployment: Name of the Deployment that created the pod through a ReplicaSet, if any.
        daemon_set: Name of the DaemonSet that created it, if any.
        revision: Hash of the template of its DaemonSet.
        finished_at: Time of the stop if the pod is stopped and only kept for its logs, otherwise None.
        failure: Exit code of the last failure of its container, the line that states the error, and the log lines before it, or an
            empty string.
        unschedulable_since: Time since which the scheduler finds no node for it, None if it is scheduled.
        unschedulable_message: Message of the scheduler.
        eviction: Message why Kubernetes ends the pod (drain, taint, preemption), or an empty string.
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
    eviction: str = ""

    @property
    def instance(self) -> str | None:
        """The planned instance of the pod."""
        return self.labels.get(INSTANCE_LABEL)

    @property
    def application(self) -> str | None:
        """The value of the Application label of the pod."""
        return self.labels.get(APPLICATION_LABEL)

    @property
    def managed(self) -> bool:
        """True if a Deployment of the operator created the pod, even if that Deployment was deleted since."""
        return self.labels.get(MANAGED_LABEL) == MANAGED_BY and self.deployment in {None, self.instance}

    @property
    def takes_calls(self) -> bool:
        """True if the pod is ready, has an address, and is not terminating."""
        return self.ready and not self.terminating and bool(self.ip)

    @property
    def component(self) -> str | None:
        """The component of the pod."""
        return self.labels.get(COMPONENT_LABEL)

    @property
    def problem(self) -> str:
        """Why the pod does not run, as a sentence, or an empty string."""
        if self.failure:
            return f"{self.instance} failed with {self.failure}"
        if self.eviction:
            return f"{self.instance} was evicted from {self.node}: {self.eviction}"
        if self.unschedulable_since is not None:
            return f"{self.instance} cannot be scheduled: {self.unschedulable_message}"
        return ""


@dataclass(frozen=True, slots=True)
class PlanPods:
    """The pods of the instances of a plan.

    Attributes:
        plan: The plan.
        pods: Pods of its Application.
        start: The Application's `start`.
    """

    plan: DeploymentPlanSpec
    pods: Sequence[PodView]
    start: str = "immediately"

    @property
    def ready(self) -> dict[str, int]:
        """Number of ready pods by instance, at most its number of replicas."""
        alive = [pod.instance for pod in self.pods if pod.ready and not pod.terminating and not pod.finished]
        return {p.instance: min(alive.count(p.instance), p.replicas) for p in self.plan.placements}

    @property
    def unready(self) -> list[PlannedInstance]:
        """Instances with fewer ready pods than replicas."""
        ready = self.ready
        return [placed for placed in self.plan.placements if ready[placed.instance] < placed.replicas]

    @property
    def awaited(self) -> tuple[str, ...]:
        """Components for which the takeoff of the drone waits. Empty after the takeoff, or if another Application flies."""
        drone = self.plan.drone
        waits = self.start == "whenReady" and self.plan.flown is None
        if not waits or drone is None or drone.shared_with is not None:
            return ()
        return tuple(dict.fromkeys(placed.component for placed in self.unready))


def parse_pod(body: Body) -> PodView:
    """Parse a Pod."""
    metadata = body["metadata"]
    spec = body["spec"]
    status = body.get("status") or {}
    labels = metadata.get("labels") or {}
    conditions = {c["type"]: c for c in status.get("conditions") or ()}
    ready = conditions.get("Ready", {}).get("status") == "True"
    scheduled = conditions.get("PodScheduled", {})
    unschedulable = scheduled.get("status") == "False" and scheduled.get("reason") == "Unschedulable"
    since = scheduled.get("lastTransitionTime") if unschedulable else None
    disrupted = conditions.get("DisruptionTarget", {})
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
        unschedulable_message=scheduled.get("message", "")[:_MAX_LOG] if unschedulable else "",
        eviction=_eviction(disrupted) if disrupted.get("status") == "True" else "",
    )


def _stops(spec: Body, status: Body) -> bool:
    """Return True if a pod has ended or is being stopped. The label `FINISHED_LABEL` alone does not prove that."""
    return status.get("phase") in _ENDED or spec.get("activeDeadlineSeconds") == FINISHED_DEADLINE_S


def _finished_at(labels: Mapping[str, str]) -> datetime | None:
    if FINISHED_LABEL not in labels:
        return None
    try:
        return datetime.strptime(labels[FINISHED_LABEL], FINISHED_FORMAT).replace(tzinfo=UTC)
    except ValueError:
        # Users of the namespace may write the label. With an invalid value the pod is removed at once.
        return datetime.min.replace(tzinfo=UTC)


def _failure(status: Body) -> str:
    for container in status.get("containerStatuses") or ():
        ended = (container.get("state") or {}).get("terminated") or (container.get("lastState") or {}).get("terminated")
        if ended and ended.get("exitCode"):
            output = _last_line_first(str(ended.get("message") or ended.get("reason") or ""))
            return f"exit code {ended['exitCode']}" + (f": {output}" if output else "")
        if problem := _start_problem(container):
            return problem
    # The sidecar of a MAVLink program is an init container. If it ends, it is restarted.
    problems = (_start_problem(container) for container in status.get("initContainerStatuses") or ())
    return next((f"{SIDECAR}: {problem}" for problem in problems if problem), "")


def _start_problem(container: Body) -> str:
    """Return why a container cannot be started, or an empty string."""
    waiting = (container.get("state") or {}).get("waiting") or {}
    if waiting.get("reason") not in _CANNOT_START:
        return ""
    problem = f"{waiting['reason']}: {waiting.get('message', '')}".rstrip(": ")
    return f"{problem}; {_LOAD_IMAGE}" if waiting["reason"] in _NO_IMAGE else problem


def _last_line_first(output: str) -> str:
    """Return the line that states the error, followed by the last lines before it.

    In a Python traceback, this line is the first one after the frames. Otherwise it is the last line.
    """
    lines = [line.rstrip() for line in output.split("\n") if line.strip()]
    if not lines:
        return ""
    error = len(lines) - 1
    begins = [number for number, line in enumerate(lines) if line.startswith("Traceback (most recent call last)")]
    if begins:
        error = next((n for n in range(begins[-1] + 1, len(lines)) if not lines[n].startswith(" ")), error)
    text = lines.pop(error).strip()[:_MAX_LOG]
    before = " | ".join(lines)[-_MAX_LOG:].strip(" |")
    return f"{text} (before: {before})" if before else text


def _eviction(condition: Body) -> str:
    """Return why Kubernetes ends a pod. An eviction has no message that names its cause."""
    if condition.get("reason") == "EvictionByEvictionAPI":
        return "eviction requested, for example by kubectl drain"
    return str(condition.get("message") or condition.get("reason") or "")[:_MAX_LOG]


def _deployment(metadata: Body) -> str | None:
    """Return the name of the Deployment of a pod, from the name of its ReplicaSet: NAME-HASH."""
    owner = _controller(metadata, "ReplicaSet")
    return owner.rpartition("-")[0] if owner is not None else None


def daemon_set(metadata: Body) -> str | None:
    """Return the name of the DaemonSet that controls an object, if any."""
    return _controller(metadata, "DaemonSet")


def revision_hash(metadata: Body) -> str:
    """Return the hash of the DaemonSet template of a pod or ControllerRevision."""
    return str((metadata.get("labels") or {}).get("controller-revision-hash", ""))


def refusal_of(deployment: Body) -> str:
    """Return why the API server refuses pods of a Deployment (quota, Pod Security), or an empty string."""
    for condition in (deployment.get("status") or {}).get("conditions") or ():
        if (condition["type"], condition["status"], condition.get("reason")) == (REPLICA_FAILURE, "True", REFUSED):
            return str(condition.get("message") or REFUSED)[:_MAX_LOG]
    return ""


def _controller(metadata: Body, kind: str) -> str | None:
    for owner in metadata.get("ownerReferences") or ():
        if owner.get("controller") and (owner.get("apiVersion"), owner.get("kind")) == ("apps/v1", kind):
            return str(owner["name"])
    return None


def _requests(spec: Body) -> dict[str, float]:
    """Return the effective requests of a Pod, as the scheduler counts them.

    They are the maximum of the containers that run at the same time, or the requests of the pod itself, plus the overhead.
    An init container with restartPolicy Always, such as the proxy of a service mesh, continues to run beside the later containers.
    """
    total: dict[str, float] = {"pods": 1.0}
    maximum: dict[str, float] = {}
    for container in spec.get("initContainers") or ():
        for resource, amount in _declared_requests(container).items():
            together = total.get(resource, 0.0) + amount
            maximum[resource] = max(maximum.get(resource, 0.0), together)
            if container.get("restartPolicy") == "Always":
                total[resource] = together
    for container in spec.get("containers") or ():
        for resource, amount in _declared_requests(container).items():
            total[resource] = total.get(resource, 0.0) + amount
    for resource, amount in maximum.items():
        total[resource] = max(total.get(resource, 0.0), amount)
    total |= _declared_requests(spec)
    for resource, amount in (spec.get("overhead") or {}).items():
        total[resource] = total.get(resource, 0.0) + amount_of(amount)
    return total


def _declared_requests(part: Body) -> dict[str, float]:
    resources = part.get("resources") or {}
    return {name: amount_of(q) for name, q in (resources.get("requests") or {}).items()}


def parse_host(body: Body) -> Host:
    """Parse a Node. Its heartbeats do not change the result."""
    metadata = body["metadata"]
    spec = body.get("spec") or {}
    status = body.get("status") or {}
    ready = any(c["type"] == "Ready" and c["status"] == "True" for c in status.get("conditions") or ())
    return Host(
        name=metadata["name"],
        labels=dict(metadata.get("labels") or {}),
        allocatable={name: amount_of(quantity) for name, quantity in (status.get("allocatable") or {}).items()},
        ready=ready,
        schedulable=not spec.get("unschedulable", False),
        guarded=any(t["key"] == CLASS_LABEL and t["effect"] == "NoExecute" for t in spec.get("taints") or ()),
    )
