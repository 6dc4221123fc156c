"""What the operator keeps for each node in a namespace of its own: its Grants in one object, and the account that may read that."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from fractus_core.api.grants import NODE_GRANTS_NAMESPACE, PACKED_METADATA, NodeGrantsStatus, ReportedGrant
from pydantic import ValidationError

from fractus_operator.cluster.kinds import NODE_GRANTS, Body, Key, Kind
from fractus_operator.cluster.node_accounts import ACCOUNT_KINDS, SELECTORS, is_as_made
from fractus_operator.cluster.store import Reflector, Store
from fractus_operator.inventory.grouped import Grouped

logger = logging.getLogger(__name__)

_Listener = Callable[[Key], None]


@dataclass(frozen=True, slots=True)
class KnownGrants:
    """A NodeGrants object as it is at the API server.

    Attributes:
        digest: of its packed Grants, which are not kept here.
        reports: what the node's agent says of them.
    """

    uid: str
    count: int
    digest: str
    reports: tuple[ReportedGrant, ...]

    def carries(self, packed: str, count: int) -> bool:
        """Whether it has these Grants."""
        return (self.digest, self.count) == (digest_of(packed), count)


def digest_of(packed: str) -> str:
    """A digest of packed Grants."""
    return hashlib.sha256(packed.encode()).hexdigest()


def read_known(body: Body) -> KnownGrants:
    """The view of a NodeGrants object; reports that cannot be read count as none."""
    spec = body.get("spec") or {}
    reports: tuple[ReportedGrant, ...] = ()
    try:
        reports = NodeGrantsStatus.model_validate(body.get("status") or {}).grants
    except ValidationError as error:
        logger.warning("node objects: reports are left out (node=%s): %s", body["metadata"]["name"], error)
    digest = digest_of(str(spec.get("packed")))
    return KnownGrants(str(body["metadata"].get("uid", "")), int(spec.get("count", -1)), digest, reports)


class NodeObjects:
    """These objects of all nodes, and all Grants by the node they are for.

    Args:
        store: The API server.
    """

    def __init__(self, store: Store) -> None:
        self.known = Reflector(
            store, NODE_GRANTS, read_known, self._known_changed, selectors=SELECTORS, namespace=NODE_GRANTS_NAMESPACE
        )
        self.accounts: dict[Kind, Reflector[bool]] = {
            kind: Reflector(
                store,
                kind,
                partial(is_as_made, kind),
                lambda key, _old, _new: self._tell(self._account_listeners, key[1]),
                selectors=SELECTORS,
                namespace=NODE_GRANTS_NAMESPACE,
            )
            for kind in ACCOUNT_KINDS
        }
        self._grants: Grouped[Body] = Grouped()
        self._account_listeners: list[_Listener] = []
        self._grant_listeners: list[_Listener] = []
        self._report_listeners: list[_Listener] = []

    def listen(self, *, accounts: _Listener, grants: _Listener, reports: _Listener) -> None:
        """Call a listener with ("", node) for each change of the node's account, of its Grants, and of what its agent reports."""
        self._account_listeners.append(accounts)
        self._grant_listeners.append(grants)
        self._report_listeners.append(reports)

    def reflectors(self) -> list[Reflector[Any]]:
        """Every reflector; run each as a task of its own."""
        return [self.known, *self.accounts.values()]

    def known_of(self, node: str) -> KnownGrants | None:
        """The object that carries a node's Grants; None where there is none."""
        return self.known.get((NODE_GRANTS_NAMESPACE, node))

    def account_of(self, node: str) -> Mapping[Kind, bool]:
        """What there is of a node's account, and whether it is as it was made."""
        found = {kind: reflector.get((NODE_GRANTS_NAMESPACE, node)) for kind, reflector in self.accounts.items()}
        return {kind: as_made for kind, as_made in found.items() if as_made is not None}

    def is_complete(self, node: str) -> bool:
        """Whether a node has its account, as it was made, and the object that carries its Grants."""
        account = self.account_of(node)
        return len(account) == len(self.accounts) and all(account.values()) and self.known_of(node) is not None

    def grants_of(self, node: str) -> list[Body]:
        """The Grants of a node, but for those that are being deleted."""
        return [body for body in self._grants.of(("", node)) if "deletionTimestamp" not in body["metadata"]]

    def grant_changed(self, key: Key, old: Body | None, new: Body | None) -> None:
        """Follow a Grant. What is reported of it changes nothing here."""
        before, after = _node_of(old), _node_of(new)
        if old is not None and before is not None:
            self._grants.drop(("", before), key)
        if new is not None and after is not None:
            self._grants.put(("", after), key, new)
        if before == after and old is not None and new is not None and _packed_part(old) == _packed_part(new):
            return
        for node in {before, after} - {None}:
            self._tell(self._grant_listeners, str(node))

    def _known_changed(self, key: Key, old: KnownGrants | None, new: KnownGrants | None) -> None:
        if old is None or new is None:
            self._tell(self._account_listeners, key[1])
        if old is None or new is None or (old.uid, old.digest, old.count) != (new.uid, new.digest, new.count):
            self._tell(self._grant_listeners, key[1])
        if new is not None and (old is None or old.reports != new.reports):
            self._tell(self._report_listeners, key[1])

    def _tell(self, listeners: list[_Listener], node: str) -> None:
        for listener in listeners:
            listener(("", node))


def _node_of(grant: Body | None) -> str | None:
    node = (grant.get("spec") or {}).get("node") if grant is not None else None
    return node if isinstance(node, str) and node else None


def _packed_part(grant: Body) -> tuple[object, ...]:
    return (grant.get("spec"), *(grant["metadata"].get(field) for field in (*PACKED_METADATA, "deletionTimestamp")))
