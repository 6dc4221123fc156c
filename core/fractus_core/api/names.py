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

CLOUD_LABEL = f"{TRUST_DOMAIN}/cloud"
"""On Nodes of another class: "true" makes them take the cloud's pods, too."""

NODE_SIGNER = f"{TRUST_DOMAIN}/node"
"""The signer that agents ask for the certificates of their nodes."""

CONTROL_TAKEN = "ControlTaken"
"""Condition of a Drone in the air, by its agent: True while no driver has control of it, with why."""

DNS_LABEL = r"^[a-z0-9]([-a-z0-9]*[a-z0-9])?$"
Name = Annotated[str, Field(min_length=1, max_length=63, pattern=DNS_LABEL)]
"""A DNS label (RFC 1123), as Kubernetes names objects."""

COMPONENT_NAME = r"^[A-Za-z]([-A-Za-z0-9]*[A-Za-z0-9])?$"
ComponentName = Annotated[str, Field(min_length=1, max_length=40, pattern=COMPONENT_NAME)]
"""A component's name; CamelCase is welcome, objects get its kebab-case form."""

DNS_SUBDOMAIN = r"^[a-z0-9]([-a-z0-9]*[a-z0-9])?([.][a-z0-9]([-a-z0-9]*[a-z0-9])?)*$"
"""RFC 1123; as Kubernetes names nodes, pods and most objects, in at most 253 characters."""

PORT_NAME = r"^([a-z0-9]-?)*[a-z](-?[a-z0-9])*$"
PortName = Annotated[str, Field(min_length=1, max_length=15, pattern=PORT_NAME)]
"""A port's name (RFC 6335), as pods and Services take it."""

HEURISTIC_KIND = r"^[A-Za-z]([-A-Za-z0-9_.]*[A-Za-z0-9])?$"
HeuristicKind = Annotated[str, Field(max_length=63, pattern=HEURISTIC_KIND)]
"""How heuristics are named: as entry points of Python packages are."""

LABEL_KEY = r"^([a-z0-9]([-a-z0-9.]*[a-z0-9])?/)?[A-Za-z0-9]([-A-Za-z0-9_.]*[A-Za-z0-9])?$"
LabelKey = Annotated[str, Field(max_length=317, pattern=LABEL_KEY)]
LABEL_VALUE = r"^([A-Za-z0-9]([-A-Za-z0-9_.]*[A-Za-z0-9])?)?$"
LabelValue = Annotated[str, Field(max_length=63, pattern=LABEL_VALUE)]

SHAPES = {
    DNS_LABEL: "small letters, digits and hyphens, with a letter or digit first and last",
    DNS_SUBDOMAIN: "small letters, digits, hyphens and dots, with a letter or digit beside each dot, first and last",
    COMPONENT_NAME: "letters, digits and hyphens, with a letter first and no hyphen last",
    HEURISTIC_KIND: "letters, digits, hyphens, underscores and dots, with a letter first and a letter or digit last",
    LABEL_KEY: "letters, digits, hyphens, underscores and dots, perhaps after a DNS name and a slash",
    LABEL_VALUE: "letters, digits, hyphens, underscores and dots, with a letter or digit first and last",
    PORT_NAME: "small letters, digits and single hyphens between them, with at least one letter",
}
"""What names that match a pattern consist of."""


def is_subdomain(text: str) -> bool:
    """Whether a text is a DNS subdomain (RFC 1123), as Kubernetes names nodes and pods; it is safe as a file name."""
    return len(text) <= 253 and re.fullmatch(DNS_SUBDOMAIN, text) is not None


def shortened(text: str, limit: int, *, digits: int = 8) -> str:
    """The text with at most `limit` characters, another one for every text: a longer one ends in a hash of all of it."""
    if len(text) < limit or (len(text) == limit and not _ends_in_hash(text, digits)):
        return text
    return f"{text[: limit - digits - 1]}-{_hash(text, digits)}"


def object_name(application: str, component: str, node: str | None = None, *, limit: int = 63) -> str:
    """Name of what is made for a component of an application, on one node or on any: another one for every three.

    It is a DNS label that begins with a letter, as Services need. The parts are joined by hyphens where the name can be
    read back; all else ends in a hash of the parts, since hyphens within them do not tell where one part ends.

    Args:
        application: Its name.
        component: The component's kebab-case name (`slug`).
        node: The node; None: the one object of the component that no node shares in.
        limit: How many characters it may have.
    """
    plain = "-".join(filter(None, (application, component, node)))
    if len(plain) <= limit and _read(plain) == (application, component, node):
        return plain
    text = re.sub(r"[^a-z0-9]+", "-", plain.lower()).strip("-")
    text = text if text[:1].isalpha() else f"a-{text}"
    # No part has a slash, in what Kubernetes takes for a name.
    unique = _hash("/".join((application, component, node or "")), _NAME_DIGITS)
    return f"{text[: limit - _NAME_DIGITS - 1].rstrip('-')}-{unique}"


_NAME_DIGITS = 10
_READABLE = re.compile(
    r"(?P<application>[a-z][a-z0-9]*)"
    r"-(?P<component>[a-z][a-z0-9]*(-[a-z0-9]+)*?)"
    r"(-(?P<node>[a-z]+-?[0-9]+))?"
)
"""How a joined name is read: an application without hyphens, and at the end, if it looks like one, a node such as edge-1."""


def _read(name: str) -> tuple[str, str, str | None] | None:
    found = _READABLE.fullmatch(name)
    if found is None or _ends_in_hash(name, _NAME_DIGITS):
        return None
    return found["application"], found["component"], found["node"]


def _hash(text: str, digits: int) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:digits]


def _ends_in_hash(text: str, digits: int) -> bool:
    return re.search(rf"-[0-9a-f]{{{digits}}}\Z", text) is not None


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
