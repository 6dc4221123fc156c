"""Informers of the objects that the operator creates, indexed by their Application."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Generic, TypeVar

from fractus_operator.kinds import Body, Key, Kind
from fractus_operator.labels import APPLICATION_LABEL, MANAGED_SELECTOR, NAMESPACE_LABEL, label_key
from fractus_operator.store import Informer, Store

T = TypeVar("T")


class GroupedObjects(Generic[T]):
    """An index of objects by group, so that reading a group does not iterate over all objects.

    A group is an Application, or a node as ("", name).
    """

    def __init__(self) -> None:
        self._groups: dict[Key, dict[Key, T]] = {}

    def put(self, group: Key, key: Key, value: T) -> None:
        """Add an object to a group, or replace the object with this key."""
        self._groups.setdefault(group, {})[key] = value

    def drop(self, group: Key, key: Key) -> None:
        """Remove an object from a group, if it is a member."""
        members = self._groups.get(group, {})
        if members.pop(key, None) is not None and not members:
            del self._groups[group]

    def of(self, group: Key) -> Iterable[T]:
        """Return the objects of a group. The result is valid until the next change."""
        return self.members(group).values()

    def members(self, group: Key) -> Mapping[Key, T]:
        """Return the objects of a group by key. The result is valid until the next change."""
        return self._groups.get(group, {})


class OwnedObjects(Informer[Body]):
    """Informer of the objects of one kind that the operator created for Applications."""

    def __init__(
        self,
        store: Store,
        kind: Kind,
        parse: Callable[[Body], Body],
        on_change: Callable[[Key, Body | None, Body | None], None],
    ) -> None:
        self._by_application: GroupedObjects[Body] = GroupedObjects()
        self._notify_cache = on_change
        super().__init__(store, kind, parse, self._index, selectors={"labelSelector": MANAGED_SELECTOR})

    def of(self, application: Key) -> list[Body]:
        """Return the objects of an Application."""
        return list(self._by_application.of(label_key(application)))

    def _index(self, key: Key, old: Body | None, new: Body | None) -> None:
        if old is not None:
            self._by_application.drop(application_label_key(old), key)
        if new is not None:
            self._by_application.put(application_label_key(new), key, new)
        self._notify_cache(key, old, new)


def application_label_key(body: Body) -> Key:
    """Return the key of the Application of an object, with the name as a label value."""
    metadata = body["metadata"]
    labels = metadata.get("labels") or {}
    return metadata.get("namespace") or labels.get(NAMESPACE_LABEL, ""), labels.get(APPLICATION_LABEL, "")
