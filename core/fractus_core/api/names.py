"""Names of objects, components, instances and nodes, and the SPIFFE identities derived from them."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from typing import Annotated, Self

from pydantic import Field

TRUST_DOMAIN = "fractus.dev"
SPIFFE_SCHEME = "spiffe://"

CLASS_LABEL = f"{TRUST_DOMAIN}/class"
"""Label of Kubernetes Nodes and key of their taint; values: drone, edge, cloud."""

CLOUD_LABEL = f"{TRUST_DOMAIN}/cloud"
"""Label of drone and edge Nodes that also accept cloud pods if its value is "true"."""

NODE_SIGNER = f"{TRUST_DOMAIN}/node"
"""signerName of the CertificateSigningRequests of agents."""

CONTROL_TAKEN = "ControlTaken"
"""Condition of an airborne Drone, set by its agent: True while no driver has control, with the reason."""

DNS_LABEL = r"^[a-z0-9]([-a-z0-9]*[a-z0-9])?$"
Name = Annotated[str, Field(min_length=1, max_length=63, pattern=DNS_LABEL)]
"""A DNS label (RFC 1123), as Kubernetes names objects."""

COMPONENT_NAME = r"^[A-Za-z]([-A-Za-z0-9]*[A-Za-z0-9])?$"
ComponentName = Annotated[str, Field(min_length=1, max_length=40, pattern=COMPONENT_NAME)]
"""Name of a component. Kubernetes objects get its kebab-case form."""

DNS_SUBDOMAIN = r"^[a-z0-9]([-a-z0-9]*[a-z0-9])?([.][a-z0-9]([-a-z0-9]*[a-z0-9])?)*$"
"""RFC 1123 subdomain: the name format of nodes, pods and most objects (at most 253 characters)."""

PORT_NAME = r"^([a-z0-9]-?)*[a-z](-?[a-z0-9])*$"
PortName = Annotated[str, Field(min_length=1, max_length=15, pattern=PORT_NAME)]
"""Name of a port (RFC 6335), as pods and Services require."""

HEURISTIC_KIND = r"^[A-Za-z]([-A-Za-z0-9_.]*[A-Za-z0-9])?$"
HeuristicKind = Annotated[str, Field(max_length=63, pattern=HEURISTIC_KIND)]
"""Name of a heuristic: the format of entry point names of Python packages."""

LABEL_KEY = r"^([a-z0-9]([-a-z0-9.]*[a-z0-9])?/)?[A-Za-z0-9]([-A-Za-z0-9_.]*[A-Za-z0-9])?$"
LabelKey = Annotated[str, Field(max_length=317, pattern=LABEL_KEY)]
LABEL_VALUE = r"^([A-Za-z0-9]([-A-Za-z0-9_.]*[A-Za-z0-9])?)?$"
LabelValue = Annotated[str, Field(max_length=63, pattern=LABEL_VALUE)]

SHAPES = {
    DNS_LABEL: "lowercase letters, digits and hyphens, with a letter or digit first and last",
    DNS_SUBDOMAIN: "lowercase letters, digits, hyphens and dots, with a letter or digit first, last, and on both sides of each dot",
    COMPONENT_NAME: "letters, digits and hyphens, with a letter first and no hyphen last",
    HEURISTIC_KIND: "letters, digits, hyphens, underscores and dots, with a letter first and a letter or digit last",
    LABEL_KEY: "letters, digits, hyphens, underscores and dots, with an optional DNS name and slash before them",
    LABEL_VALUE: "letters, digits, hyphens, underscores and dots, with a letter or digit first and last",
    PORT_NAME: "lowercase letters, digits and single hyphens between them, with at least one letter",
}
"""Description of the names that match each pattern, for error messages."""


def is_subdomain(text: str) -> bool:
    """Return True if `text` is a DNS subdomain (RFC 1123). Such a text is also a safe file name."""
    return len(text) <= 253 and re.fullmatch(DNS_SUBDOMAIN, text) is not None


def shortened(text: str, limit: int, *, digits: int = 8) -> str:
    """Shorten a text to at most `limit` characters. A longer text ends in a hash of the whole text, so results stay unique."""
    if len(text) < limit or (len(text) == limit and not _ends_in_hash(text, digits)):
        return text
    return f"{text[: limit - digits - 1]}-{_hash(text, digits)}"


def object_name(application: str, component: str, node: str | None = None, *, limit: int = 63) -> str:
    """Return the name of an object of a component, unique for each combination of application, component and node.

    The name is a DNS label that begins with a letter, as Services require. Parts are joined by hyphens if the name can be
    split into the same parts again. Otherwise the name ends in a hash of the parts, because hyphens within the parts
    would make it ambiguous.

    Args:
        application: Name of the application.
        component: Kebab-case name of the component (`slug`).
        node: Name of the node, or None for an object that is not specific to a node.
        limit: Maximum number of characters.
    """
    plain = "-".join(filter(None, (application, component, node)))
    if len(plain) <= limit and _read(plain) == (application, component, node):
        return plain
    text = re.sub(r"[^a-z0-9]+", "-", plain.lower()).strip("-")
    text = text if text[:1].isalpha() else f"a-{text}"
    # Kubernetes names contain no slash, so the joined text is unique.
    unique = _hash("/".join((application, component, node or "")), _NAME_DIGITS)
    return f"{text[: limit - _NAME_DIGITS - 1].rstrip('-')}-{unique}"


_NAME_DIGITS = 10
_READABLE = re.compile(
    r"(?P<application>[a-z][a-z0-9]*)"
    r"-(?P<component>[a-z][a-z0-9]*(-[a-z0-9]+)*?)"
    r"(-(?P<node>[a-z]+-?[0-9]+))?"
)
"""Names that can be split: an application without hyphens, a component, and optionally a node such as edge-1."""


def _read(name: str) -> tuple[str, str, str | None] | None:
    match = _READABLE.fullmatch(name)
    if match is None or _ends_in_hash(name, _NAME_DIGITS):
        return None
    return match["application"], match["component"], match["node"]


def _hash(text: str, digits: int) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:digits]


def _ends_in_hash(text: str, digits: int) -> bool:
    return re.search(rf"-[0-9a-f]{{{digits}}}\Z", text) is not None


def slug(component: str) -> str:
    """Return the kebab-case form of a component name: GroundViewer becomes ground-viewer."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", component).lower()


def address_variable(component: str) -> str:
    """Return the environment variable with the address of a component, such as FRACTUS_SERVICE_GROUND_VIEWER."""
    return f"FRACTUS_SERVICE_{slug(component).upper().replace('-', '_')}"


OPERATOR_IDENTITY = f"{SPIFFE_SCHEME}{TRUST_DOMAIN}/operator"
"""SPIFFE ID of the operator, which signs Grants."""


@dataclass(frozen=True, slots=True)
class ComponentIdentity:
    """The parts of the SPIFFE ID of a component instance. `str()` returns the ID."""

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
        """Parse a SPIFFE ID. Return None if it does not identify a component instance."""
        parts = identity.split("/")
        parsed = cls(*parts[4::2]) if len(parts) == _PARTS else None
        return parsed if parsed is not None and str(parsed) == identity else None


def component_name(identity: str) -> str:
    """Return the component of a component instance's SPIFFE ID. Return any other text unchanged."""
    parsed = ComponentIdentity.parse(identity)
    return parsed.component if parsed is not None else identity


_PARTS = str(ComponentIdentity("", "", "", "")).count("/") + 1


def component_identity(namespace: str, application: str, component: str, instance: str) -> str:
    """Return the SPIFFE ID of a component instance."""
    return str(ComponentIdentity(namespace, application, component, instance))


def node_identity(node: str) -> str:
    """Return the SPIFFE ID of the agent and system services of a node."""
    return f"{SPIFFE_SCHEME}{TRUST_DOMAIN}/node/{node}"


def node_server_name(node: str) -> str:
    """Return the DNS name in the server certificate of a node. Clients verify the name, not the address."""
    return f"{node}.node.{TRUST_DOMAIN}"
