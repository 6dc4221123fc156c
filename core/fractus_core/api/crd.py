"""CRD generator: `python -m fractus_core.api.crd DIR` writes one manifest per kind.

Kubernetes requires structural schemas (inline, typed, no $ref, no null), but pydantic writes JSON Schema 2020-12. This
module converts the schemas and raises an error for any keyword that it does not know, so that no rule is lost.
"""

from __future__ import annotations

import pathlib
import sys
from typing import Any

from fractus_core.api import KINDS
from fractus_core.api.model import GROUP, VALIDATIONS, VERSION, Resource
from fractus_core.documents import dump_documents

Schema = dict[str, Any]

_KEPT = {
    "type", "description", "enum", "minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum", "minLength",
    "maxLength", "pattern", "minItems", "maxItems", "minProperties", "maxProperties", "required", "format", "default",
    "x-kubernetes-validations", "x-kubernetes-list-type", "x-kubernetes-list-map-keys",
    "x-kubernetes-preserve-unknown-fields", "x-kubernetes-int-or-string",
}  # fmt: skip
_DROPPED = {"title", "additionalProperties", "properties", "items", "anyOf", "$ref", "const", "$defs", "examples"}


def crd(kind: type[Resource]) -> Schema:
    """Return the CustomResourceDefinition of a kind."""
    schema = kind.model_json_schema(by_alias=True, mode="validation")
    definitions = schema.get("$defs", {})
    properties = {
        "apiVersion": {"type": "string"},
        "kind": {"type": "string"},
        "metadata": {"type": "object"},
    }
    for name in ("spec", "status"):
        if name in schema["properties"]:
            properties[name] = structural(schema["properties"][name], definitions, f"{kind.KIND}.{name}")
    root = {VALIDATIONS: schema[VALIDATIONS]} if VALIDATIONS in schema else {}
    if kind.WRITTEN_BY_OPERATOR:
        properties = {name: _without_rules(schema) for name, schema in properties.items()}
    version: Schema = {
        "name": VERSION,
        "served": True,
        "storage": True,
        "schema": {
            "openAPIV3Schema": {
                "type": "object",
                "description": (kind.__doc__ or "").strip(),
                "properties": properties,
                "required": ["spec"],
                **root,
            }
        },
        "additionalPrinterColumns": [
            {"name": title, "type": type_, "jsonPath": path} for title, type_, path in kind.COLUMNS
        ],
    }
    if "status" in properties:
        version["subresources"] = {"status": {}}
    if kind.SELECTABLE:
        version["selectableFields"] = [{"jsonPath": path} for path in kind.SELECTABLE]
    return {
        "apiVersion": "apiextensions.k8s.io/v1",
        "kind": "CustomResourceDefinition",
        "metadata": {"name": f"{kind.PLURAL}.{GROUP}"},
        "spec": {
            "group": GROUP,
            "scope": "Namespaced" if kind.NAMESPACED else "Cluster",
            "names": {
                "kind": kind.KIND,
                "listKind": f"{kind.KIND}List",
                "plural": kind.PLURAL,
                "singular": kind.KIND.lower(),
                "shortNames": [kind.SHORT],
                "categories": ["fractus"],
            },
            "versions": [version],
        },
    }


def _without_rules(schema: Schema) -> Schema:
    """Return the schema without CEL rules at any depth."""
    out: Schema = {key: value for key, value in schema.items() if key != "x-kubernetes-validations"}
    for key in ("items", "additionalProperties"):
        if isinstance(out.get(key), dict):
            out[key] = _without_rules(out[key])
    if "properties" in out:
        out["properties"] = {name: _without_rules(value) for name, value in out["properties"].items()}
    return out


def structural(schema: Schema, definitions: dict[str, Schema], path: str) -> Schema:
    """Convert a JSON Schema to a Kubernetes structural schema.

    Raises:
        ValueError: The schema uses a keyword that has no structural form.
    """
    merged = _resolved(schema, definitions)
    unknown = set(merged) - _KEPT - _DROPPED
    if unknown:
        raise ValueError(f"{path}: no structural form for {', '.join(sorted(unknown))}")
    out: Schema = {k: v for k, v in merged.items() if k in _KEPT}
    if "const" in merged:
        out["enum"] = [merged["const"]]
    if "anyOf" in merged:
        out.update(_union(merged["anyOf"], definitions, path))
    if "properties" in merged:
        out["properties"] = {
            name: structural(value, definitions, f"{path}.{name}") for name, value in merged["properties"].items()
        }
    elif isinstance(merged.get("additionalProperties"), dict):
        out["additionalProperties"] = structural(merged["additionalProperties"], definitions, f"{path}.*")
    if "items" in merged:
        out["items"] = structural(merged["items"], definitions, f"{path}[]")
    for bound in ("Minimum", "Maximum"):
        exclusive = out.pop(f"exclusive{bound}", None)
        if exclusive is not None:
            out[bound.lower()] = exclusive
            out[f"exclusive{bound}"] = True
    default = out.get("default")
    if default is None or default in ([], {}, ""):
        out.pop("default", None)
    return out


def _resolved(schema: Schema, definitions: dict[str, Schema]) -> Schema:
    """Return the schema with its reference and its nullable wrapper replaced by their content.

    Keywords next to the reference override keywords in its content.
    """
    merged = dict(schema)
    while True:
        if "$ref" in merged:
            name = merged.pop("$ref").rsplit("/", 1)[1]
            merged = {**definitions[name], **merged}
            continue
        options = [o for o in merged.get("anyOf", ()) if o.get("type") != "null"]
        if len(options) == 1:
            del merged["anyOf"]
            merged = {**options[0], **merged}
            continue
        return merged


def _union(options: list[Schema], definitions: dict[str, Schema], path: str) -> Schema:
    kinds = sorted(_resolved(o, definitions).get("type", "") for o in options if o.get("type") != "null")
    if kinds == ["integer", "string"]:
        return {"x-kubernetes-int-or-string": True, "anyOf": [{"type": "integer"}, {"type": "string"}]}
    raise ValueError(f"{path}: a union of {kinds} has no structural form")


def write(directory: pathlib.Path) -> None:
    """Write crds/<plural>.yaml for every kind."""
    directory.mkdir(parents=True, exist_ok=True)
    for kind in KINDS:
        text = "# Generated from the models in core/fractus_core/api; change those, then run `make generate`.\n"
        text += dump_documents([crd(kind)])
        (directory / f"{kind.PLURAL}.yaml").write_text(text)


if __name__ == "__main__":
    write(pathlib.Path(sys.argv[1]))
