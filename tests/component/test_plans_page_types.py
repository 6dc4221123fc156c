"""Types of the page of flight plans: they agree with the description of the management API."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
TYPES = (ROOT / "view/web/src/plans/types.ts").read_text()
SCHEMAS: dict[str, Any] = json.loads((ROOT / "management/openapi.json").read_text())["components"]["schemas"]
INTERFACES = dict(re.findall(r"export interface (\w+) \{\n(.*?)\n\}", TYPES, re.DOTALL))


def typescript(schema: dict[str, Any]) -> str:
    """Return the type of a schema as `types.ts` writes it."""
    if "anyOf" in schema:
        return " | ".join(typescript(each) for each in schema["anyOf"])
    if "$ref" in schema:
        return str(schema["$ref"]).rpartition("/")[2]
    if schema["type"] == "array":
        return f"{typescript(schema['items'])}[]"
    return {"integer": "number"}.get(schema["type"], schema["type"])


@pytest.mark.parametrize("name", INTERFACES)
def test_typescript_type_agrees_with_the_description_of_the_api(name: str) -> None:
    schema = SCHEMAS[name]
    fields = re.findall(r"^  (\w+)(\??): (.+);$", INTERFACES[name], re.MULTILINE)
    assert len(fields) == len(INTERFACES[name].splitlines())
    for field, optional, type_ in fields:
        property_ = schema["properties"][field]
        assert type_ == typescript(property_), field
        assert not optional or field not in schema.get("required", ()), field
        assert optional or field in schema["required"], field
