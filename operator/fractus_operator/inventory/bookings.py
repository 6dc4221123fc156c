"""The Nodes as planning sees them: with what pods that run, and plans whose pods are yet to come, have booked on them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import TypeVar

from fractus_core.planning.inventory import Host

from fractus_operator.cluster.kinds import Key
from fractus_operator.cluster.pods import PlannedRequest, PodView
from fractus_operator.cluster.reading import Copies
from fractus_operator.inventory.grouped import Grouped

T = TypeVar("T")

Amounts = dict[str, float]


class Bookings:
    """What pods have asked for, and plans whose pods are yet to come, by node; kept current one pod and one plan at a time."""

    def __init__(self) -> None:
        self._booked: dict[str, Amounts] = {}
        self._bound: Counter[tuple[str, str, str]] = Counter()
        """Pods of applications by namespace, instance and node."""
        self._planned: Grouped[Sequence[PlannedRequest]] = Grouped()
        self._nodes: dict[Key, set[str]] = {}

    def pod_changed(self, old: PodView | None, new: PodView | None) -> None:
        """Follow a change of a pod."""
        for pod, change in ((old, -1), (new, 1)):
            if pod is None or pod.node is None or pod.finished:
                continue
            add(self._booked.setdefault(pod.node, {}), pod.requests, change)
            if pod.application is not None and pod.instance is not None:
                slot = (pod.namespace, pod.instance, pod.node)
                self._bound[slot] += change
                if not self._bound[slot]:
                    del self._bound[slot]

    def planned(self, application: Key, requests: Sequence[PlannedRequest]) -> Collection[str]:
        """Follow the plan in force of an application, by its key as labels spell it; returns the nodes that it leaves room on."""
        before: dict[str, Sequence[PlannedRequest]] = {}
        for node in self._nodes.pop(application, ()):
            before[node] = self._planned.members(("", node))[application]
            self._planned.drop(("", node), application)
        by_node: dict[str, list[PlannedRequest]] = {}
        for request in requests:
            by_node.setdefault(request.node, []).append(request)
        for node, there in by_node.items():
            self._planned.put(("", node), application, there)
        if by_node:
            self._nodes[application] = set(by_node)
        return [node for node, asked in before.items() if asked != by_node.get(node)]

    def on(self, node: str, own: Key | None = None, pods: Iterable[PodView] = ()) -> Amounts:
        """What is booked on a node for a plan of the application `own`.

        Planned instances whose pods are not bound yet count as if they were; the application's own do not count.

        Args:
            node: Its name.
            own: (namespace, application label) of who is planned.
            pods: Its pods on the node.
        """
        extra: Amounts = {}
        for pod in pods:
            if not pod.finished:
                add(extra, pod.requests, -1)
        for application, requests in self._planned.members(("", node)).items():
            for request in requests if application != own else ():
                if (application[0], request.instance, node) not in self._bound:
                    add(extra, request.amounts)
        booked = {**self._booked.get(node, {})}
        add(booked, extra)
        return booked


def add(total: Amounts, amounts: Mapping[str, float], sign: int = 1) -> None:
    """Add amounts of resources to a total, or take them off."""
    for resource, amount in amounts.items():
        total[resource] = total.get(resource, 0.0) + sign * amount


class BookedHosts(Mapping[str, Host]):
    """Nodes by name, each made when it is asked for: a plan reads few of thousands. Good until the next change.

    Args:
        hosts: Nodes.
        bookings: What is booked on them.
        own: (namespace, application label) of who is planned: what it has booked itself is free for it.
        pods: Its pods.
    """

    def __init__(self, hosts: Copies[Host], bookings: Bookings, own: Key | None, pods: Iterable[PodView]) -> None:
        self._hosts = hosts
        self._bookings = bookings
        self._own = own
        self._pods: dict[str, list[PodView]] = {}
        for pod in pods:
            if pod.node is not None:
                self._pods.setdefault(pod.node, []).append(pod)

    def __getitem__(self, name: str) -> Host:
        """The node of that name.

        Raises:
            KeyError: there is none.
        """
        host = self._hosts.get(("", name))
        if host is None:
            raise KeyError(name)
        booked = self._bookings.on(name, self._own, self._pods.get(name, ()))
        return Host(host.name, host.labels, host.allocatable, booked, ready=host.ready, schedulable=host.schedulable)

    def __iter__(self) -> Iterator[str]:
        """Names of all nodes."""
        return (name for (_, name), _ in self._hosts.items())

    def __len__(self) -> int:
        """How many nodes there are."""
        return len(self._hosts)

    def __contains__(self, name: object) -> bool:
        """Whether there is a node of that name."""
        return isinstance(name, str) and self._hosts.get(("", name)) is not None


class ByName(Mapping[str, T]):
    """Objects of a cluster-scoped kind by name, without those that cannot be read. Good until the next change."""

    def __init__(self, objects: Copies[T | None]) -> None:
        self._objects = objects

    def __getitem__(self, name: str) -> T:
        """The object of that name.

        Raises:
            KeyError: there is none, or it cannot be read.
        """
        found = self._objects.get(("", name))
        if found is None:
            raise KeyError(name)
        return found

    def __iter__(self) -> Iterator[str]:
        """Names of all that can be read."""
        return (name for (_, name), value in self._objects.items() if value is not None)

    def __len__(self) -> int:
        """How many can be read."""
        return sum(value is not None for value in self._objects.values())
