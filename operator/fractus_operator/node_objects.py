"""Objects that the operator keeps for each node in the namespace of nodes: NodeGrants, and the account that may read it."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from fractus_core.api.grants import NODE_GRANTS_NAMESPACE, PACKED_METADATA, NodeGrantsStatus, ReportedGrant
from fractus_core.api.model import GROUP
from pydantic import ValidationError

from fractus_operator.kinds import NODE_GRANTS, ROLE, ROLE_BINDING, SERVICE_ACCOUNT, Body, Key, Kind
from fractus_operator.labels import MANAGED_BY, MANAGED_LABEL
from fractus_operator.owned_objects import GroupedObjects
from fractus_operator.store import Informer, Store

log = logging.getLogger(__name__)

ACCOUNT_KINDS = (SERVICE_ACCOUNT, ROLE, ROLE_BINDING)
"""Kinds of the objects of a node's account, in the order of their creation. They are deleted in reverse order."""
MANAGED = {MANAGED_LABEL: MANAGED_BY}
SELECTORS = {"labelSelector": f"{MANAGED_LABEL}={MANAGED_BY}"}

_RBAC = "rbac.authorization.k8s.io"
_Listener = Callable[[Key], None]


def header(kind: Kind, node: str) -> Body:
    """Return apiVersion, kind and metadata of an object of a node. The object has the name of the node."""
    return kind.header(node, NODE_GRANTS_NAMESPACE, labels=dict(MANAGED))


def account_object(kind: Kind, node: str) -> Body:
    """Return the object of a node's account of one of ACCOUNT_KINDS.

    The admission policy of the chart accepts exactly this content.
    """
    return header(kind, node) | _content(kind, node)


def is_unmodified(kind: Kind, observed: Body) -> bool:
    """Return True if an object has the content of `account_object`."""
    desired = _content(kind, observed["metadata"]["name"])
    return all(observed.get(field) == value for field, value in desired.items())


def _content(kind: Kind, node: str) -> Body:
    if kind is SERVICE_ACCOUNT:
        return {"automountServiceAccountToken": False}
    if kind is ROLE:
        target = {"apiGroups": [GROUP], "resourceNames": [node]}
        return {
            "rules": [
                {**target, "resources": [NODE_GRANTS.plural], "verbs": ["get", "list", "watch"]},
                {**target, "resources": [f"{NODE_GRANTS.plural}/status"], "verbs": ["patch", "update"]},
            ]
        }
    return {
        "roleRef": {"apiGroup": _RBAC, "kind": ROLE.name, "name": node},
        "subjects": [{"kind": SERVICE_ACCOUNT.name, "name": node, "namespace": NODE_GRANTS_NAMESPACE}],
    }


@dataclass(frozen=True, slots=True)
class KnownGrants:
    """A NodeGrants object as observed at the API server.

    Attributes:
        digest: Digest of its packed Grants, which are not kept in memory.
        reports: Reports of the node's agent about the Grants.
    """

    uid: str
    count: int
    digest: str
    reports: tuple[ReportedGrant, ...]

    def contains(self, packed: str, count: int) -> bool:
        """Return True if the object contains these Grants."""
        return (self.digest, self.count) == (digest_of(packed), count)


def digest_of(packed: str) -> str:
    """Return a digest of packed Grants."""
    return hashlib.sha256(packed.encode()).hexdigest()


def parse_known(body: Body) -> KnownGrants:
    """Parse a NodeGrants object. Invalid reports are ignored."""
    spec = body.get("spec") or {}
    reports: tuple[ReportedGrant, ...] = ()
    try:
        reports = NodeGrantsStatus.model_validate(body.get("status") or {}).grants
    except ValidationError as error:
        log.warning("node objects: invalid reports ignored (node=%s error=%s)", body["metadata"]["name"], error)
    digest = digest_of(str(spec.get("packed")))
    return KnownGrants(str(body["metadata"].get("uid", "")), int(spec.get("count", -1)), digest, reports)


class NodeObjects:
    """The NodeGrants objects and accounts of all nodes, and all Grants by node.

    Args:
        store: The API server.

    Attributes:
        informers: All informers. Run each one in its own task.
    """

    def __init__(self, store: Store) -> None:
        self.known = Informer(
            store, NODE_GRANTS, parse_known, self._known_changed, selectors=SELECTORS, namespace=NODE_GRANTS_NAMESPACE
        )
        self.accounts: dict[Kind, Informer[bool]] = {
            kind: Informer(
                store,
                kind,
                partial(is_unmodified, kind),
                lambda key, _old, _new: self._notify(self._account_listeners, key[1]),
                selectors=SELECTORS,
                namespace=NODE_GRANTS_NAMESPACE,
            )
            for kind in ACCOUNT_KINDS
        }
        self.informers: tuple[Informer[Any], ...] = (self.known, *self.accounts.values())
        self._grants: GroupedObjects[Body] = GroupedObjects()
        self._account_listeners: list[_Listener] = []
        self._grant_listeners: list[_Listener] = []
        self._report_listeners: list[_Listener] = []

    def add_listeners(self, *, accounts: _Listener, grants: _Listener, reports: _Listener) -> None:
        """Call the listeners with ("", node) for each change of a node's account, Grants, or reports of its agent."""
        self._account_listeners.append(accounts)
        self._grant_listeners.append(grants)
        self._report_listeners.append(reports)

    def node_grants_of(self, node: str) -> KnownGrants | None:
        """Return the NodeGrants object of a node, or None."""
        return self.known.get((NODE_GRANTS_NAMESPACE, node))

    def account_of(self, node: str) -> Mapping[Kind, bool]:
        """Return the existing objects of a node's account, each with True if the object is unmodified."""
        present = {kind: informer.get((NODE_GRANTS_NAMESPACE, node)) for kind, informer in self.accounts.items()}
        return {kind: unmodified for kind, unmodified in present.items() if unmodified is not None}

    def is_complete(self, node: str) -> bool:
        """Return True if a node has its unmodified account and its NodeGrants object."""
        account = self.account_of(node)
        return len(account) == len(self.accounts) and all(account.values()) and self.node_grants_of(node) is not None

    def grants_of(self, node: str) -> list[Body]:
        """Return the Grants of a node, except Grants that are being deleted."""
        return [body for body in self._grants.of(("", node)) if "deletionTimestamp" not in body["metadata"]]

    def grant_changed(self, key: Key, old: Body | None, new: Body | None) -> None:
        """Handle a change of a Grant. A change of its status has no effect."""
        before = _node_of(old)
        after = _node_of(new)
        if old is not None and before is not None:
            self._grants.drop(("", before), key)
        if new is not None and after is not None:
            self._grants.put(("", after), key, new)
        if before == after and old is not None and new is not None and _packed_fields(old) == _packed_fields(new):
            return
        for node in {before, after} - {None}:
            self._notify(self._grant_listeners, str(node))

    def _known_changed(self, key: Key, old: KnownGrants | None, new: KnownGrants | None) -> None:
        if old is None or new is None:
            self._notify(self._account_listeners, key[1])
        if old is None or new is None or (old.uid, old.digest, old.count) != (new.uid, new.digest, new.count):
            self._notify(self._grant_listeners, key[1])
        if new is not None and (old is None or old.reports != new.reports):
            self._notify(self._report_listeners, key[1])

    def _notify(self, listeners: list[_Listener], node: str) -> None:
        for listener in listeners:
            listener(("", node))


def _node_of(grant: Body | None) -> str | None:
    node = (grant.get("spec") or {}).get("node") if grant is not None else None
    return node if isinstance(node, str) and node else None


def _packed_fields(grant: Body) -> tuple[object, ...]:
    """Return the fields of a Grant that change the packed Grants of its node."""
    return (grant.get("spec"), *(grant["metadata"].get(field) for field in (*PACKED_METADATA, "deletionTimestamp")))
