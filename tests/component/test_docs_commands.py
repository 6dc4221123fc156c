"""Every command that a page shows is carried out, or parsed by what it is for, or on a short list with the reason why not."""

from __future__ import annotations

import asyncio
import json
import shutil
from pathlib import Path

import docs_folder
import docs_fractus
import docs_programs
import pytest
from docs_commands import BEGINNINGS, PAGES, PLACEHOLDERS, ROOT, Command, commands, every_command, placeholders
from fractus_cli.main import run

ELSEWHERE = {
    ".": "the shell's own",
    "MAVExplorer.py": "a program of pymavlink with windows",
    "base64": "of every machine",
    "cd": "the shell's own",
    "cosign": "checks a release on GitHub",
    "cp": "of every machine",
    "ctr": "loads images into a node of the reader's",
    "echo": "the shell's own",
    "eval": "the shell's own",
    "grep": "of every machine",
    "k3s": "makes a node of the reader's",
    "kind": "loads images into a cluster of the reader's",
    "mavlogdump.py": "a program of pymavlink",
    "mkdir": "of every machine",
    "openssl": "of every machine",
    "rm": "removes the state of a node of the reader's",
    "sed": "of every machine",
    "ssh": "reaches a node of the reader's",
    "xdg-open": "opens a browser",
}
"""Programs whose options are not looked at."""

HERE = sorted({command.page for command in every_command()})
ZONES = {
    "type": "FeatureCollection",
    "features": [
        {
            "type": "Feature", "properties": {"name": name, **more},
            "geometry": {"type": "Polygon", "coordinates": [[[4.0, 50.0], [4.01, 50.0], [4.01, 50.01], [4.0, 50.0]]]},
        }
        for name, more in (("School", {}), ("Old Town", {"upperLimit": 60}))
    ],
}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where commands are typed: a checkout, with files that a reader has."""
    monkeypatch.chdir(tmp_path)
    asyncio.run(docs_folder.furnish_logs(tmp_path))
    for name in ("FILE", "flight.mcap", "camera.mcap", "navigator.py"):
        (tmp_path / name).touch()
    for name in ("DIR", "MANIFESTS", "grants", "node/recordings/mobility"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "town.geojson").write_text(json.dumps(ZONES))
    shutil.copy(ROOT / "examples" / "traffic-monitoring" / "zones.yaml", tmp_path)
    return tmp_path


@pytest.mark.timeout(300)
@pytest.mark.parametrize("page", HERE)
def test_the_commands_of_a_page(
    page: str, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    docs_folder.furnish(folder, page)
    if page == "docs/recordings.md":
        _granted(folder)
    unknown: list[str] = []
    for command in (one for one in every_command() if one.page == page):
        program = docs_programs.program_of(command)
        if not docs_programs.check(command, folder) and program not in ELSEWHERE:
            unknown.append(f"{command.shown}: no one checks {program}: add a check, or a reason to ELSEWHERE")
        capsys.readouterr()
        if docs_fractus.runnable(command):
            docs_fractus.carry_out(command, capsys.readouterr)
        if command.argv[1:3] == ("grants", "init") and not command.in_sentence:
            asyncio.run(docs_folder.furnish_logs(folder, folder / "pki" / "nodes" / "drone-1"))
        folder = docs_folder.enter(folder, command)
        monkeypatch.chdir(folder)
    assert not unknown


def _granted(folder: Path) -> None:
    """The Grant of the tutorial, signed: an audit log's zones come from such a file."""
    docs_folder.furnish(folder, "docs/tutorial.md")
    assert run(["grants", "init", "pki", "--node", "drone-1"]) == 0
    assert run(["grants", "sign", "patrol.yaml", "--tls", "pki", "--to", "grants"]) == 0


def test_lists_have_nothing_that_no_page_has() -> None:
    every = every_command()
    programs = {docs_programs.program_of(command) for command in every}
    assert len(every) > 300
    assert sorted(ELSEWHERE.keys() - programs) == []
    assert sorted(ELSEWHERE.keys() & docs_programs.CHECKS.keys()) == []
    assert sorted(docs_programs.CHECKS.keys() - programs) == []
    assert sorted(BEGINNINGS - programs) == []
    said = [" ".join(command.argv[1:]) for command in every if command.argv[0] == "fractus"]
    assert [name for name in docs_fractus.NOT_RUN if not any(one.startswith(name) for one in said)] == []
    used = {one for command in every for word in (*command.argv, *command.variables) for one in placeholders(word)}
    assert sorted(set(PLACEHOLDERS) - used) == []
    kinds = {
        kind.partition("/")[0]
        for command in every
        if command.argv[0] == "kubectl"
        for word in docs_programs.operands(command.argv[1:])[1:2]
        for kind in word.split(",")
    }
    assert sorted(docs_programs.OF_KUBERNETES - kinds) == []
    ran = [command for command in every if docs_fractus.runnable(command)]
    assert len(ran) > 15, [command.shown for command in ran]


def one(text: str) -> list[Command]:
    return commands("page.md", text)


def test_what_is_typed_is_found() -> None:
    text = """Say `make demo` or `FRACTUS_NODE=a fractus
audit verify x`, not `charts/fractus`.

    helm install a charts/a   # why
```
$ A=1 fractus plan \\
    -f 'a b'  # comment
out 1
out 2
$ cat x | kubectl get $(fractus cluster env) > file
```
```text
make nothing
```
```yaml
a: fractus nothing
```
"""
    found = [(c.line, c.variables, c.argv, c.in_sentence, c.output) for c in one(text)]
    assert found == [
        (1, (), ("make", "demo"), True, ()),
        (1, ("FRACTUS_NODE=a",), ("fractus", "audit", "verify", "x"), True, ()),
        (4, (), ("helm", "install", "a", "charts/a"), False, ()),
        (6, ("A=1",), ("fractus", "plan", "-f", "a b"), False, ("out 1", "out 2")),
        (10, (), ("fractus", "cluster", "env"), False, ()),
        (10, (), ("cat", "x"), False, ()),
        (10, (), ("kubectl", "get", "SUBSTITUTED"), False, ()),
    ]


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("fractus plan --nonsense", "No such option"),
        ("fractus plan", "it lacks"),
        ("fractus nonsense", "there is no command nonsense"),
        ("fractus cluster nonsense", "there is no command nonsense"),
        ("fractus cluster down now", "it takes no now"),
        ("fractus cluster", "it lacks a subcommand"),
        ("fractus plan -f nonsense.yaml", "does not exist"),
        ("fractus zones import FILE --from nonsense", "is not one of"),
        ("kubectl fractus nonsense", "there is no command nonsense"),
        ("python -m fractus_sim.chaos --fault nonsense", "is not one of"),
        ("make nonsense", "no target nonsense"),
        ("make demo NONSENSE=1", "no NONSENSE"),
        ("NONSENSE=1 make demo", "nothing reads NONSENSE"),
        ("helm install a charts/nonsense", "there is no chart"),
        ("helm install a charts/fractus --set view.nonsense=1", "no value view.nonsense"),
        ("helm frobnicate", "not known to this test"),
        ("kubectl get nonsense", "nonsense is no kind"),
        ("kubectl apply -f nonsense.yaml", "nonsense.yaml"),
        ("kubectl apply -f Dockerfile", "Dockerfile"),
        ("docker build --target nonsense .", "no stage nonsense"),
        ("docker build --build-arg NONSENSE=1 .", "no argument NONSENSE"),
        ("docker build --target agent examples", "no Dockerfile"),
        ("python bench/nonsense.py", "there is no bench/nonsense.py"),
        ("python bench/policy.py --nonsense", "no option --nonsense"),
        ("bench/policy.py --nonsense", "no option --nonsense"),
        ("uv run python bench/policy.py --nonsense", "no option --nonsense"),
        ("pytest tests/unit/test_nonsense.py", "no such file"),
        ("pytest tests/unit/test_policy_engine.py -k nonsense", "no test of nonsense"),
        ("pip install '.[nonsense]'", "no extra nonsense"),
        ("export NONSENSE_NODE=1", "nothing reads NONSENSE_NODE"),
    ],
)
def test_what_is_wrong_is_said(line: str, sentence: str, folder: Path) -> None:
    docs_folder.furnish(folder, "README.md")
    (command,) = one(f"```\n{line}\n```")
    with pytest.raises(AssertionError, match=f"page.md:2: .*{sentence}"):
        docs_programs.check(command, folder)


def test_output_that_is_not_printed_is_found(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = "```\n$ fractus completion bash\nnonsense\n```"
    (command,) = one(text)
    with pytest.raises(AssertionError, match="does not print: nonsense"):
        docs_fractus.carry_out(command, capsys.readouterr)


def test_pages_are_all_looked_at() -> None:
    names = {str(page.relative_to(ROOT)) for page in PAGES}
    assert {"README.md", "docs/tutorial.md", "examples/heuristic-plugin/README.md"} <= names
