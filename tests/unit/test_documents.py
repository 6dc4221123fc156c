"""Parser of YAML and JSON files of users: values, line numbers, limits and error messages."""

import json
import time

import pytest
from fractus_core import documents
from fractus_core.documents import BadDocument, dump_documents, parse_document, parse_documents

BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 30)
)


def parsed(text, **how):
    return parse_documents(text.encode(), "f.yaml", **how).values


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("", None), ("~", None), ("null", None),
        ("on", True), ("Yes", True), ("y", True), ("off", False), ("No", False),
        ("7", 7), ("-7", -7), ("+7", 7), ("010", 8), ("0o17", 15), ("0x1f", 31), ("-0b11", -3), ("1_000", 1000),
        ("08", 8.0), ("1e3", 1000.0), (".5", 0.5), ("-1.", -1.0), ("9223372036854775808", 9223372036854775808.0),
        ("__00", "__00"), (".5_0", ".5_0"), ("10:00", "10:00"), ("2026-01-01T00:00:00Z", "2026-01-01T00:00:00Z"), ("2026-01-01", "2026-01-01"),
        ("1.2.3", "1.2.3"), ("'5'", "5"), ('"on"', "on"), ("!!str 5", "5"), ("|-\n  5", "5"), ("=", "="),
    ],
)  # fmt: skip
def test_yaml_scalars_are_parsed_as_by_kubectl(text, value):
    ((parsed_value,),) = (tuple(mapping.values()) for mapping in parsed(f"a: {text}"))
    assert (parsed_value, type(parsed_value)) == (value, type(value))


def test_yaml_aliases_and_merges_are_expanded():
    (parsed_value,) = parsed("a: &a {p: 1, q: 2}\nb:\n  <<: *a\n  r: 3\nc: [*a, &n 5, *n]")
    assert parsed_value == {"a": {"p": 1, "q": 2}, "b": {"p": 1, "q": 2, "r": 3}, "c": [{"p": 1, "q": 2}, 5, 5]}


def test_json_is_parsed_as_by_json_module():
    text = '{"a": "\\ud83d\\ude00 \\/ \\\\ud83d\\u00e9",\n\t"b": [1, 2.5, true, null, "on"]}'
    assert parsed(text, is_json=True) == (json.loads(text),)


@pytest.mark.parametrize(
    "number", [0x7F, 0x80, 0x85, 0x9F, 0xA0, 0x2028, 0x2029, 0xFEFF, 0xFFFD, 0xFFFE, 0xFFFF, 0x10FFFF]
)
def test_json_accepts_characters_that_yaml_forbids(number):
    text = f'{{"a{chr(number)}": "b{chr(number)} c", "d": ["{chr(number)}\\u00e9"]}}'
    assert parsed(text, is_json=True) == (json.loads(text),)
    (parsed_value,) = parse_documents(f'{{"a": "{chr(number)}",\n"b": {{}}}}'.encode(), "f", is_json=True).values
    assert parsed_value == {"a": chr(number), "b": {}}


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("a: 1\nb: 2\na: 3", "f.yaml:3: a is also defined on line 1; remove one of them"),
        ("a:\n  b: {c: 1, d: 2, c: 1}", "f.yaml:2: c is also defined on line 2"),
        ("a: &a {p: 1}\nb: {<<: *a, p: 2}", "f.yaml:2: p is defined in this object and by <<; remove one of them"),
        ("a: &a [1, *a]", "f.yaml:1: *a refers to a value that contains it"),
        ("a: *b", "f.yaml:1: the anchor &b is not defined above"),
        ("a: &x 1\n---\nb: *x", "f.yaml:3: the anchor &x is not defined above"),
        ("a: 1\nb: !!python/object/apply:os.system [ls]", "f.yaml:2: the tag tag:yaml.org,2002:python/object/apply"),
        ("? [1]\n: 2", "f.yaml:1: a list or object cannot be a key"),
        ("a: &a {b: 1}\n*a : 2", "f.yaml:2: only a string can be a key"),
        ("<<: 3", "f.yaml:1: << requires an alias of an object"),
        ("a: 1e999", "f.yaml:1: 1e999 exceeds the range of numbers"),
        ("a: .nan", "f.yaml:1: .nan is not a JSON number"),
        ("a: " + "9" * 5000, "f.yaml:1: a number has more than 300 digits"),
        ("a: [1,\nb\n", "f.yaml:3: invalid YAML"),
        ("a: 1\nb: '\x01'", "f.yaml:2: invalid YAML: control characters are not allowed"),
        ("[" * 100_000, "f.yaml:1: lists or objects are nested deeper than 100 levels"),
        ("- " * 100_000, "f.yaml:1: lists or objects are nested deeper than 100 levels"),
        (BOMB, "f.yaml:6: aliases repeat more than 100000 values"),
    ],
)  # fmt: skip
def test_invalid_yaml_error_has_line(text, sentence):
    begun = time.process_time()
    with pytest.raises(BadDocument) as refused:
        parsed(text)
    assert str(refused.value).startswith(sentence)
    assert time.process_time() - begun < 1


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('{\n"kind": }', "f.yaml:2: invalid JSON: expecting value"),
        ('{\n"a": 1,\n"a": 1}', "f.yaml:3: a is also defined on line 2"),
        ('{"a": 1} # no', "f.yaml:1: invalid JSON: extra data"),
        ('{"a": NaN}', "f.yaml: NaN is not a JSON number"),
        ('{"a":' * 100_000, "f.yaml: lists or objects are nested deeper"),
        ('{"a":' * 200 + "1" + "}" * 200, "f.yaml:1: lists or objects are nested deeper"),
    ],
)
def test_invalid_json_error_has_line(text, sentence):
    with pytest.raises(BadDocument) as refused:
        parsed(text, is_json=True)
    assert str(refused.value).startswith(sentence)


def test_document_limits_are_enforced(monkeypatch):
    for name, value, sentence in (("MAX_NODES", 10, "more than 10 values"), ("MAX_BYTES", 0, "larger than 0 MiB")):
        with monkeypatch.context() as patched, pytest.raises(BadDocument, match=sentence):
            patched.setattr(documents, name, value)
            parsed("[1, 2, 3, 4, 5, 6, 7, 8, 9, 10]")
    with pytest.raises(BadDocument, match="f:2: not a UTF-8 text file"):
        parse_documents(b"a: 1\nb: \xff", "f")
    with pytest.raises(BadDocument, match="f:3: the file has a second document; remove it"):
        parse_document(b"a: 1\n---\nb: 1", "f")
    assert parse_document(b"", "f")[0] is None


def test_document_returns_line_of_field():
    text = "---\nkind: A\nspec:\n  list:\n    - {p: 1}\n    -\n      p: 2\n      q: [3]\n---\nkind: B\n"
    parsed_value = parse_documents(text.encode(), "f")
    first, second = parsed_value.values
    paths = {"": 2, "spec": 3, "spec.list[0].p": 5, "spec.list[1].q[0]": 8, "spec.list[7].q": 4, "spec.lost": 3}
    assert {path: parsed_value.line(first, path) for path in paths} == paths
    assert parsed_value.where(second, "kind") == "f:10"
    assert parsed_value.where({}) == "f"


def test_large_zone_is_parsed_within_four_seconds():
    text = "ring:\n" + "".join(f"  - {{lat: {50 + i / 1e6}, lon: {4 + i / 1e6}}}\n" for i in range(50_000))
    begun = time.process_time()
    (parsed_value,) = parsed(text)
    assert time.process_time() - begun < 4
    assert len(parsed_value["ring"]) == 50_000


def test_dumped_documents_are_parsed_unchanged():
    texts = [
        "",
        "on",
        "n",
        "Y",
        "1e3",
        "0x1",
        "010",
        "1_0",
        "+.5",
        "10:00",
        "2026-01-01",
        "null",
        "<<",
        "é\n\t\u2028",
        "#",
    ]
    same = {"lat": 1.5}
    values = ({"a": [*texts, 1.5, 1e300, -3, None, True, same, same], **dict.fromkeys(texts, 5)}, {"n": "n"})
    assert parsed(dump_documents(values)) == values
    assert "&id" not in dump_documents(values)
