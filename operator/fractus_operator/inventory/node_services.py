"""The pods of the system's services on each node, and which of them run what their DaemonSet asks for by now."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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

    def pod_changed(self, key: Key, old: PodView | None, new: PodView | None) -> None:
        """Follow a pod of any kind."""
        for pod in (old, new):
            if pod is None or pod.node is None or pod.namespace != self._namespace or pod.daemon_set not in SERVICES:
                continue
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

    def nodes(self) -> Iterator[tuple[str, Sequence[PodView]]]:
        """Every node that has services, with their pods."""
        for node, pods in sorted(self._pods.items()):
            yield node, tuple(pods.values())

    def is_asked_for(self, daemon_set: str) -> bool:
        """Whether a DaemonSet has a revision: without one it is gone, and makes no more pods."""
        return any(revision.daemon_set == daemon_set for revision in self._revisions.values())

    def is_current(self, pod: PodView) -> bool:
        """Whether a pod runs what its DaemonSet asks for, as far as that is known."""
        mine = [revision for revision in self._revisions.values() if revision.daemon_set == pod.daemon_set]
        return not mine or max(mine, key=lambda revision: revision.number).hash == pod.revision
