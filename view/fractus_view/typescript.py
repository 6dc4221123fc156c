"""Generates the TypeScript types of the page from the events: `python -m fractus_view.typescript view/web/src/events.ts`."""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, NotRequired, Union, get_args, get_origin, get_type_hints, is_typeddict

from fractus_view import events

_HEAD = "// Generated from view/fractus_view/events.py by `make generate`. Do not edit.\n"
_PRIMITIVES: Mapping[Any, str] = {
    str: "string",
    int: "number",
    float: "number",
    bool: "boolean",
    NoneType: "null",
    Any: "any",
}


def typescript_types() -> str:
    """Return the content of `events.ts`."""
    declared = [kind for kind in vars(events).values() if is_dataclass(kind) or is_typeddict(kind)]
    event_types = get_args(events.Event)
    interfaces = [_interface(kind, is_event=kind in event_types) for kind in declared]
    union = "\n".join(f"  | {kind.__name__}" for kind in event_types)
    markers = " | ".join(
        f'{{ type: "{json.loads(text)["type"]}" }}' for text in (events.RESET, events.LIVE, events.END)
    )
    parts = [
        *interfaces,
        f"export type Event =\n{union};\n",
        "/** Markers of the stream: the complete current state follows, later events are live, the recording has ended. */\n"
        f"export type Marker = {markers};\n",
    ]
    return "\n".join([_HEAD, *parts])


def _interface(kind: Any, *, is_event: bool) -> str:
    lines = list(_comment(kind))
    lines.append(f"export interface {kind.__name__} {{")
    if is_event:
        lines.append(f'  type: "{kind.__name__.lower()}";')
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if get_origin(hint) is NotRequired:
            lines.append(f"  {name}?: {_type(get_args(hint)[0])};")
        else:
            lines.append(f"  {name}: {_type(hint)};")
    return "\n".join([*lines, "}", ""])


def _comment(kind: Any) -> Iterator[str]:
    """Yield the lines of the documentation comment, which contains the docstring."""
    lines = (inspect.getdoc(kind) or "").replace("None", "null").splitlines()
    if len(lines) == 1:
        yield f"/** {lines[0]} */"
        return
    yield "/**"
    for line in lines:
        yield f" * {line}".rstrip()
    yield " */"


def _type(hint: Any) -> str:
    """Return the TypeScript type of the JSON value of a field."""
    arguments = get_args(hint)
    if hint in _PRIMITIVES:
        return _PRIMITIVES[hint]
    if get_origin(hint) in {Union, UnionType}:
        return " | ".join(_type(argument) for argument in arguments)
    if get_origin(hint) is Literal:
        return " | ".join(json.dumps(argument) for argument in arguments)
    if get_origin(hint) is Sequence:
        item = _type(arguments[0])
        return f"({item})[]" if " | " in item else f"{item}[]"
    return str(hint.__name__)


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(typescript_types())
