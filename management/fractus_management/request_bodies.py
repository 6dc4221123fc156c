"""Request bodies: validated by the models of the kinds, with the same rules and sentences as manifests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fractus_core.api import InvalidObject, Resource
from fractus_runtime.kubernetes import Body


def spec_of(kind: type[Resource]) -> Callable[[Any, Any], Any]:
    """Return a pydantic wrap validator for the specification of a kind."""

    def parse(value: Any, _handler: Any) -> Any:
        return parsed_spec(kind, value)

    return parse


def parsed_spec(kind: type[Resource], value: Any) -> Any:
    """Return the specification in a decoded request body.

    Raises:
        InvalidObject: The body is not a specification of the kind.
    """
    if isinstance(value, bytes):
        raise InvalidObject("", "send the body as JSON, with the header Content-Type: application/json")
    if not isinstance(value, dict):
        raise InvalidObject("", "the body must be a JSON object")
    namespaced = {"namespace": "default"} if kind.NAMESPACED else {}
    try:
        resource: Any = kind.from_body({"kind": kind.KIND, "metadata": {"name": "x", **namespaced}, "spec": value})
    except InvalidObject as error:
        raise InvalidObject(error.field.removeprefix("spec").removeprefix("."), error.problem) from None
    return resource.spec


def merged(target: Any, patch: Any) -> Any:
    """Apply a JSON merge patch (RFC 7396)."""
    if not isinstance(patch, dict):
        return patch
    result: Body = dict(target) if isinstance(target, dict) else {}
    for name, value in patch.items():
        if value is None:
            result.pop(name, None)
        else:
            result[name] = merged(result.get(name), value)
    return result
