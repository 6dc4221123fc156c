"""The Nodes as planning sees them: with what pods that run, and plans whose pods are yet to come, have booked on them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TypeVar

from fractus_core.planning.inventory import Host

from fractus_operator.cluster.kinds import Key
from fractus_operator.cluster.pods import PlannedRequest, PodView
from fractus_operator.cluster.reading import Copies

T = TypeVar("T")

Amounts = dict[str, float]


class Bookings:
    """What pods have asked for, by node; kept current one pod at a time."""

    def __init__(self) -> None:
        self._booked: dict[str, Amounts] = {}

    def changed(self, old: PodView | None, new: PodView | None) -> None:
        """Follow a change of a pod."""
        for pod, sign in ((old, -1.0), (new, 1.0)):
            if pod is not None and pod.node is not None and not pod.finished:
                add(self._booked.setdefault(pod.node, {}), pod.requests, sign)

    def on(self, node: str) -> Mapping[str, float]:
        """What is booked on a node."""
        return self._booked.get(node, {})


def add(total: Amounts, amounts: Mapping[str, float], sign: float = 1.0) -> None:
    """Add amounts of resources to a total, or take them off."""
    for resource, amount in amounts.items():
        total[resource] = total.get(resource, 0.0) + sign * amount


class BookedHosts(Mapping[str, Host]):
    """Nodes by name, each made when it is asked for: a plan reads few of thousands. Good until the next change.

    Args:
        hosts: Nodes.
        bookings: What pods have asked for.
        corrections: What is to be added to the bookings of a node.
    """

    def __init__(self, hosts: Copies[Host], bookings: Bookings, corrections: Mapping[str, Amounts]) -> None:
        self._hosts = hosts
        self._bookings = bookings
        self._corrections = corrections

    def __getitem__(self, name: str) -> Host:
        """The node of that name.

        Raises:
            KeyError: there is none.
        """
        host = self._hosts.get(("", name))
        if host is None:
            raise KeyError(name)
        booked = self._bookings.on(name)
        extra = self._corrections.get(name)
        if extra is not None:
            booked = {**booked}
            add(booked, extra)
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


def corrections(planned: Iterable[PlannedRequest], pods: Iterable[PodView], own: Key | None) -> dict[str, Amounts]:
    """What to add to the bookings of nodes for a plan of the application `own`.

    Planned instances whose pods are not bound yet count as if they were; the application's own pods do not count.

    Args:
        planned: Every planned instance on a node.
        pods: The pods of applications.
        own: (namespace, application label) of who is planned.
    """
    found: dict[str, Amounts] = {}
    bound: set[tuple[str, str | None, str]] = set()
    for pod in pods:
        if pod.node is None or pod.finished:
            continue
        if pod.instance is not None:
            bound.add((pod.namespace, pod.instance, pod.node))
        if (pod.namespace, pod.application) == own:
            add(found.setdefault(pod.node, {}), pod.requests, -1.0)
    for key, instance, node, amounts in planned:
        if key != own and (key[0], instance, node) not in bound:
            add(found.setdefault(node, {}), amounts)
    return found
