"""What the operator made of one kind, by the application that it was made for."""

from __future__ import annotations

from collections.abc import Callable

from fractus_operator.cluster.kinds import Body, Key, Kind
from fractus_operator.cluster.labels import APPLICATION_LABEL, MANAGED_SELECTOR, NAMESPACE_LABEL, labelled
from fractus_operator.cluster.store import Reflector, Store
from fractus_operator.inventory.grouped import Grouped


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
