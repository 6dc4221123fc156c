"""What the site has beside the files of docs/: pages of the repository's root, and the reference, generated from the code.

A hook of MkDocs, see mkdocs.yml. Run as a program, it writes the charts' README.md.
"""

from __future__ import annotations

import json
import posixpath
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import yaml
from fractus_cli.main import fractus
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from grpc_tools import protoc
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parent.parent
PROTO = ROOT / "proto"
ROOT_PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "CHANGELOG.md": "changelog.md",
    "examples/heuristic-plugin/README.md": "heuristics.md",
}
"""Where files outside of docs/ are on the site."""

_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)#\s]+)(#[^)\s]*)?\)")
_VALUE = re.compile(r"^( *)(\w[\w-]*):(?: +(.*))?$")


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the pages that are not in docs/."""
    texts = {site: (ROOT / name).read_text() for name, site in ROOT_PAGES.items()}
    texts |= {
        "decisions/index.md": "\n\n".join(decisions()),
        "reference/kinds.md": "\n\n".join(kinds()),
        "reference/calls.md": "\n\n".join(calls()),
        "reference/values.md": "\n\n".join(values()),
        "reference/commands.md": "\n\n".join(commands()),
    }
    for path, text in texts.items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links to where a file is on the site; what the site does not have is named without a link."""
    source = next((name for name, site in ROOT_PAGES.items() if site == page.file.src_uri), None)
    folder = posixpath.dirname(source or "docs/" + page.file.src_uri)

    def led(found: re.Match[str]) -> str:
        mark = found.group(1)
        text = found.group(2)
        target = found.group(3)
        anchor = found.group(4) or ""
        if "://" in target or target.startswith(("mailto:", "/")):
            return found.group()
        path = posixpath.normpath(posixpath.join(folder, target))
        site = ROOT_PAGES.get(path) or (path.removeprefix("docs/") if path.startswith("docs/") else None)
        if path == "docs/decisions":
            site = "decisions/index.md"
        if site is None or files.get_file_from_path(site) is None:
            return text if text.startswith("`") or mark else f"{text} (`{path}`)" if text != path else f"`{text}`"
        here = posixpath.dirname(page.file.src_uri)
        return f"{mark}[{text}]({posixpath.relpath(site, here or '.')}{anchor})"

    return _LINK.sub(led, markdown)


def decisions() -> Iterator[str]:
    """The list of decisions."""
    yield "# Decisions"
    found = sorted((ROOT / "docs" / "decisions").glob("*.md"))
    yield "\n".join(f"- [{path.read_text().splitlines()[0].lstrip('# ')}]({path.name})" for path in found)


def kinds() -> Iterator[str]:
    """Every field of every kind, from the CustomResourceDefinitions."""
    yield "# Kinds"
    yield "All are of the group `fractus.dev`, version `v1alpha1`; `kubectl explain KIND.spec` says the same."
    for path in sorted((ROOT / "crds").glob("*.yaml")):
        body = yaml.safe_load(path.read_text())["spec"]
        names = body["names"]
        schema = body["versions"][0]["schema"]["openAPIV3Schema"]
        short = ", ".join(f"`{name}`" for name in names.get("shortNames", ()))
        yield f"## {names['kind']}"
        yield f"{schema.get('description', '')} {body['scope']}; `kubectl get {names['plural']}`, short {short}."
        for part in ("spec", "status"):
            if part in schema["properties"]:
                yield f"### {names['kind']}.{part}"
                rows = _fields(schema["properties"][part], "")
                yield "\n".join(["| Field | Type | Meaning |", "|---|---|---|", *rows])
                rules = [rule["message"] for rule in schema["properties"][part].get("x-kubernetes-validations", ())]
                if rules:
                    yield "Rules:"
                    yield "\n".join(f"- {_cell(message)}" for message in rules)


def _fields(schema: dict[str, Any], above: str) -> Iterator[str]:
    required = set(schema.get("required", ()))
    for name, field in schema.get("properties", {}).items():
        path = f"{above}{name}"
        inner = field
        kind = field.get("type", "any")
        if kind == "array":
            inner = field["items"]
            path = f"{path}[]"
            kind = f"list of {inner.get('type', 'any')}"
        bounds = [
            f"{field[key]} {word}" for key, word in (("minimum", "or more"), ("maximum", "at most")) if key in field
        ]
        bounds += [f"default {field['default']}"] if "default" in field else []
        if "enum" in inner:
            bounds.append("one of " + ", ".join(str(value) for value in inner["enum"]))
        bounds += ["required"] if name in required else []
        meaning = field.get("description") or inner.get("description") or ""
        yield f"| `{path}` | {_cell('; '.join([kind, *bounds]))} | {_cell(meaning)} |"
        yield from _fields(inner, f"{path}.")


def calls() -> Iterator[str]:
    """Services and messages, from the .proto files and their comments."""
    yield "# Calls"
    yield "The gRPC services of a node, from `proto/`. Components reach them through the [SDK](sdk.md)."
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "set"
        names = [str(path.relative_to(PROTO)) for path in sorted(PROTO.glob("fractus_proto/v1/*.proto"))]
        arguments = ["protoc", f"-I{PROTO}", f"-I{Path(protoc.__file__).parent / '_proto'}"]
        if protoc.main([*arguments, "--include_source_info", f"--descriptor_set_out={out}", *names]) != 0:
            raise ValueError("the .proto files cannot be read")
        described = FileDescriptorSet.FromString(out.read_bytes())
    for file in described.file:
        said = {tuple(place.path): _comment(place) for place in file.source_code_info.location}
        for i, service in enumerate(file.service):
            yield f"## {service.name}"
            yield said.get((6, i), "")
            rows = ["| Call | Takes | Gives | Meaning |", "|---|---|---|---|"]
            for j, method in enumerate(service.method):
                gives = ("stream of " if method.server_streaming else "") + _plain(method.output_type)
                rows.append(
                    f"| `{method.name}` | {_plain(method.input_type)} | {gives} | {_cell(said.get((6, i, 2, j), ''))} |"
                )
            yield "\n".join(rows)
        for i, message in enumerate(file.message_type):
            if not message.field:
                continue
            yield f"### {message.name}"
            yield said.get((4, i), "")
            rows = ["| Field | Number | Meaning |", "|---|---|---|"]
            rows += [
                f"| `{field.name}` | {field.number} | {_cell(said.get((4, i, 2, j), ''))} |"
                for j, field in enumerate(message.field)
            ]
            yield "\n".join(rows)


def _comment(place: Any) -> str:
    return " ".join((place.leading_comments + place.trailing_comments).split())


def _plain(name: str) -> str:
    return f"`{name.rsplit('.', maxsplit=1)[-1]}`"


def values() -> Iterator[str]:
    """Every value of every chart, from the comments of values.yaml."""
    yield "# Chart values"
    for chart in charts():
        described = yaml.safe_load((chart / "Chart.yaml").read_text())
        yield f"## {described['name']}"
        yield f"{described['description']}."
        yield _value_table(chart)


def charts() -> list[Path]:
    """The folders of the charts."""
    return sorted(path.parent for path in (ROOT / "charts").glob("*/Chart.yaml"))


def chart_readme(chart: Path) -> str:
    """What `helm show readme` prints of a chart."""
    described = yaml.safe_load((chart / "Chart.yaml").read_text())
    parts = [
        f"# {described['name']}",
        f"{described['description']}.",
        f"For Kubernetes `{described['kubeVersion']}`. Installation: [README](../../README.md#install-on-your-own-cluster),"
        " [clusters](../../docs/clusters.md), [upgrades](../../docs/upgrades.md).",
        "## Values",
        _value_table(chart),
    ]
    return "\n\n".join(parts) + "\n"


def _value_table(chart: Path) -> str:
    schema = json.loads((chart / "values.schema.json").read_text())
    rows = _values((chart / "values.yaml").read_text().splitlines(), schema)
    return "\n".join(["| Value | Default | Meaning |", "|---|---|---|", *rows])


def _values(lines: list[str], schema: dict[str, Any]) -> Iterator[str]:
    above: list[tuple[int, str]] = []
    said: list[str] = []
    for line in lines:
        text = line.strip()
        if text.startswith("#"):
            said.append(text.lstrip("# "))
            continue
        found = _VALUE.match(line)
        if found is None:
            said = []
            continue
        indent = len(found.group(1))
        above = [(depth, name) for depth, name in above if depth < indent]
        default = (found.group(3) or "").strip()
        if default or said:
            path = [*(name for _, name in above), found.group(2)]
            meaning = " ".join(said) or _description(schema, path)
            yield f"| `{'.'.join(path)}` | {f'`{_cell(default)}`' if default else ''} | {_cell(meaning)} |"
        above.append((indent, found.group(2)))
        said = []


def _description(schema: dict[str, Any], path: list[str]) -> str:
    """What the schema says of a value; empty where it says nothing."""
    part = schema
    for name in path:
        part = part.get("properties", {}).get(name, {})
        if "$ref" in part:
            part = schema["definitions"][part["$ref"].rpartition("/")[2]]
    return str(part.get("description", ""))


def commands() -> Iterator[str]:
    """The help of every command."""
    yield "# Help of every command"
    yield "What `fractus COMMAND --help` prints. [Which need what](../cli.md)."
    root = click.Context(fractus, info_name="fractus", terminal_width=100)
    for name in sorted(fractus.list_commands(root)):
        yield from _help(fractus.get_command(root, name), root, name)


def _help(command: click.Command | None, above: click.Context, name: str) -> Iterator[str]:
    if command is None or command.hidden:
        return
    context = click.Context(command, info_name=name, parent=above, terminal_width=100)
    yield f"## {context.command_path}"
    yield f"```text\n{command.get_help(context)}\n```"
    if isinstance(command, click.Group):
        for below in sorted(command.list_commands(context)):
            yield from _help(command.get_command(context, below), context, below)


def _cell(text: str) -> str:
    return " ".join(str(text).split()).replace("|", "\\|")


if __name__ == "__main__":
    for folder in charts():
        (folder / "README.md").write_text(chart_readme(folder))
