"""MkDocs hook that adds pages to the site: pages from outside docs/, and the reference generated from the code.

mkdocs.yml configures the hook. Run as a program, this module writes the README.md of each chart.
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
"""Path on the site of each page outside docs/."""

_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)#\s]+)(#[^)\s]*)?\)")
_SESSION = re.compile(r"^```\n(?=\$ )", re.MULTILINE)
"""Opening fence of a block that begins with a prompt."""
_VALUE = re.compile(r"^( *)(\w[\w-]*):(?: +(.*))?$")


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add pages from outside docs/ and generated pages."""
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
    """Change links between files of the repository to links between pages of the site, and mark shell sessions.

    Links to files that are not on the site are replaced by their text. In marked sessions, the copy button can leave out
    prompts and output (site.css).
    """
    markdown = _SESSION.sub("```console\n", markdown)
    source = next((name for name, site in ROOT_PAGES.items() if site == page.file.src_uri), None)
    folder = posixpath.dirname(source or "docs/" + page.file.src_uri)

    def site_link(match: re.Match[str]) -> str:
        mark = match.group(1)
        text = match.group(2)
        target = match.group(3)
        anchor = match.group(4) or ""
        if "://" in target or target.startswith(("mailto:", "/")):
            return match.group()
        path = posixpath.normpath(posixpath.join(folder, target))
        site = ROOT_PAGES.get(path) or (path.removeprefix("docs/") if path.startswith("docs/") else None)
        if path == "docs/decisions":
            site = "decisions/index.md"
        if site is None or files.get_file_from_path(site) is None:
            return text if text.startswith("`") or mark else f"{text} (`{path}`)" if text != path else f"`{text}`"
        page_folder = posixpath.dirname(page.file.src_uri)
        return f"{mark}[{text}]({posixpath.relpath(site, page_folder or '.')}{anchor})"

    return _LINK.sub(site_link, markdown)


def decisions() -> Iterator[str]:
    """Yield the list of decisions as Markdown."""
    yield "# Decisions"
    paths = sorted((ROOT / "docs" / "decisions").glob("*.md"))
    yield "\n".join(f"- [{path.read_text().splitlines()[0].lstrip('# ')}]({path.name})" for path in paths)


def kinds() -> Iterator[str]:
    """Yield a table of all fields of each kind, from the CustomResourceDefinitions."""
    yield "# Kinds"
    yield "All kinds have the group `fractus.dev` and the version `v1alpha1`. `kubectl explain KIND.spec` prints the same descriptions."
    for path in sorted((ROOT / "crds").glob("*.yaml")):
        body = yaml.safe_load(path.read_text())["spec"]
        names = body["names"]
        schema = body["versions"][0]["schema"]["openAPIV3Schema"]
        short = ", ".join(f"`{name}`" for name in names.get("shortNames", ()))
        yield f"## {names['kind']}"
        yield f"{schema.get('description', '')} Scope: {body['scope']}. `kubectl get {names['plural']}`, short name {short}."
        for part in ("spec", "status"):
            if part in schema["properties"]:
                yield f"### {names['kind']}.{part}"
                rows = _fields(schema["properties"][part], "")
                yield "\n".join(["| Field | Type | Meaning |", "|---|---|---|", *rows])
                rules = [rule["message"] for rule in schema["properties"][part].get("x-kubernetes-validations", ())]
                if rules:
                    yield "Rules:"
                    yield "\n".join(f"- {_cell(message)}" for message in rules)


def _fields(schema: dict[str, Any], prefix: str) -> Iterator[str]:
    required = set(schema.get("required", ()))
    for name, field in schema.get("properties", {}).items():
        path = f"{prefix}{name}"
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
    """Yield tables of all services and messages, from the .proto files and their comments."""
    yield "# Calls"
    yield "The gRPC services of a node, from `proto/`. Components reach them through the [SDK](sdk.md)."
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "set"
        names = [str(path.relative_to(PROTO)) for path in sorted(PROTO.glob("fractus_proto/v1/*.proto"))]
        arguments = ["protoc", f"-I{PROTO}", f"-I{Path(protoc.__file__).parent / '_proto'}"]
        if protoc.main([*arguments, "--include_source_info", f"--descriptor_set_out={out}", *names]) != 0:
            raise ValueError("protoc cannot compile the .proto files")
        descriptors = FileDescriptorSet.FromString(out.read_bytes())
    for file in descriptors.file:
        comments = {tuple(location.path): _comment(location) for location in file.source_code_info.location}
        for i, service in enumerate(file.service):
            yield f"## {service.name}"
            yield comments.get((6, i), "")
            rows = ["| Call | Request | Response | Meaning |", "|---|---|---|---|"]
            for j, method in enumerate(service.method):
                request = _type_name(method.input_type)
                response = ("stream of " if method.server_streaming else "") + _type_name(method.output_type)
                meaning = _cell(comments.get((6, i, 2, j), ""))
                rows.append(f"| `{method.name}` | {request} | {response} | {meaning} |")
            yield "\n".join(rows)
        for i, message in enumerate(file.message_type):
            if not message.field:
                continue
            yield f"### {message.name}"
            yield comments.get((4, i), "")
            rows = ["| Field | Number | Meaning |", "|---|---|---|"]
            rows += [
                f"| `{field.name}` | {field.number} | {_cell(comments.get((4, i, 2, j), ''))} |"
                for j, field in enumerate(message.field)
            ]
            yield "\n".join(rows)


def _comment(location: Any) -> str:
    return " ".join((location.leading_comments + location.trailing_comments).split())


def _type_name(name: str) -> str:
    return f"`{name.rsplit('.', maxsplit=1)[-1]}`"


def values() -> Iterator[str]:
    """Yield a table of all values of each chart, from the comments of values.yaml."""
    yield "# Chart values"
    for chart in charts():
        metadata = yaml.safe_load((chart / "Chart.yaml").read_text())
        yield f"## {metadata['name']}"
        yield f"{metadata['description']}."
        yield _value_table(chart)


def charts() -> list[Path]:
    """Return the folders of the charts."""
    return sorted(path.parent for path in (ROOT / "charts").glob("*/Chart.yaml"))


def chart_readme(chart: Path) -> str:
    """Return the README.md of a chart, which `helm show readme` prints."""
    metadata = yaml.safe_load((chart / "Chart.yaml").read_text())
    parts = [
        f"# {metadata['name']}",
        f"{metadata['description']}.",
        f"For Kubernetes `{metadata['kubeVersion']}`. Installation: [README](../../README.md#install-on-your-own-cluster),"
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
    parents: list[tuple[int, str]] = []
    comment: list[str] = []
    for line in lines:
        text = line.strip()
        if text.startswith("#"):
            comment.append(text.lstrip("# "))
            continue
        match = _VALUE.match(line)
        if match is None:
            comment = []
            continue
        indent = len(match.group(1))
        parents = [(depth, name) for depth, name in parents if depth < indent]
        default = (match.group(3) or "").strip()
        if default or comment:
            path = [*(name for _, name in parents), match.group(2)]
            meaning = " ".join(comment) or _description(schema, path)
            yield f"| `{'.'.join(path)}` | {f'`{_cell(default)}`' if default else ''} | {_cell(meaning)} |"
        parents.append((indent, match.group(2)))
        comment = []


def _description(schema: dict[str, Any], path: list[str]) -> str:
    """Return the schema's description of a value, or an empty string if there is none."""
    part = schema
    for name in path:
        part = part.get("properties", {}).get(name, {})
        if "$ref" in part:
            part = schema["definitions"][part["$ref"].rpartition("/")[2]]
    return str(part.get("description", ""))


def commands() -> Iterator[str]:
    """Yield the help of every command."""
    yield "# Help of every command"
    yield "This page contains the output of `fractus COMMAND --help`. [Command line](../cli.md) lists the requirements of commands."
    root = click.Context(fractus, info_name="fractus", terminal_width=100)
    for name in sorted(fractus.list_commands(root)):
        yield from _help(fractus.get_command(root, name), root, name)


def _help(command: click.Command | None, parent: click.Context, name: str) -> Iterator[str]:
    if command is None or command.hidden:
        return
    context = click.Context(command, info_name=name, parent=parent, terminal_width=100)
    yield f"## {context.command_path}"
    yield f"```text\n{command.get_help(context)}\n```"
    if isinstance(command, click.Group):
        for subcommand in sorted(command.list_commands(context)):
            yield from _help(command.get_command(context, subcommand), context, subcommand)


def _cell(text: str) -> str:
    return " ".join(str(text).split()).replace("|", "\\|")


if __name__ == "__main__":
    for folder in charts():
        (folder / "README.md").write_text(chart_readme(folder))
