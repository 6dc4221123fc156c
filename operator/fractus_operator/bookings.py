"""Resources of Nodes that are booked by running pods and by plans whose pods do not exist yet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import TypeVar

from fractus_core.planning.inventory import Host

from fractus_operator.kinds import Key
from fractus_operator.owned_objects import GroupedObjects
from fractus_operator.parsing import CachedObjects
from fractus_operator.pods import PlannedRequest, PodView

T = TypeVar("T")

Amounts = dict[str, float]


class Bookings:
    """Resources booked by pods and plans, by node. Each change of a pod or plan updates only the nodes concerned."""

    def __init__(self) -> None:
        self._booked: dict[str, Amounts] = {}
        self._bound: Counter[tuple[str, str, str]] = Counter()
        """Number of pods by namespace, instance and node."""
        self._planned: GroupedObjects[Sequence[PlannedRequest]] = GroupedObjects()
        self._nodes: dict[Key, set[str]] = {}

    def pod_changed(self, old: PodView | None, new: PodView | None) -> None:
        """Handle a change of a pod."""
        for pod, change in ((old, -1), (new, 1)):
            if pod is None or pod.node is None or pod.finished:
                continue
            add(self._booked.setdefault(pod.node, {}), pod.requests, change)
            if pod.application is not None and pod.instance is not None:
                slot = (pod.namespace, pod.instance, pod.node)
                self._bound[slot] += change
                if not self._bound[slot]:
                    del self._bound[slot]

    def plan_changed(self, application: Key, requests: Sequence[PlannedRequest]) -> Collection[str]:
        """Handle a change of the active plan of an Application.

        Args:
            application: Key of the Application with its name as a label value.
            requests: Requests of the planned instances.

        Returns:
            The nodes on which the plan releases resources.
        """
        before: dict[str, Sequence[PlannedRequest]] = {}
        for node in self._nodes.pop(application, ()):
            before[node] = self._planned.members(("", node))[application]
            self._planned.drop(("", node), application)
        by_node: dict[str, list[PlannedRequest]] = {}
        for request in requests:
            by_node.setdefault(request.node, []).append(request)
        for node, planned in by_node.items():
            self._planned.put(("", node), application, planned)
        if by_node:
            self._nodes[application] = set(by_node)
        return [node for node, booked in before.items() if booked != by_node.get(node)]

    def on(self, node: str, requester: Key | None = None, pods: Iterable[PodView] = ()) -> Amounts:
        """Return the booked amounts on a node, including planned instances whose pods are not bound yet.

        Args:
            node: Name of the node.
            requester: Namespace and label value of the Application that is being planned. Its own bookings are not included.
            pods: Pods of that Application on the node.
        """
        extra: Amounts = {}
        for pod in pods:
            if not pod.finished:
                add(extra, pod.requests, -1)
        for application, requests in self._planned.members(("", node)).items():
            for request in requests if application != requester else ():
                if (application[0], request.instance, node) not in self._bound:
                    add(extra, request.amounts)
        booked = {**self._booked.get(node, {})}
        add(booked, extra)
        return booked


def add(total: Amounts, amounts: Mapping[str, float], sign: int = 1) -> None:
    """Add amounts of resources to a total, or subtract them (sign -1)."""
    for resource, amount in amounts.items():
        total[resource] = total.get(resource, 0.0) + sign * amount


class BookedHosts(Mapping[str, Host]):
    """Nodes with their booked resources by name, computed on access. The mapping is valid until the next change.

    Args:
        hosts: All Nodes.
        bookings: Booked resources.
        requester: Namespace and label value of the Application that is being planned. Its own bookings are not included.
        pods: Pods of that Application.
    """

    def __init__(
        self, hosts: CachedObjects[Host], bookings: Bookings, requester: Key | None, pods: Iterable[PodView]
    ) -> None:
        self._hosts = hosts
        self._bookings = bookings
        self._requester = requester
        self._pods: dict[str, list[PodView]] = {}
        for pod in pods:
            if pod.node is not None:
                self._pods.setdefault(pod.node, []).append(pod)

    def __getitem__(self, name: str) -> Host:
        """Return a node.

        Raises:
            KeyError: There is no node of that name.
        """
        host = self._hosts.get(("", name))
        if host is None:
            raise KeyError(name)
        booked = self._bookings.on(name, self._requester, self._pods.get(name, ()))
        return Host(host.name, host.labels, host.allocatable, booked, ready=host.ready, schedulable=host.schedulable)

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of all nodes."""
        return (name for (_, name), _ in self._hosts.items())

    def __len__(self) -> int:
        """Return the number of nodes."""
        return len(self._hosts)

    def __contains__(self, name: object) -> bool:
        """Return True if there is a node of that name."""
        return isinstance(name, str) and self._hosts.get(("", name)) is not None


class ByName(Mapping[str, T]):
    """The valid objects of a cluster-scoped kind by name. The mapping is valid until the next change."""

    def __init__(self, objects: CachedObjects[T | None]) -> None:
        self._objects = objects

    def __getitem__(self, name: str) -> T:
        """Return an object.

        Raises:
            KeyError: There is no object of that name, or it is invalid.
        """
        value = self._objects.get(("", name))
        if value is None:
            raise KeyError(name)
        return value

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the valid objects."""
        return (name for (_, name), value in self._objects.items() if value is not None)

    def __len__(self) -> int:
        """Return the number of valid objects."""
        return sum(value is not None for value in self._objects.values())
