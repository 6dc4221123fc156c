"""YAML and JSON parsing as in the API server, with resource limits and the line of each value.

Fractus reads a file like kubectl does. So plain scalars have the types that kubectl gives them: a timestamp is a string,
`on` is true, and 1e3 is a number. Duplicate keys are errors, and an alias counts as the values that it repeats. Values are
built from parser events, so the limits apply before memory is spent (docs/decisions/0019-yaml-from-parser-events.md).
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Hashable, Iterable
from dataclasses import dataclass, field
from typing import Any

import yaml

MAX_BYTES = 64 * 2**20
MAX_NODES = 5_000_000
"""Maximum number of scalars, lists and objects of a file, enough for 100,000 nodes with their interfaces."""
MAX_ALIASED = 100_000
"""Maximum number of values that aliases repeat. In an alias bomb, aliases repeat other aliases."""
MAX_DEPTH = 100
_MAX_DIGITS = 300

_CONSTANTS: dict[str, bool | None] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("y", "Y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON"), True),
    **dict.fromkeys(("n", "N", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF"), False),
}
_INTEGER = re.compile(r"[-+]?(?:0[xX][0-9a-fA-F]+|0[bB][01]+|0[oO]?[0-7]+|0|[1-9][0-9]*)")
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
_NOT_FINITE = re.compile(r"[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)")
_NOT_YAML = re.compile("[\x7f-\x9f\u2028\u2029\ufeff\ufffe\uffff]")
"""Characters that JSON strings may contain but YAML rejects or reads as line breaks."""
_SURROGATES = re.compile(r"\\(?:u([dD][89abAB][0-9a-fA-F]{2})\\u([dD][c-fC-F][0-9a-fA-F]{2})|.)", re.DOTALL)
_PART = re.compile(r"\.?([^.\[\]]+)|\[([0-9]+)\]")
_TEXT_TAGS = frozenset({"!", "tag:yaml.org,2002:str"})
_PLAIN_TAGS = frozenset({None, "!", "tag:yaml.org,2002:map", "tag:yaml.org,2002:seq"})

_Lines = dict[Hashable, int]


class _Dumper(yaml.CSafeDumper):
    """YAML writer without aliases. It quotes strings that other YAML parsers would read as numbers or booleans."""

    def ignore_aliases(self, data: object) -> bool:
        """Return True for every value, so that no aliases are written."""
        return True


_Dumper.add_implicit_resolver("tag:yaml.org,2002:bool", re.compile("[yYnN]$"), list("yYnN"))
_Dumper.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(f"(?:{_INTEGER.pattern}|{_FLOAT.pattern})$"), list("+-.0123456789")
)


def dump_documents(values: Iterable[Any]) -> str:
    """Return the values as a YAML stream that every YAML parser, including kubectl's, reads in the same way."""
    return yaml.dump_all(values, Dumper=_Dumper, sort_keys=False, width=120, allow_unicode=True)


class BadDocument(ValueError):
    """A file cannot be parsed. The message contains the file name and the line.

    Attributes:
        line: Line number, from 1, or 0 if the problem concerns the whole file.
        problem: Description of the problem, with the remedy.
    """

    def __init__(self, name: str, line: int, problem: str) -> None:
        self.line = line
        self.problem = problem
        super().__init__(f"{_file_line(name, line)}: {problem}")


def _file_line(name: str, line: int) -> str:
    return f"{name}:{line}" if line else name


@dataclass(frozen=True)
class Documents:
    """The documents of a file."""

    name: str
    values: tuple[Any, ...]
    _lines: dict[int, tuple[int, _Lines]] = field(repr=False)

    def where(self, value: object, path: str = "") -> str:
        """Return FILE:LINE of a list or object of these documents, or of the field at `path` below it."""
        return _file_line(self.name, self.line(value, path))

    def line(self, value: object, path: str = "") -> int:
        """Return the line of a list or object of these documents, or of the field at `path` below it.

        If only the first parts of the path exist, return the line of the last existing part, or 0 if no part exists.
        """
        line, fields = self._lines.get(id(value), (0, {}))
        for part in _PART.finditer(path):
            key: Hashable = part[1] or part[2]
            if isinstance(value, list):
                key = int(str(key)) if str(key).isdigit() else key
            if key not in fields:
                break
            line = fields[key]
            value = value[key]  # type: ignore[index]  # a value with fields is a list or a dict
            fields = self._lines.get(id(value), (0, {}))[1]
        return line


def _with_remedy(problem: str) -> str:
    """Return a problem that the YAML parser reports, with a remedy."""
    return f"{problem}; {next((remedy for part, remedy in _REMEDIES.items() if part in problem), _REMEDY)}"


_REMEDIES = {
    "tab character": "indent with spaces",
    "cannot start any token": "indent with spaces, and put a text that begins with a special character in quotes",
    "mapping values are not allowed": "put a text that contains a colon and a space in quotes, or correct the indentation",
    "control characters": "save the file as plain UTF-8 text",
    "quoted scalar": "close the quotes",
    "document indicator": "close the quotes and brackets before this line",
}
"""Remedies by a part of the parser's problem."""
_REMEDY = "check the indentation, brackets, commas and quotes on this line and the lines before"


def parse_documents(content: bytes, name: str, *, is_json: bool = False) -> Documents:
    """Parse a YAML stream, or a JSON file with `is_json`.

    Raises:
        BadDocument: The content cannot be parsed, has a duplicate key, or exceeds a limit.
    """
    if len(content) > MAX_BYTES:
        raise BadDocument(name, 0, f"the file is larger than {MAX_BYTES // 2**20} MiB; split it")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise BadDocument(name, line, "not a UTF-8 text file") from None
    if is_json:
        _check_json(text, name)
        text = _NOT_YAML.sub(lambda match: f"\\u{ord(match[0]):04x}", _SURROGATES.sub(_joined, text))
    reader = _Reader(name)
    try:
        for event in yaml.parse(text, Loader=yaml.CSafeLoader):
            reader.take(event)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark is not None else 0
        raise BadDocument(name, line, f"invalid YAML: {_with_remedy(error.problem or error.context or '')}") from None
    except yaml.YAMLError as error:
        line = text[: getattr(error, "position", 0)].count("\n") + 1
        raise BadDocument(
            name, line, f"invalid YAML: {_with_remedy(getattr(error, 'reason', None) or str(error))}"
        ) from None
    return Documents(name, tuple(reader.values), reader.lines)


def parse_document(content: bytes, name: str) -> tuple[Any, Documents]:
    """Parse a YAML file with at most one document.

    Returns:
        The document (None if the file is empty), and the lines of its values.

    Raises:
        BadDocument: The content cannot be parsed, or has several documents.
    """
    documents = parse_documents(content, name)
    if len(documents.values) > 1:
        line = documents.line(documents.values[1])
        raise BadDocument(name, line, "the file has a second document; remove it")
    return (documents.values[0] if documents.values else None), documents


def _check_json(text: str, name: str) -> None:
    def refuse_constant(word: str) -> None:
        raise BadDocument(name, 0, f"{word} is not a JSON number; use a finite number")

    try:
        json.loads(text, parse_int=len, parse_constant=refuse_constant)
    except json.JSONDecodeError as error:
        raise BadDocument(
            name, error.lineno, f"invalid JSON: {error.msg.lower()}; correct or export the file again"
        ) from None
    except RecursionError:
        raise BadDocument(
            name, 0, f"lists or objects are nested deeper than {MAX_DEPTH} levels; flatten them"
        ) from None


def _joined(escape: re.Match[str]) -> str:
    """Convert an escaped surrogate pair (JSON) to one escaped character (YAML)."""
    if escape[1] is None:
        return escape[0]
    return f"\\U{0x10000 + ((int(escape[1], 16) - 0xD800) << 10) + int(escape[2], 16) - 0xDC00:08x}"


_NO_KEY: Any = object()


class _OpenCollection:
    """A list or object whose end has not been read yet."""

    __slots__ = ("anchor", "before", "key", "line", "lines", "merged", "value")

    def __init__(self, value: Any, line: int, anchor: str | None, before: int) -> None:
        self.value = value
        self.line = line
        self.anchor = anchor
        self.before = before
        self.lines: _Lines = {}
        self.key: Any = _NO_KEY
        self.merged: list[dict[str, Any]] = []


class _Reader:
    """Builds values from parser events."""

    def __init__(self, name: str) -> None:
        self.values: list[Any] = []
        self.lines: dict[int, tuple[int, _Lines]] = {}
        self._name = name
        self._stack: list[_OpenCollection] = []
        self._anchors: dict[str, tuple[Any, int] | None] = {}
        self._nodes = 0
        self._aliased = 0

    def take(self, event: Any) -> None:
        """Process the next event."""
        kind = type(event)
        if kind is yaml.ScalarEvent:
            self._scalar(event)
        elif kind is yaml.MappingStartEvent or kind is yaml.SequenceStartEvent:
            self._open(event, {} if kind is yaml.MappingStartEvent else [])
        elif kind is yaml.MappingEndEvent or kind is yaml.SequenceEndEvent:
            self._close()
        elif kind is yaml.AliasEvent:
            self._alias(event)
        elif kind is yaml.DocumentStartEvent:
            self._anchors.clear()

    def _open(self, event: Any, value: Any) -> None:
        line = event.start_mark.line + 1
        if event.tag not in _PLAIN_TAGS:
            raise self._bad(line, f"the tag {event.tag} is not supported; remove it")
        if len(self._stack) >= MAX_DEPTH:
            raise self._bad(line, f"lists or objects are nested deeper than {MAX_DEPTH} levels; flatten them")
        if self._stack and self._expects_key():
            raise self._bad(line, "a list or object cannot be a key; put a text in braces in quotes")
        self._count(line)
        if event.anchor is not None:
            self._anchors[event.anchor] = None
        self._stack.append(_OpenCollection(value, line, event.anchor, self._nodes))

    def _close(self) -> None:
        done = self._stack.pop()
        for other in done.merged:
            for key, value in other.items():
                if key in done.value:
                    raise self._bad(done.line, f"{key} is defined in this object and by <<; remove one of them")
                done.value[key] = value
                done.lines[key] = done.line
        self.lines[id(done.value)] = done.line, done.lines
        if done.anchor is not None:
            self._anchors[done.anchor] = done.value, self._nodes - done.before + 1
        self._add(done.value, done.line)

    def _scalar(self, event: Any) -> None:
        line = event.start_mark.line + 1
        self._count(line)
        plain = event.implicit[0]
        if not plain and event.tag is not None and event.tag not in _TEXT_TAGS:
            raise self._bad(line, f"the tag {event.tag} is not supported; remove it")
        if self._stack and self._expects_key():
            value: Any = event.value
            if plain and value == "<<":
                value = yaml.MappingStartEvent
        else:
            value = self._typed(event.value, line) if plain else event.value
        if event.anchor is not None:
            self._anchors[event.anchor] = value, 1
        self._add(value, line)

    def _alias(self, event: Any) -> None:
        line = event.start_mark.line + 1
        if event.anchor not in self._anchors:
            raise self._bad(line, f"the anchor &{event.anchor} is not defined above; define it or correct the name")
        anchored = self._anchors[event.anchor]
        if anchored is None:
            raise self._bad(line, f"*{event.anchor} refers to a value that contains it; write out the value")
        value, weight = anchored
        self._aliased += weight
        self._nodes += weight - 1
        if self._aliased > MAX_ALIASED:
            raise self._bad(line, f"aliases repeat more than {MAX_ALIASED} values; use fewer aliases")
        self._count(line)
        if self._stack and self._expects_key() and not isinstance(value, str):
            raise self._bad(line, "only a string can be a key; correct it")
        self._add(value, line)

    def _expects_key(self) -> bool:
        top = self._stack[-1]
        return top.key is _NO_KEY and isinstance(top.value, dict)

    def _add(self, value: Any, line: int) -> None:
        if not self._stack:
            if value is not None:
                self.values.append(value)
            return
        top = self._stack[-1]
        if isinstance(top.value, list):
            top.lines[len(top.value)] = line
            top.value.append(value)
        elif top.key is _NO_KEY:
            top.key = value
            if value in top.lines:
                raise self._bad(line, f"{value} is also defined on line {top.lines[value]}; remove one of them")
            if isinstance(value, str):
                top.lines[value] = line
        elif top.key is yaml.MappingStartEvent:
            self._merge(top, value, line)
            top.key = _NO_KEY
        else:
            top.value[top.key] = value
            top.key = _NO_KEY

    def _merge(self, top: _OpenCollection, value: Any, line: int) -> None:
        parts = value if isinstance(value, list) else [value]
        if not all(isinstance(part, dict) for part in parts):
            raise self._bad(line, "<< requires an alias of an object, or a list of such aliases")
        top.merged += parts

    def _typed(self, text: str, line: int) -> Any:
        if text in _CONSTANTS:
            return _CONSTANTS[text]
        number = text.replace("_", "") if text[0] in "+-0123456789" else text
        if _INTEGER.fullmatch(number):
            digits = number.lstrip("+-")
            if len(digits) > _MAX_DIGITS:
                raise self._bad(line, f"a number has more than {_MAX_DIGITS} digits; correct it")
            if len(digits) > 1 and digits[0] == "0" and digits[1].isdigit():
                number = number.replace("0", "0o", 1)
            whole = int(number, 0)
            return whole if -(2**63) <= whole < 2**63 else float(whole)
        if _FLOAT.fullmatch(number):
            parsed = float(number)
            if not math.isfinite(parsed):
                raise self._bad(line, f"{text[:40]} exceeds the range of numbers; correct it")
            return parsed
        if _NOT_FINITE.fullmatch(text):
            raise self._bad(line, f"{text} is not a JSON number; use a finite number")
        return text

    def _count(self, line: int) -> None:
        self._nodes += 1
        if self._nodes > MAX_NODES:
            raise self._bad(line, f"the file has more than {MAX_NODES} values; split it")

    def _bad(self, line: int, problem: str) -> BadDocument:
        return BadDocument(self._name, line, problem)
