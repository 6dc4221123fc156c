"""The account of a node, by which its agent reads the one object that carries the node's Grants, and no other."""

from __future__ import annotations

from fractus_core.api.grants import NODE_GRANTS_NAMESPACE
from fractus_core.api.model import GROUP

from fractus_operator.cluster.kinds import NODE_GRANTS, ROLE, ROLE_BINDING, SERVICE_ACCOUNT, Body, Kind
from fractus_operator.cluster.labels import MANAGED_BY, MANAGED_LABEL

ACCOUNT_KINDS = (SERVICE_ACCOUNT, ROLE, ROLE_BINDING)
"""In the order in which they are made; they are removed in the other."""
MANAGED = {MANAGED_LABEL: MANAGED_BY}
SELECTORS = {"labelSelector": f"{MANAGED_LABEL}={MANAGED_BY}"}

_RBAC = "rbac.authorization.k8s.io"


def header(kind: Kind, node: str) -> Body:
    """The beginning of an object of a node, which has its name."""
    return kind.header(node, NODE_GRANTS_NAMESPACE, labels=dict(MANAGED))


def account_object(kind: Kind, node: str) -> Body:
    """What belongs to the account of a node: one of ACCOUNT_KINDS. The chart's admission policy takes no other."""
    return header(kind, node) | _content(kind, node)


def is_as_made(kind: Kind, observed: Body) -> bool:
    """Whether an object is as `account_object` makes it."""
    wanted = _content(kind, observed["metadata"]["name"])
    return all(observed.get(field) == value for field, value in wanted.items())


def _content(kind: Kind, node: str) -> Body:
    if kind is SERVICE_ACCOUNT:
        return {"automountServiceAccountToken": False}
    if kind is ROLE:
        own = {"apiGroups": [GROUP], "resourceNames": [node]}
        return {
            "rules": [
                {**own, "resources": [NODE_GRANTS.plural], "verbs": ["get", "list", "watch"]},
                {**own, "resources": [f"{NODE_GRANTS.plural}/status"], "verbs": ["patch", "update"]},
            ]
        }
    return {
        "roleRef": {"apiGroup": _RBAC, "kind": ROLE.name, "name": node},
        "subjects": [{"kind": SERVICE_ACCOUNT.name, "name": node, "namespace": NODE_GRANTS_NAMESPACE}],
    }
