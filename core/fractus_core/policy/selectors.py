"""Policy selectors: the nodes, applications and components to which a policy applies (thesis Table 8.1, Listing 11)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import assert_never, get_args, get_origin

from pydantic import BaseModel
from pydantic.alias_generators import to_camel

from fractus_core.api import Application, Component, Drone, EdgeNode
from fractus_core.api.grants import ApplicationReference
from fractus_core.api.nodes import DroneSpec, EdgeNodeSpec
from fractus_core.api.policies import NodeExpression, PolicySpec


def policy_selects(
    policy: PolicySpec, application: Application, component: Component, attributes: Mapping[str, object]
) -> bool:
    """Return True if a policy applies to a component of an application on a node. Its zones are judged in flight."""
    return policy_applies(policy, application_reference(application), component.name, attributes)


def policy_applies(
    policy: PolicySpec, owner: ApplicationReference, component: str, attributes: Mapping[str, object]
) -> bool:
    """Return the result of `policy_selects`, computed from the references that a grant contains."""
    selected = policy.selector.applications
    unknown = policy.kind != "grant"
    if selected is not None:
        if selected.namespaces and owner.namespace not in selected.namespaces:
            return False
        if selected.names and owner.name not in selected.names:
            return False
        if selected.components and component not in selected.components:
            return False
    return all(matches(expression, attributes, unknown=unknown) for expression in policy.selector.nodes)


def matches(expression: NodeExpression, attributes: Mapping[str, object], *, unknown: bool) -> bool:
    """Return True if a node's attributes satisfy an expression. `unknown` is the result for an unset attribute.

    A restriction applies to a node that leaves the attribute unset (a drone of unknown mass counts as heavy). A
    permission does not. The same holds for an attribute that no node has, such as a mistyped one.
    """
    value = attributes.get(expression.key)
    if expression.operator == "Exists":
        return value is not None or (unknown and not is_attribute(expression.key))
    if value is None or isinstance(value, dict | list):
        return unknown
    match expression.operator:
        case "In":
            return str(value) in expression.values
        case "NotIn":
            return str(value) not in expression.values
        case "Gt" | "Lt":
            try:
                number = float(str(value))
            except ValueError:
                return unknown
            bound = float(expression.values[0])
            return number > bound if expression.operator == "Gt" else number < bound
        case _:
            assert_never(expression.operator)


def node_attributes(node: Drone | EdgeNode) -> dict[str, object]:
    """Return the attributes of a node for selectors: dotted paths of its spec, and their last part if that is unique.

    For example, `physicalFeatures.mtom` is also `mtom`. `name` and `kind` come from the object. Attributes with parts,
    such as `services.camera`, can only be tested for existence.
    """
    flat = dict(_flatten("", node.spec.to_dict()))
    short: dict[str, list[object]] = {}
    for path, value in flat.items():
        short.setdefault(path.rsplit(".", 1)[-1], []).append(value)
    attributes: dict[str, object] = {key: values[0] for key, values in short.items() if len(values) == 1}
    attributes.update(flat)
    attributes.update({f"labels.{k}": v for k, v in node.metadata.labels.items()})
    return {**attributes, "name": node.name, "kind": node.KIND}


def _flatten(prefix: str, value: object) -> Iterable[tuple[str, object]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _flatten(f"{prefix}.{key}" if prefix else key, inner)
    if prefix and value not in ({}, []):
        yield prefix, value


def is_attribute(key: str) -> bool:
    """Return True if a Drone or EdgeNode can have an attribute. Every label counts as possible."""
    return key in _attribute_keys() or key.startswith("labels.")


@cache
def _attribute_keys() -> frozenset[str]:
    paths = {*_paths("", DroneSpec), *_paths("", EdgeNodeSpec)}
    return frozenset({"name", "kind", *paths, *(path.rsplit(".", 1)[-1] for path in paths)})


def _paths(prefix: str, model: type[BaseModel]) -> Iterable[str]:
    for name, field in model.model_fields.items():
        path = f"{prefix}.{field.alias or to_camel(name)}".lstrip(".")
        yield path
        # Elements of lists are not attributes.
        listed = get_origin(field.annotation) is tuple
        for part in () if listed else (field.annotation, *get_args(field.annotation)):
            if isinstance(part, type) and issubclass(part, BaseModel):
                yield from _paths(path, part)


def application_reference(application: Application) -> ApplicationReference:
    """Return the reference to an application that its grants contain."""
    namespace, name = application.key
    return ApplicationReference(namespace=namespace, name=name, uid=application.metadata.uid or "")
