"""Objects by the application that they belong to: what one application asks for costs nothing for all others."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Generic, TypeVar

from fractus_operator.cluster.kinds import Body, Key, Kind
from fractus_operator.cluster.labels import APPLICATION_LABEL, MANAGED_SELECTOR, NAMESPACE_LABEL, labelled
from fractus_operator.cluster.store import Reflector, Store

T = TypeVar("T")


class Grouped(Generic[T]):
    """Objects by their keys, in groups."""

    def __init__(self) -> None:
        self._groups: dict[Key, dict[Key, T]] = {}

    def put(self, group: Key, key: Key, value: T) -> None:
        """Take an object into a group, in place of the one with its key."""
        self._groups.setdefault(group, {})[key] = value

    def drop(self, group: Key, key: Key) -> None:
        """Take an object out of a group, if it is there."""
        members = self._groups.get(group, {})
        if members.pop(key, None) is not None and not members:
            del self._groups[group]

    def of(self, group: Key) -> Iterable[T]:
        """The objects of a group; good until the next change."""
        return self._groups.get(group, {}).values()

    def values(self) -> Iterable[T]:
        """The objects of all groups; good until the next change."""
        return (value for members in self._groups.values() for value in members.values())


class Made(Reflector[Body]):
    """What the operator made of a kind for Applications."""

    def __init__(
        self,
        store: Store,
        kind: Kind,
        parse: Callable[[Body], Body],
        on_change: Callable[[Key, Body | None, Body | None], None],
    ) -> None:
        self._by_application: Grouped[Body] = Grouped()
        self._told = on_change
        super().__init__(store, kind, parse, self._changed, selectors={"labelSelector": MANAGED_SELECTOR})

    def of(self, application: Key) -> list[Body]:
        """What was made for an application."""
        return list(self._by_application.of(labelled(application)))

    def _changed(self, key: Key, old: Body | None, new: Body | None) -> None:
        if old is not None:
            self._by_application.drop(application_of(old), key)
        if new is not None:
            self._by_application.put(application_of(new), key, new)
        self._told(key, old, new)


def application_of(body: Body) -> Key:
    """Namespace and label of the application that an object was made for, as its labels say."""
    metadata = body["metadata"]
    labels = metadata.get("labels") or {}
    return metadata.get("namespace") or labels.get(NAMESPACE_LABEL, ""), labels.get(APPLICATION_LABEL, "")
