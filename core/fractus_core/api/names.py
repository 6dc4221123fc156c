"""Names of objects, components, instances and nodes, and the identities made of them: each pattern in one place."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from typing import Annotated, Self

from pydantic import Field

TRUST_DOMAIN = "fractus.dev"
SPIFFE_SCHEME = "spiffe://"

CLASS_LABEL = f"{TRUST_DOMAIN}/class"
"""On Nodes, and the key of their taint: drone, edge or cloud."""

NODE_SIGNER = f"{TRUST_DOMAIN}/node"
"""The signer that agents ask for the certificates of their nodes."""

DNS_LABEL = r"^[a-z0-9]([-a-z0-9]*[a-z0-9])?$"
Name = Annotated[str, Field(min_length=1, max_length=63, pattern=DNS_LABEL)]
"""A DNS label (RFC 1123), as Kubernetes names objects."""

COMPONENT_NAME = r"^[A-Za-z]([-A-Za-z0-9]*[A-Za-z0-9])?$"
ComponentName = Annotated[str, Field(min_length=1, max_length=40, pattern=COMPONENT_NAME)]
"""A component's name; CamelCase is welcome, objects get its kebab-case form."""

_DNS_SUBDOMAIN = re.compile(r"[a-z0-9]([-a-z0-9.]{0,251}[a-z0-9])?")


def is_subdomain(text: str) -> bool:
    """Whether a text is a DNS subdomain (RFC 1123), as Kubernetes names nodes and pods; it is safe as a file name."""
    return _DNS_SUBDOMAIN.fullmatch(text) is not None


def shortened(text: str, limit: int, *, digits: int = 8) -> str:
    """The text with at most `limit` characters: a longer one ends in a hash of all of it."""
    if len(text) <= limit:
        return text
    return text[: limit - digits - 1].rstrip("-._") + "-" + hashlib.sha256(text.encode()).hexdigest()[:digits]


def slug(component: str) -> str:
    """A component's name as Kubernetes objects carry it: GroundViewer becomes ground-viewer."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", component).lower()


def address_variable(component: str) -> str:
    """The environment variable with the address of a component: FRACTUS_SERVICE_GROUND_VIEWER."""
    return f"FRACTUS_SERVICE_{slug(component).upper().replace('-', '_')}"


OPERATOR_IDENTITY = f"{SPIFFE_SCHEME}{TRUST_DOMAIN}/operator"
"""SPIFFE id of the operator, which signs Grants."""


@dataclass(frozen=True, slots=True)
class ComponentIdentity:
    """The parts of the SPIFFE id of a component instance; its text is the id."""

    namespace: str
    application: str
    component: str
    instance: str

    def __str__(self) -> str:
        return (
            f"{SPIFFE_SCHEME}{TRUST_DOMAIN}/ns/{self.namespace}/app/{self.application}"
            f"/component/{self.component}/instance/{self.instance}"
        )

    @classmethod
    def parse(cls, identity: str) -> Self | None:
        """The parts of a SPIFFE id; None when it is not that of a component instance."""
        parts = identity.split("/")
        found = cls(*parts[4::2]) if len(parts) == _PARTS else None
        return found if found is not None and str(found) == identity else None


_PARTS = str(ComponentIdentity("", "", "", "")).count("/") + 1


def component_identity(namespace: str, application: str, component: str, instance: str) -> str:
    """SPIFFE id of a component instance."""
    return str(ComponentIdentity(namespace, application, component, instance))


def node_identity(node: str) -> str:
    """SPIFFE id of a node's agent and system services."""
    return f"{SPIFFE_SCHEME}{TRUST_DOMAIN}/node/{node}"


def node_server_name(node: str) -> str:
    """DNS name in the certificate of a node's services; clients check it whatever address they dial."""
    return f"{node}.node.{TRUST_DOMAIN}"
