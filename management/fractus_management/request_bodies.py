"""Request bodies: validated by the models of the kinds, with the same rules and sentences as manifests."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from fractus_core.api import InvalidObject, Resource
from fractus_runtime.kubernetes import Body

MAX_DEPTH = 100
"""Maximum nesting of a body. Deeper bodies would exceed the recursion limit of Python."""


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
    check_values(value)
    namespaced = {"namespace": "default"} if kind.NAMESPACED else {}
    try:
        resource: Any = kind.from_body({"kind": kind.KIND, "metadata": {"name": "x", **namespaced}, "spec": value})
    except InvalidObject as error:
        raise InvalidObject(error.field.removeprefix("spec").removeprefix("."), error.problem) from None
    return resource.spec


def check_values(body: Any) -> None:
    """Check the values of a decoded body. Python's decoder accepts NaN and Infinity, which JSON does not contain.

    Raises:
        InvalidObject: A number is not finite, or the body is nested too deeply.
    """
    remaining = [("", body, 0)]
    while remaining:
        field, value, depth = remaining.pop()
        if depth > MAX_DEPTH:
            raise InvalidObject("", f"the body is nested more than {MAX_DEPTH} levels deep; nest it less")
        if isinstance(value, float) and not math.isfinite(value):
            raise InvalidObject(field.removeprefix("."), f"must be a finite number, not {value}")
        if isinstance(value, dict):
            remaining += [(f"{field}.{name}", each, depth + 1) for name, each in value.items()]
        elif isinstance(value, list):
            remaining += [(f"{field}[{index}]", each, depth + 1) for index, each in enumerate(value)]


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
