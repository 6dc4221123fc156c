"""Index of the pods of Fractus services by node, with the revision that their DaemonSets require."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from fractus_operator.kinds import Body, Key
from fractus_operator.pods import PodView, daemon_set, revision_hash

SERVICES = frozenset({"fractus-agent", "fractus-camera", "fractus-mobility"})
"""The DaemonSets whose pods the operator replaces."""


@dataclass(frozen=True, slots=True)
class Revision:
    """A revision of the pod template of a DaemonSet.

    Attributes:
        number: Increases with each change, including a rollback.
        hash: Value of the revision label of the pods.
    """

    daemon_set: str
    number: int
    hash: str


def parse_revision(body: Body) -> Revision | None:
    """Parse a ControllerRevision. Return None if its owner is not a DaemonSet of a service."""
    owner = daemon_set(body["metadata"])
    return Revision(owner, int(body["revision"]), revision_hash(body["metadata"])) if owner in SERVICES else None


class NodeServicePods:
    """The pods of the services on each node.

    Args:
        namespace: Namespace of the services.
    """

    def __init__(self, namespace: str) -> None:
        self._namespace = namespace
        self._pods: dict[str, dict[Key, PodView]] = {}
        self._revisions: dict[Key, Revision] = {}
        self._latest: dict[str, Revision] = {}
        self._ready: Counter[tuple[str | None, str]] = Counter()
        self._changed: set[str] = set()

    def __len__(self) -> int:
        """Return the number of nodes that have services."""
        return len(self._pods)

    def pod_changed(self, key: Key, old: PodView | None, new: PodView | None) -> None:
        """Handle a change of a pod. Pods that belong to no service are ignored."""
        for pod in (old, new):
            if pod is None or pod.node is None or pod.namespace != self._namespace or pod.daemon_set not in SERVICES:
                continue
            self._changed.add(pod.node)
            if pod.ready and not pod.terminating:
                self._ready[pod.daemon_set, pod.revision] += 1 if pod is new else -1
            pods = self._pods.setdefault(pod.node, {})
            if pod is new:
                pods[key] = pod
            elif pods.pop(key, None) is not None and not pods:
                del self._pods[pod.node]

    def revision_changed(self, key: Key, _old: Revision | None, new: Revision | None) -> None:
        """Handle a change of a DaemonSet revision."""
        if new is None:
            self._revisions.pop(key, None)
        else:
            self._revisions[key] = new
        before = self._latest
        self._latest = {}
        for revision in sorted(self._revisions.values(), key=lambda r: r.number):
            self._latest[revision.daemon_set] = revision
        if self._latest != before:
            self._changed.update(self._pods)

    def take_changed(self) -> set[str]:
        """Return the nodes whose services or required revisions changed since the last call."""
        changed = self._changed
        self._changed = set()
        return changed

    def on(self, node: str) -> Sequence[PodView]:
        """Return the service pods of a node."""
        return tuple(self._pods.get(node, {}).values())

    def has_revision(self, daemon_set: str) -> bool:
        """Return True if a DaemonSet has a revision. A DaemonSet without a revision was deleted."""
        return daemon_set in self._latest

    def is_current(self, pod: PodView) -> bool:
        """Return True if a pod has the latest revision of its DaemonSet, or if that revision is unknown."""
        latest = self._latest.get(str(pod.daemon_set))
        return latest is None or latest.hash == pod.revision

    def ready(self, daemon_set: str) -> int:
        """Return the number of nodes with a ready pod of the latest revision of a DaemonSet."""
        latest = self._latest.get(daemon_set)
        return self._ready[daemon_set, latest.hash] if latest is not None else 0
