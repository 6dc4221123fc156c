"""The pods of the system's services on each node, and which of them run what their DaemonSet asks for by now."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from fractus_operator.cluster.kinds import Body, Key
from fractus_operator.cluster.pods import PodView, daemon_set, revision_hash

SERVICES = frozenset({"fractus-agent", "fractus-camera", "fractus-mobility"})
"""The DaemonSets whose pods the operator replaces."""


@dataclass(frozen=True, slots=True)
class Revision:
    """What a DaemonSet asked for at some time.

    Attributes:
        number: grows with each change, also with one back to what was.
        hash: the label of its pods.
    """

    daemon_set: str
    number: int
    hash: str


def read_revision(body: Body) -> Revision | None:
    """The view of a ControllerRevision; None for one of another owner."""
    owner = daemon_set(body["metadata"])
    return Revision(owner, int(body["revision"]), revision_hash(body["metadata"])) if owner in SERVICES else None


class NodeServices:
    """Services by node.

    Args:
        namespace: where the system lives.
    """

    def __init__(self, namespace: str) -> None:
        self._namespace = namespace
        self._pods: dict[str, dict[Key, PodView]] = {}
        self._revisions: dict[Key, Revision] = {}
        self._wanted: dict[str, Revision] = {}
        self._ready: Counter[tuple[str | None, str]] = Counter()
        self._changed: set[str] = set()

    def __len__(self) -> int:
        """How many nodes have services."""
        return len(self._pods)

    def pod_changed(self, key: Key, old: PodView | None, new: PodView | None) -> None:
        """Follow a pod of any kind."""
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
        """Follow a revision of a DaemonSet."""
        if new is None:
            self._revisions.pop(key, None)
        else:
            self._revisions[key] = new
        before = self._wanted
        self._wanted = {}
        for revision in sorted(self._revisions.values(), key=lambda r: r.number):
            self._wanted[revision.daemon_set] = revision
        if self._wanted != before:
            self._changed.update(self._pods)

    def take_changed(self) -> set[str]:
        """The nodes whose services, or what is asked of them, changed since the last call."""
        changed, self._changed = self._changed, set()
        return changed

    def on(self, node: str) -> Sequence[PodView]:
        """The pods of a node's services."""
        return tuple(self._pods.get(node, {}).values())

    def is_asked_for(self, daemon_set: str) -> bool:
        """Whether a DaemonSet has a revision: without one it is gone, and makes no more pods."""
        return daemon_set in self._wanted

    def is_current(self, pod: PodView) -> bool:
        """Whether a pod runs what its DaemonSet asks for, as far as that is known."""
        wanted = self._wanted.get(str(pod.daemon_set))
        return wanted is None or wanted.hash == pod.revision

    def ready(self, daemon_set: str) -> int:
        """How many nodes run what a DaemonSet asks for by now, and are ready."""
        wanted = self._wanted.get(daemon_set)
        return self._ready[daemon_set, wanted.hash] if wanted is not None else 0
