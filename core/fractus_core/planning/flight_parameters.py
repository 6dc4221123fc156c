"""Parameters of flight plans, and the JSON schema (2020-12) with which a template describes them.

Templates and parameters come from users, and the operator validates them between two decisions. Therefore sizes are limited, and
keywords are refused whose validation may take unlimited time or reads other documents.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from jsonschema import Draft202012Validator
from jsonschema.exceptions import SchemaError, ValidationError, best_match

from fractus_core.api.flight_plans import ApplicationTemplate, FlightPlan
from fractus_core.api.model import InvalidObject

MAX_SCHEMA_BYTES = 16_384
"""Maximum size of a schema as JSON."""

MAX_SCHEMA_DEPTH = 16
"""Maximum nesting of subschemas."""

MAX_PARAMETERS_BYTES = 16_384
"""Maximum size of the parameters as JSON. They are an environment variable, which Linux limits to 128 KiB."""

MAX_NESTING = 64
"""Maximum nesting of lists and objects in a schema and in parameters."""

MAX_COMPARISONS = 50_000
"""Maximum product of the numbers of values in a schema and in parameters. The validation may compare each value with each part of
the schema, and takes up to about 10 µs for a comparison."""

_MAX_FIELD = 200
"""Maximum length of the path of a field, whose names come from users, in characters."""

_MAX_SENTENCE = 300
"""Maximum length of the reason of a refusal, which may quote a value, in characters."""

_DIALECT = "https://json-schema.org/draft/2020-12/schema"

_REFUSED = {
    "$ref": "write the referenced schema in its place",
    "$dynamicRef": "write the referenced schema in its place",
    "pattern": "use enum, format or maxLength",
    "patternProperties": "use properties",
    "unevaluatedItems": "use items",
    "unevaluatedProperties": "use additionalProperties",
    "uniqueItems": "use maxItems and enum",
}
"""Refused keywords, each with the remedy."""

_ONE = ("additionalProperties", "contains", "else", "if", "items", "not", "propertyNames", "then")
_LISTS = ("allOf", "anyOf", "oneOf", "prefixItems")
_MAPS = ("$defs", "dependentSchemas", "properties")
"""Keywords whose value is a schema, a list of schemas, or a mapping with schemas."""


def check_parameter_schema(schema: dict[str, Any]) -> None:
    """Check the schema of a template.

    Raises:
        InvalidObject: The schema is not valid in the draft 2020-12, is too large, or uses a refused keyword.
    """
    _count("the schema", schema)
    size = len(json.dumps(schema))
    if size > MAX_SCHEMA_BYTES:
        message = f"the schema has {size} bytes as JSON, more than {MAX_SCHEMA_BYTES}; shorten it"
        raise InvalidObject("parameters", message)
    if schema.get("$schema", _DIALECT) != _DIALECT:
        raise InvalidObject("parameters.$schema", f"must be {_DIALECT}, or be removed")
    for field, part in _subschemas("parameters", schema, MAX_SCHEMA_DEPTH):
        # Another draft has other keywords with subschemas, which are not checked here.
        for keyword in ("$schema", "$id"):
            if part is not schema and keyword in part:
                raise InvalidObject(f"{field}.{keyword}", "only the whole schema may have it; remove it")
        for keyword in sorted(part.keys() & _REFUSED.keys()):
            raise InvalidObject(f"{field}.{keyword}", f"the keyword is not permitted; {_REFUSED[keyword]}")
    try:
        Draft202012Validator.check_schema(schema)
    except SchemaError as error:
        raise InvalidObject(_field("parameters", error), _sentence(error)) from None


def check_parameters(plan: FlightPlan, template: ApplicationTemplate) -> None:
    """Check the parameters of a plan against the schema of its template.

    Raises:
        InvalidObject: The parameters violate the schema, or are too large, or the schema itself is invalid.
    """
    schema = template.spec.parameters
    parameters = plan.spec.parameters
    if not schema:
        if parameters:
            message = f"ApplicationTemplate {template.name} has no parameters; remove it"
            raise InvalidObject(f"parameters.{next(iter(parameters))}"[:_MAX_FIELD], message)
        return
    try:
        check_parameter_schema(schema)
    except InvalidObject as error:
        message = (
            f"ApplicationTemplate {template.name} has an invalid schema ({error}); ask its developer for a correction"
        )
        raise InvalidObject("parameters", message) from None
    count = _count("the parameters", parameters)
    size = len(json.dumps(parameters))
    if size > MAX_PARAMETERS_BYTES:
        message = f"the parameters have {size} bytes as JSON, more than {MAX_PARAMETERS_BYTES}; shorten them"
        raise InvalidObject("parameters", message)
    most = MAX_COMPARISONS // _count("the schema", schema)
    if count > most:
        message = f"{count} values are more than the {most} that the schema permits with its size; use fewer values"
        raise InvalidObject("parameters", message)
    violation = best_match(Draft202012Validator(schema).iter_errors(parameters))
    if violation is not None:
        required = f"; see the schema of ApplicationTemplate {template.name}"
        raise InvalidObject(_field("parameters", violation), _sentence(violation) + required)


def _count(name: str, value: Any) -> int:
    """Return the number of values in a JSON value, including lists and objects.

    Raises:
        InvalidObject: The nesting exceeds `MAX_NESTING`.
    """
    count = 0
    level = [value]
    for _ in range(MAX_NESTING + 1):
        count += len(level)
        collections = [each for each in level if isinstance(each, dict | list)]
        if not collections:
            return count
        level = [child for each in collections for child in (each.values() if isinstance(each, dict) else each)]
    raise InvalidObject("parameters", f"{name}: values are nested more than {MAX_NESTING} levels deep; nest them less")


def _subschemas(field: str, schema: Any, depth: int) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield a schema and its subschemas with their fields. Values that are no schemas are ignored.

    Raises:
        InvalidObject: The nesting exceeds `depth`.
    """
    if not isinstance(schema, dict):
        return
    if depth == 0:
        raise InvalidObject(
            "parameters", f"the schema is nested more than {MAX_SCHEMA_DEPTH} levels deep; nest it less"
        )
    yield field, schema
    for keyword in schema.keys() & {*_ONE, *_LISTS, *_MAPS}:
        value = schema[keyword]
        parts: list[tuple[str, Any]] = []
        if keyword in _ONE:
            parts = [(keyword, value)]
        elif keyword in _LISTS and isinstance(value, list):
            parts = [(f"{keyword}[{index}]", each) for index, each in enumerate(value)]
        elif keyword in _MAPS and isinstance(value, dict):
            parts = [(f"{keyword}.{name}", each) for name, each in value.items()]
        for name, each in parts:
            yield from _subschemas(f"{field}.{name}", each, depth - 1)


def _field(begin: str, error: ValidationError | SchemaError) -> str:
    """Return the path of the value that violates a schema. For a missing property, this is the path of its object."""
    field = begin
    for part in error.absolute_path:
        field += f"[{part}]" if isinstance(part, int) else f".{part}"
    return field if len(field) <= _MAX_FIELD else f"{field[:_MAX_FIELD]} ..."


def _sentence(error: ValidationError | SchemaError) -> str:
    message = str(error.message)
    return message if len(message) <= _MAX_SENTENCE else f"{message[:_MAX_SENTENCE]} ..."
