"""Objects as JSON has them, and where the API server keeps those of a kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

Body = dict[str, Any]
"""An object as the API server gives and takes it."""

Key = tuple[str, str]
"""(namespace, name); the namespace is empty for cluster-scoped objects."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of object and its place in the REST API."""

    api_version: str
    name: str
    plural: str
    namespaced: bool

    def path(self, namespace: str = "", name: str = "", subresource: str = "") -> str:
        """Path of a collection (no name), an object, or one of its subresources."""
        root = "/apis/" if "/" in self.api_version else "/api/"
        parts = [root + self.api_version]
        if self.namespaced and namespace:
            parts += ["namespaces", namespace]
        parts += [part for part in (self.plural, name, subresource) if part]
        return "/".join(parts)

    def header(self, name: str, namespace: str = "", **metadata: Any) -> Body:
        """The beginning of an object of this kind."""
        meta: Body = {"name": name, **metadata}
        if self.namespaced:
            meta["namespace"] = namespace
        return {"apiVersion": self.api_version, "kind": self.name, "metadata": meta}


def key_of(body: Body) -> Key:
    """The key of an object."""
    metadata = body["metadata"]
    return (metadata.get("namespace", ""), metadata["name"])
