"""Kubernetes objects as decoded JSON, their keys, and the REST paths of their kinds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

Body = dict[str, Any]
"""An object as decoded JSON."""

Key = tuple[str, str]
"""(namespace, name). The namespace is empty for cluster-scoped objects."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of object and its place in the REST API."""

    api_version: str
    name: str
    plural: str
    namespaced: bool

    def path(self, namespace: str = "", name: str = "", subresource: str = "") -> str:
        """Return the path of a collection (without name), an object, or one of its subresources."""
        root = "/apis/" if "/" in self.api_version else "/api/"
        parts = [root + self.api_version]
        if self.namespaced and namespace:
            parts += ["namespaces", namespace]
        parts += [part for part in (self.plural, name, subresource) if part]
        return "/".join(parts)

    def header(self, name: str, namespace: str = "", **metadata: Any) -> Body:
        """Return apiVersion, kind and metadata of an object of this kind."""
        meta: Body = {"name": name, **metadata}
        if self.namespaced:
            meta["namespace"] = namespace
        return {"apiVersion": self.api_version, "kind": self.name, "metadata": meta}


def key_of(body: Body) -> Key:
    """Return the key of an object."""
    metadata = body["metadata"]
    return (metadata.get("namespace", ""), metadata["name"])


def version_of(body: Body) -> int:
    """Return the resource version of an object as a number, which increases with each change. 0 if it is not a number."""
    return version_number(str(body["metadata"].get("resourceVersion", "")))


def version_number(version: str) -> int:
    """Return a resource version as a number, or 0 if it is not a number."""
    return int(version) if version.isdecimal() else 0
