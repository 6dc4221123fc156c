"""Commands in the documentation: options and targets exist, and commands that need no cluster succeed."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import click
import demo_flight
import pytest
import yaml
from docs_pages import PAGES, ROOT, code_spans, shell_lines, shown_file
from fractus_cli.main import fractus, run
from fractus_runtime.audit import AuditLog

NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
_FRACTUS = re.compile(r"(?:^|[|;&(]\s*|kubectl |[A-Z_]+=\S* )fractus (?!-)([^|;&()<>#]*)")
OFFLINE = ("fractus plan -f examples", "fractus policy check", "fractus zones import town", "fractus audit ")
"""Prefixes of the documented commands that the tests run. These commands need no cluster, and end by themselves."""

ZONES = {
    "type": "FeatureCollection",
    "features": [
        {
            "type": "Feature", "properties": {"name": name},
            "geometry": {"type": "Polygon", "coordinates": [[[4.0, 50.0], [4.01, 50.0], [4.01, 50.01], [4.0, 50.0]]]},
        }
        for name in ("School", "Old Town")
    ],
}  # fmt: skip


def problems(arguments: str) -> list[str]:
    """Return the unknown commands and options in arguments of `fractus`."""
    words = shlex.split(arguments)
    command: click.Command = fractus
    context = click.Context(command)
    while isinstance(command, click.Group) and words and not words[0].startswith("-"):
        name = words.pop(0)
        if name.isupper() or name == "...":
            return []
        found_problems = command.get_command(context, name)
        if found_problems is None:
            return [f"no command {name}"]
        command = found_problems
        context = click.Context(found_problems, parent=context)
    if "--" in words:
        words = words[: words.index("--")]
    known = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
    known |= {"-h", "--help"}
    options = {word.partition("=")[0] for word in words if re.match(r"--?[a-z]", word)}
    return [f"no option {option}" for option in sorted(options - known)]


@pytest.mark.parametrize("page", NAMES)
def test_documented_fractus_commands_and_options_exist(page: str) -> None:
    wrong = {
        arguments: found_problems
        for text in (*shell_lines(page), *code_spans(page))
        for arguments in _FRACTUS.findall(text)
        if (found_problems := problems(arguments))
    }
    assert wrong == {}


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ("plan -f examples --nonsense", "no option --nonsense"),
        ("nonsense", "no command nonsense"),
        ("cluster nonsense", "no command nonsense"),
    ],
)
def test_unknown_commands_and_options_are_found(arguments: str, problem: str) -> None:
    assert problems(arguments) == [problem]


def test_most_commands_of_fractus_are_documented() -> None:
    texts = [text for page in NAMES for text in (*shell_lines(page), *code_spans(page))]
    assert sum(len(_FRACTUS.findall(text)) for text in texts) > 80


@pytest.mark.parametrize("page", NAMES)
def test_documented_make_targets_exist(page: str) -> None:
    targets = set(re.findall(r"^([a-z][a-z0-9-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    texts = [*shell_lines(page), *(span for span in code_spans(page))]
    used = {target for text in texts for target in re.findall(r"(?:^|[;&] *|[A-Z]=\S* )make ([a-z][a-z0-9-]*)", text)}
    assert used - targets == set()


@pytest.mark.parametrize("page", NAMES)
def test_documented_chart_values_exist(page: str) -> None:
    values = yaml.safe_load((ROOT / "charts/fractus/values.yaml").read_text())
    for line in (line for line in shell_lines(page) if re.search(r"helm .*charts/fractus ", line)):
        for path in re.findall(r"--set[ =]'?([\w.]+)=", line):
            place = values
            for name in path.split("."):
                assert name in place, f"{line}: the chart has no value {path}"
                place = place[name]


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of a reader with examples, zones, signed Grants, and audit logs of a flight."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    (tmp_path / "town.geojson").write_text(json.dumps(ZONES))
    shutil.copy(ROOT / "examples/traffic-monitoring/zones.yaml", tmp_path)
    (tmp_path / "patrol.yaml").write_text(shown_file("docs/tutorial.md", "patrol.yaml"))
    assert run(["grants", "init", "pki", "--node", "drone-1"]) == 0
    assert run(["grants", "sign", "patrol.yaml", "--tls", "pki", "--to", "grants"]) == 0
    for folder, node in (("audit", "drone-1"), ("drone-1/audit", "drone-1"), ("drone-2/audit", "drone-2")):
        asyncio.run(_write_audit_log(tmp_path / folder / "mobility.jsonl", node))
    return tmp_path


async def _write_audit_log(path: Path, node: str) -> None:
    now_s = 0.0
    log = AuditLog(path, lambda: now_s)
    started = {"kind": "started", "time": demo_flight.stamp(demo_flight.APPLIED_S), "node": node}
    for entry in [started, *demo_flight.states()[:60]]:
        now_s = datetime.fromisoformat(str(entry["time"])).timestamp()
        log.append(str(entry["kind"]), {key: value for key, value in entry.items() if key not in {"kind", "time"}})
    await log.close()


@pytest.mark.parametrize("page", ["docs/applications.md", "docs/policies.md", "docs/recordings.md", "docs/zones.md"])
def test_offline_commands_of_a_page_succeed(page: str, checkout: Path) -> None:
    lines = [line for line in shell_lines(page) if line.startswith(OFFLINE)]
    assert lines
    script = "\n".join(["set -eo pipefail", *lines]).replace("/var/lib/fractus", ".")
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", script], cwd=checkout, env={**os.environ, "PATH": path}, capture_output=True, text=True,
        timeout=240, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr
