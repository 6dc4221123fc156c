"""Kubernetes objects as decoded JSON, their keys, and the REST paths of their kinds."""

from __future__ import annotations

import json
import logging
import re
from dataclasses import dataclass
from typing import Any

log = logging.getLogger(__name__)

_MAX_NESTING = 200
"""Nesting of lists and objects beyond which values of a very deep response are dropped."""

_TOKEN = re.compile(rb'"[^"\\]*(?:\\.[^"\\]*)*"|[][{}]', re.DOTALL)
"""A string, or the begin or end of a list or an object."""

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


def parse_response(content: bytes) -> Any:
    """Return the JSON value of a response or a watch event of the API server.

    The API server accepts 10,000 levels in fields without a schema, which Python cannot parse. Values that are nested more
    than `_MAX_NESTING` levels deep are then null, because one such object must not make its whole collection unreadable.

    Raises:
        ValueError: The content is not JSON.
    """
    try:
        return json.loads(content)
    except RecursionError:
        log.warning("kubernetes: deeply nested values dropped (bytes=%d)", len(content))
        return json.loads(_without_deep_values(content))


def _without_deep_values(content: bytes) -> bytes:
    """Return JSON with null in place of the lists and objects that are nested too deeply."""
    parts: list[bytes] = []
    kept = 0
    depth = 0
    for token in _TOKEN.finditer(content):
        if token[0] in {b"{", b"["}:
            depth += 1
            if depth == _MAX_NESTING + 1:
                parts += (content[kept : token.start()], b"null")
                kept = len(content)
        elif token[0] in {b"}", b"]"}:
            if depth == _MAX_NESTING + 1:
                kept = token.end()
            depth -= 1
    return b"".join((*parts, content[kept:]))


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
