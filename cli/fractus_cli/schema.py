"""`fractus schema`: the JSON schema of manifests, for editors."""

from __future__ import annotations

import json
from typing import Any

import click
from fractus_core.api import API_VERSION, KINDS
from pydantic.json_schema import models_json_schema


def manifest_schema() -> dict[str, Any]:
    """Return the JSON schema of manifests of all kinds. Manifests of other API groups are valid, whatever they contain."""
    _, definitions = models_json_schema([(kind, "validation") for kind in KINDS])
    of_fractus = {"properties": {"apiVersion": {"const": API_VERSION}}, "required": ["apiVersion"]}
    kinds = [
        {"if": {"properties": {"kind": {"const": kind.KIND}}}, "then": {"$ref": f"#/$defs/{kind.__name__}"}}
        for kind in KINDS
    ]
    kind = {"enum": [kind.KIND for kind in KINDS]}
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": f"Manifests of {API_VERSION}",
        "type": "object",
        "if": of_fractus,
        "then": {"properties": {"kind": kind}, "required": ["kind"], "allOf": kinds},
        **definitions,
    }


@click.command()
def schema() -> None:
    """Print the JSON schema of manifests, with which editors check and complete them.

    With the YAML language server (VS Code and others), store it with `fractus schema > fractus.schema.json` and begin each
    manifest with the line: # yaml-language-server: $schema=fractus.schema.json
    """
    click.echo(json.dumps(manifest_schema(), indent=2))
