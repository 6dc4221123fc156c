"""Parameters of flight plans, and the schemas of templates."""

import time

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


DRAFT_7 = "http://json-schema.org/draft-07/schema#"


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


def deep(levels):
    value = 1
    for _ in range(levels):
        value = {"a": value}
    return value


@pytest.mark.parametrize("levels", [65, 120])
def test_deeply_nested_values_are_refused(levels):
    with pytest.raises(InvalidObject, match="nested more than 64 levels deep"):
        check_parameters(flight(parameters={"speed": deep(levels)}), template(parameters={"type": "object"}))
    with pytest.raises(InvalidObject, match="nested more than 64 levels deep"):
        check_parameter_schema({"const": deep(levels)})


@pytest.mark.parametrize(
    "items", [{"anyOf": [{"const": 0}] * 1000}, {"enum": list(range(2000))}, {"required": ["a"] * 2000}]
)
def test_validation_takes_less_than_a_second_of_processor_time(items):
    schema = {"properties": {"list": {"items": items}}}
    for size in (20, 50, 5000):
        begin_s = time.process_time()
        with pytest.raises(InvalidObject):
            check_parameters(flight(parameters={"list": [{}] * size, "list2": 1}), template(parameters=schema))
        assert time.process_time() - begin_s < 2.0


def test_long_list_fits_a_small_schema():
    schema = {"properties": {"list": {"type": "array", "items": {"type": "number", "minimum": 0}}}}
    check_parameters(flight(parameters={"list": [1] * 5000}), template(parameters=schema))


@pytest.mark.parametrize("schema", [{}, {"additionalProperties": {"type": "number"}}])
def test_refusal_is_short_although_the_name_of_a_parameter_is_long(schema):
    with pytest.raises(InvalidObject) as refused:
        check_parameters(flight(parameters={"x" * 16_000: "a"}), template(parameters=schema))
    assert len(str(refused.value)) < 700


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
        ({"$schema": DRAFT_7}, "parameters.$schema: must be https"),
        ({"properties": {"a": {"$ref": "https://example.org/a"}}}, "parameters.properties.a.$ref: the keyword"),
        (
            {"properties": {"a": {"$schema": DRAFT_7, "dependencies": {"b": {"pattern": "^(a+)+$"}}}}},
            "parameters.properties.a.$schema: only the whole schema",
        ),
        (
            {"$id": "http://[::1", "properties": {"a": {"$id": "http://[::1"}}},
            "parameters.properties.a.$id: only the whole",
        ),
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
