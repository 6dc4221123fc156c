"""Parameters of flight plans, and the schemas of templates."""

import pytest
from fractus_core.api import InvalidObject
from fractus_core.planning.flight_parameters import MAX_SCHEMA_DEPTH, check_parameter_schema, check_parameters
from test_ordered_applications import flight, template

SCHEMA = {
    "type": "object",
    "required": ["speed"],
    "additionalProperties": False,
    "properties": {
        "speed": {"type": "number", "minimum": 0, "maximum": 10},
        "names": {"type": "array", "items": {"type": "string"}},
        "pattern": {"enum": ["lanes", "spiral"]},
    },
}


def nested(levels):
    schema = {"type": "number"}
    for _ in range(levels):
        schema = {"items": schema}
    return schema


def test_parameters_that_fit_the_schema_are_accepted():
    check_parameters(flight(parameters={"speed": 3, "names": ["a"], "pattern": "lanes"}), template(parameters=SCHEMA))
    check_parameters(flight(), template())


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"speed": 30}, "parameters.speed: 30 is greater than the maximum of 10"),
        ({"speed": "fast"}, "parameters.speed: 'fast' is not of type 'number'"),
        ({}, "parameters: 'speed' is a required property"),
        ({"speed": 1, "sped": 2}, "'sped' was unexpected"),
        ({"speed": 1, "names": ["a", 2]}, "parameters.names[1]: 2 is not of type 'string'"),
        ({"speed": 1, "pattern": "zigzag"}, "parameters.pattern: 'zigzag' is not one of ['lanes', 'spiral']"),
        ({"speed": "x" * 20_000}, "more than 16384"),
        ({"speed": "x" * 10_000}, "x ...; see the schema of ApplicationTemplate survey"),
    ],
)
def test_parameter_that_violates_the_schema_is_named(parameters, sentence):
    with pytest.raises(InvalidObject) as refused:
        check_parameters(flight(parameters=parameters), template(parameters=SCHEMA))
    assert sentence in str(refused.value)
    assert len(str(refused.value)) < 500


def test_template_without_schema_has_no_parameters():
    with pytest.raises(
        InvalidObject, match=r"parameters\.speed: ApplicationTemplate survey has no parameters; remove it"
    ):
        check_parameters(flight(parameters={"speed": 3}), template())


@pytest.mark.parametrize(
    ("schema", "sentence"),
    [
        ({"type": "text"}, "parameters.type"),
        (
            {"properties": {"speed": {"minimum": "0"}}},
            "parameters.properties.speed.minimum: '0' is not of type 'number'",
        ),
        ({"$schema": "http://json-schema.org/draft-07/schema#"}, "parameters.$schema: must be https"),
        ({"properties": {"a": {"$ref": "https://example.org/a"}}}, "parameters.properties.a.$ref: the keyword"),
        ({"$ref": "#"}, "write the referenced schema in its place"),
        ({"anyOf": [{"items": {"pattern": "^(a+)+$"}}]}, "parameters.anyOf[0].items.pattern: the keyword"),
        ({"description": "x" * 20_000}, "more than 16384"),
        (nested(MAX_SCHEMA_DEPTH), "nested more than 16 levels"),
    ],
)
def test_invalid_schema_is_refused_with_its_field(schema, sentence):
    with pytest.raises(InvalidObject) as refused:
        check_parameter_schema(schema)
    assert sentence in str(refused.value)
    with pytest.raises(InvalidObject, match="ApplicationTemplate survey has an invalid schema"):
        check_parameters(flight(), template(parameters=schema))


def test_schema_may_have_a_property_with_the_name_of_a_keyword():
    check_parameter_schema(SCHEMA)
    check_parameter_schema({"properties": {"$ref": {"const": {"pattern": "("}}}} | nested(MAX_SCHEMA_DEPTH - 1))
