"""The path of a new user, with the commands of the documentation: from `fractus init` to the second mission after charging."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from conftest import report
from fractus_cli.init import NEXT_STEPS
from playwright.sync_api import sync_playwright

ROOT = Path(__file__).parents[2]
NAME = "whole-path"
LIMIT_S = 900
"""Time for the whole path, on a machine with built programs and images."""
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.environ.get("FRACTUS_E2E_CLUSTER") == "current", reason="starts an embedded cluster"),
]

NAVIGATOR = """\
import json

import fractus


async def fly(drone: fractus.Mobility, control: fractus.Control) -> None:
    await drone.arm()
    await drone.takeoff(20)
    lines = fractus.survey(control.task.region, 20, 20)
    refused = await drone.mission(lines, skip_refused=True)
    async with fractus.requester("Store") as store:
        await store.request("store", json.dumps({"version": VERSION, "refused": len(refused)}).encode())


fractus.run(fly)
"""
STORE = """\
import asyncio
from pathlib import Path

import fractus


async def store(request: fractus.Request) -> bytes:
    with Path("/data/results.jsonl").open("ab") as file:
        file.write(request.body + b"\\n")
    return b""


asyncio.run(fractus.Responder({"store": store}, 8080).serve())
"""
CLAIM = re.findall(r"```yaml\n(.*?)```", (ROOT / "docs" / "results.md").read_text(), re.DOTALL)
LOW = re.findall(r"`low.yaml`:\n```yaml\n(.*?)```", (ROOT / "docs" / "tutorial.md").read_text(), re.DOTALL)


def survey(application: dict[str, Any], version: int) -> dict[str, Any]:
    """Return the application of `fractus init` as a survey whose results are stored in a claim."""
    (navigator,) = application["spec"]["components"]
    image = f"localhost/survey:{version}"
    circle = {"center": {"lat": 50.8641, "lon": 4.6789}, "radius": 40}
    navigator["controlPoints"] = [
        {"point": {"depot": "depot-1"}, "navigation": "regionBased", "region": {"circle": circle}, "duration": 3}
    ]
    navigator["egress"] = ["Store"]
    navigator["container"] = {"image": image}
    volume = {"name": "results", "mountPath": "/data", "claim": "survey-results"}
    container = {
        "image": image,
        "command": ["python3", "/app/store.py"],
        "ports": [{"port": 8080}],
        "volumes": [volume],
    }
    store = {"name": "Store", "placement": "cloud", "ingress": ["Navigator"], "container": container}
    return {**application, "spec": {"afterFlight": 5, "components": [navigator, store]}}


class Shell:
    """Runs command lines in a directory, as a user would type them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
        self.environment.pop("KUBECONFIG", None)

    def type(self, line: str, timeout_s: float = 60) -> str:
        """Run a line and return its output, and report its duration. Fail if it fails."""
        started = time.monotonic()
        result = subprocess.run(
            ["bash", "-c", line], cwd=self.folder, env=self.environment, capture_output=True, text=True,
            timeout=timeout_s, check=False,
        )  # fmt: skip
        report(f"{time.monotonic() - started:.0f} s: {line}")
        assert result.returncode == 0, f"{line}\n{result.stdout[-2000:]}{result.stderr[-4000:]}"
        return result.stdout

    def wait(self, condition: str, timeout_s: int) -> None:
        """Wait for a condition of the Application."""
        self.type(f"kubectl wait --for={condition} fapp/survey --timeout={timeout_s}s", timeout_s + 10)

    def build(self, version: int) -> None:
        """Build a version of the program."""
        (self.folder / "navigator.py").write_text(NAVIGATOR.replace("VERSION", str(version)))
        self.type(f"buildah build -t localhost/survey:{version} .", 120)


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[Shell]:
    """A shell in an empty directory. The cluster and the images are removed at the end."""
    shell = Shell(tmp_path)
    yield shell
    shell.type(f"fractus cluster down --name {NAME}", 600)
    subprocess.run(["buildah", "rmi", "localhost/survey:1", "localhost/survey:2"], check=False, capture_output=True)


@pytest.mark.timeout(LIMIT_S + 600)  # with the removal of the cluster
def test_new_user_flies_keeps_results_and_flies_again_after_charging(shell: Shell) -> None:
    assert "fractus plan -f application.yaml -f place.yaml" in NEXT_STEPS
    shell.type("fractus init survey")
    shell.folder /= "survey"
    generated = yaml.safe_load((shell.folder / "application.yaml").read_text())
    manifest = shell.folder / "application.yaml"
    manifest.write_text(yaml.safe_dump(survey(generated, 1)))
    (shell.folder / "claim.yaml").write_text(CLAIM[1])
    (shell.folder / "low.yaml").write_text(LOW[0].replace("patrol", "survey"))
    (shell.folder / "store.py").write_text(STORE)
    with (shell.folder / "Dockerfile").open("a") as file:
        file.write("COPY store.py /app/\n")
    shell.type("fractus check navigator.py")
    assert "feasible" in shell.type("fractus plan -f application.yaml -f place.yaml")

    shell.type(f"fractus images build component --source {ROOT}", 300)
    shell.build(1)
    demo = ROOT / "examples" / "clusters" / "demo.yaml"
    shell.type(f"fractus cluster up {demo} --name {NAME} --image localhost/survey:1", 400)
    shell.type(f"fractus cluster install --source {ROOT} --name {NAME}", 600)
    for line in shell.type(f"fractus cluster env --name {NAME}").splitlines():
        variable, _, value = line.removeprefix("export ").partition("=")
        shell.environment[variable] = shell.type(f"echo {value}").strip()
    shell.type(f"kubectl apply -f {ROOT}/examples/traffic-monitoring/depot.yaml -f claim.yaml -f application.yaml")
    shell.wait("jsonpath='{.status.phase}'=Flying", 180)

    shell.type("kubectl apply -f low.yaml")
    shell.build(2)
    shell.type(f"fractus cluster load-image localhost/survey:2 --name {NAME}", 120)
    manifest.write_text(yaml.safe_dump(survey(generated, 2)))
    shell.type("kubectl apply -f application.yaml")
    shell.wait("condition=Updated=False", 30)
    _wait_for_results(shell, 2)
    shell.wait("jsonpath='{.status.phase}'=Completed", 180)

    shell.type("fractus cp survey/Store:/data results", 180)
    results = [json.loads(line) for line in _only(shell.folder / "results", "results.jsonl").read_text().splitlines()]
    assert [result["version"] for result in results] == [1, 2]
    shell.type("fractus report survey", 180)
    _assert_browser_shows_figures(shell.folder / "out" / "survey" / "report.html", 2)

    before = _charge(shell)
    assert before < 1.0
    shell.type(f"fractus cluster charge drone-1 --name {NAME}")
    shell.type(
        "kubectl wait --for=jsonpath='{.status.battery.remaining}'=1 drone.fractus.dev/drone-1 --timeout=60s", 70
    )
    shell.type("kubectl delete -f application.yaml --wait", 120)
    shell.type("kubectl apply -f application.yaml")
    shell.wait("jsonpath='{.status.phase}'=Flying", 180)
    assert shell.type("kubectl get events -A --field-selector reason=UnmanagedPods -o name") == ""


def _wait_for_results(shell: Shell, missions: int) -> None:
    """Wait until the claim contains the results of this number of missions."""
    count = f'[ "$(kubectl exec deploy/survey-store -- cat /data/results.jsonl | wc -l)" -ge {missions} ]'
    shell.type(f"until {count}; do sleep 2; done", 400)


def _charge(shell: Shell) -> float:
    drone = json.loads(shell.type("kubectl get drone.fractus.dev drone-1 -o json"))
    return float(drone["status"]["battery"]["remaining"])


def _only(folder: Path, name: str) -> Path:
    (path,) = folder.rglob(name)
    return path


def _assert_browser_shows_figures(page_file: Path, count: int) -> None:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
        page = browser.new_page()
        page.goto(page_file.as_uri())
        assert page.title() == "Flight of survey"
        widths = page.evaluate("[...document.images].map(image => image.naturalWidth)")
        assert len([width for width in widths if width > 300]) >= count, widths
        browser.close()
