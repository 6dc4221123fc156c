"""The reference of everything that `import fractus` gives, generated from its docstrings: `python -m fractus.reference docs/reference/sdk.md`."""

from __future__ import annotations

import ast
import dataclasses
import enum
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fractus
from fractus.errors import FractusError

HEAD = """# Reference of the SDK

Everything that `import fractus` gives, generated from its docstrings by `make generate`. [sdk.md](../sdk.md) explains it.
`fractus.sync` has the same clients for programs without asyncio.
"""
_SECTION = re.compile(r"^(Args|Attributes|Returns|Raises|Yields):$")
_ENUM = re.compile(r"<(\w+\.\w+): [^>]*>")
_ENTRY = re.compile(r"^ {4}(\*{0,2}\w+): (.*)$")


def reference() -> str:
    """The page, as Markdown."""
    kinds = {name: getattr(fractus, name) for name in dir(fractus) if not name.startswith("_")}
    public = {name: kind for name, kind in kinds.items() if getattr(kind, "__module__", "").startswith("fractus.")}
    errors = {name: kind for name, kind in public.items() if isinstance(kind, type) and issubclass(kind, FractusError)}
    classes = {name: kind for name, kind in public.items() if isinstance(kind, type) and name not in errors}
    functions = {name: kind for name, kind in public.items() if not isinstance(kind, type)}
    lines = [HEAD, "## Functions"]
    for name, function in functions.items():
        lines += [f"### fractus.{name}", _signature(name, function), *_text(function)]
    lines.append("## Classes")
    for name, kind in classes.items():
        lines += [f"### fractus.{name}", *_text(kind), *_members(kind)]
    lines.append("## Errors")
    for name, kind in errors.items():
        remedy = f"Remedy: {kind.remedy}." if kind.remedy else ""
        bases = [base.__name__ for base in kind.__bases__ if base is not Exception]
        of = f"A `{bases[0]}`." if bases and bases[0] != "FractusError" else ""
        lines += [f"### fractus.{name}", *_text(kind), *filter(None, (of, remedy))]
    return "\n\n".join(lines) + "\n"


def _members(kind: type) -> Iterator[str]:
    if issubclass(kind, enum.Enum):
        yield "Values: " + ", ".join(f"`{member.name}`" for member in kind) + "."
        return
    if dataclasses.is_dataclass(kind):
        yield "Fields: " + ", ".join(f"`{field.name}: {field.type}`" for field in dataclasses.fields(kind)) + "."
    noted = _noted(kind)
    if noted:
        yield "\n".join(f"- `{name}`: {text}" for name, text in noted.items())
    for name, member in inspect.getmembers(kind):
        if name.startswith("_") or name in {"from_proto", "to_proto", "from_manifest", "begin", "end", "ready"}:
            continue
        if isinstance(member, property):
            yield f"#### {kind.__name__}.{name}"
            yield from _text(member)
        elif inspect.isfunction(member):
            yield f"#### {kind.__name__}.{name}"
            yield _signature(name, member)
            yield from _text(member)


def _noted(kind: type) -> dict[str, str]:
    """Attributes that a constructor sets and documents on the lines that follow."""
    init = kind.__dict__.get("__init__")
    if not inspect.isfunction(init) or dataclasses.is_dataclass(kind):
        return {}
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(init))).body
    assert isinstance(tree, ast.FunctionDef)
    found = {}
    for statement, after in zip(tree.body, tree.body[1:], strict=False):
        targets = statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
        if (
            isinstance(targets[0], ast.Attribute)
            and isinstance(after, ast.Expr)
            and isinstance(after.value, ast.Constant)
        ):
            found[targets[0].attr] = str(after.value.value)
    return found


def _signature(name: str, function: Any) -> str:
    signature = inspect.signature(function)
    parameters = [parameter for parameter in signature.parameters.values() if parameter.name != "self"]
    how = "async " if inspect.iscoroutinefunction(function) else ""
    told = _ENUM.sub(r"\1", str(signature.replace(parameters=parameters))).replace("'", "")
    return f"```python\n{how}def {name}{told}\n```"


def _text(kind: Any) -> Iterator[str]:
    """A docstring as Markdown: its sections as lists."""
    section = ""
    entries = list[str]()
    for block in (inspect.getdoc(kind) or "").split("\n\n"):
        paragraph = list[str]()
        for line in block.splitlines():
            if match := _SECTION.match(line):
                section = match[1]
            elif not section:
                paragraph.append(line)
            elif match := _ENTRY.match(line):
                entries.append(f"- `{match[1]}`: {match[2]}")
            elif section == "Returns":
                entries.append(line.strip())
            else:
                entries[-1] += f" {line.strip()}"
        if paragraph:
            yield "\n".join(paragraph)
        if section:
            joined = " ".join(entries) if section == "Returns" else "\n".join(entries)
            yield f"{section}: {joined}" if section == "Returns" else f"{section}:\n\n{joined}"
            section = ""
            entries = []


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(reference())
