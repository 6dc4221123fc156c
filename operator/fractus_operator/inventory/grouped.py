"""Objects by the application or node that they belong to: what one of these asks for costs nothing for all others."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Generic, TypeVar

from fractus_operator.cluster.kinds import Key

T = TypeVar("T")


class Grouped(Generic[T]):
    """Objects by their keys, in groups: of an application, or, as ("", name), of a node."""

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
        return self.members(group).values()

    def members(self, group: Key) -> Mapping[Key, T]:
        """The objects of a group by their keys; good until the next change."""
        return self._groups.get(group, {})
