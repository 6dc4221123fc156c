"""Run the commands of docs/tutorial.md on a cluster.

Its program flies, a policy and an update take effect, and the pictures of a survey are kept.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "tutorial.md").read_text()
NAME = "tutorial-e2e"
BEGINS = "## 6. "
ENDS = "## If it does not fly"
TIMEOUT_S = 1500
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        os.environ.get("FRACTUS_E2E_CLUSTER") == "current", reason="the tutorial starts an embedded cluster"
    ),
]


def files(text: str) -> dict[str, str]:
    """Return the names and contents of the files that the page shows."""
    return dict(re.findall(r"`([\w.]+)`[^`\n]*:\n```\w+\n(.*?)```", text, re.DOTALL))


def typed(text: str) -> list[tuple[str, list[str]]]:
    """Return the commands of the page, each with the output lines that the page shows after it."""
    commands: list[tuple[str, list[str]]] = []
    shell: bool | None = None  # True in a shell block, False in another block, None between blocks
    for line in text.splitlines():
        if line.startswith("```"):
            shell = (line == "```") if shell is None else None
        elif shell and line.startswith("$ "):
            commands.append((line[2:], []))
        elif shell:
            commands[-1][1].append(line.removeprefix("... "))
    return commands


def on_own_cluster(command: str) -> str:
    """Add the name of the test's cluster to the command, because this machine may run other clusters."""
    return re.sub(r"fractus cluster ([\w-]+)", rf"fractus cluster \1 --name {NAME}", command)


@pytest.fixture
def checkout(tmp_path: Path) -> Iterator[Path]:
    """A copy of the checkout with all files that Git does not ignore."""
    folder = tmp_path / "checkout"
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True, timeout=60).stdout
    for name in filter(None, names.split("\0")):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, folder / name, follow_symlinks=False)
    down = [sys.executable, "-m", "fractus_cli", "cluster", "down", "--name", NAME]
    subprocess.run(down, check=False, timeout=300)
    try:
        yield folder
    finally:
        subprocess.run(down, check=False, timeout=300)
        built = ["localhost/patrol:1", "localhost/patrol:2", "localhost/survey:1"]
        subprocess.run(["buildah", "rmi", *built], check=False, capture_output=True, timeout=60)


@pytest.mark.timeout(TIMEOUT_S + 250)
def test_application_of_the_tutorial_flies_on_a_cluster(checkout: Path) -> None:
    begin = PAGE.index(BEGINS)
    end = PAGE.index(ENDS)
    page = PAGE[begin:end]
    (checkout / "patrol.py").write_text(files(PAGE[:begin])["patrol.py"])
    written = files(page)
    survey = {"survey.py", "viewer.py", "store.py", "survey.yaml"}
    assert {"Dockerfile", "application.yaml", "low.yaml"} | survey == written.keys()
    commands = typed(page)
    assert sum(command.startswith("fractus ") for command, _ in commands) >= 5
    script = [
        "set -e",
        # Print the state of the cluster if a command fails.
        "trap 'kubectl get applications,deploymentplans,pods,events -A -o wide >&2 || true' ERR",
    ]
    for command, _ in commands:
        if command.startswith("fractus cluster down"):
            script.append("kubectl get events -o json > events.json; kubectl get grants -o json > grants.json")
        script.append(on_own_cluster(command))
        if command == "cd patrol":
            script += [f"cp '../written/{name}' ." for name in written]
        if "Updated=False" in command:
            script.append("kubectl get pods -l fractus.dev/application=patrol -o json > waiting.json")
    (checkout / "written").mkdir()
    for name, text in written.items():
        (checkout / "written" / name).write_text(text)
    result = subprocess.run(
        ["bash", "-c", "\n".join(script)], cwd=checkout, capture_output=True, text=True, timeout=TIMEOUT_S, check=False,
        env={**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"},
    )  # fmt: skip
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-6000:]
    for command, expected in commands:
        for line in expected:
            assert line in result.stdout, f"{command} does not print: {line}\n{result.stdout}"

    (pod,) = json.loads((checkout / "patrol" / "waiting.json").read_text())["items"]
    (container,) = pod["status"]["containerStatuses"]
    assert (container["image"], container["restartCount"]) == ("localhost/patrol:1", 0), (
        "the update took effect in flight"
    )
    pictures = list((checkout / "patrol" / "pictures").iterdir())
    assert len(pictures) >= 3
    assert all(picture.read_bytes().startswith(b"\xff\xd8") for picture in pictures), "a picture is no JPEG file"
    events = json.loads((checkout / "patrol" / "events.json").read_text())["items"]
    missions = [e for e in events if e["reason"] == "MissionComplete" and e["involvedObject"]["name"] == "patrol"]
    assert len(missions) == 2, [f"{e['reason']}: {e['message']}" for e in events]
