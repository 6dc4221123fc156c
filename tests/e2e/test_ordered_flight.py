"""A user orders a flight over the management API with the commands of the documentation, and the drone flies it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from urllib.request import urlopen

import pytest
from conftest import ROOT, flight_state
from docs_pages import shell_lines
from fractus_cluster.ports import free_port
from kubectl import Kube, Object
from test_mission import audit_log

pytestmark = pytest.mark.slow

NAMESPACE = "team"
START = "START=$(date -u -d '+3 minutes' +%FT%TZ)"


@pytest.fixture
def api(grounded: Kube, tmp_path: Path) -> Iterator[str]:
    """Address of the management API, which runs on this machine."""
    address = f"127.0.0.1:{free_port()}"
    log = tmp_path / "api.log"
    with log.open("wb") as output:
        argv = [
            sys.executable,
            "-m",
            "fractus_cli",
            "api",
            "serve",
            f"--listen={address}",
            f"--kubeconfig={grounded.kubeconfig}",
        ]
        server = subprocess.Popen(argv, stdout=output, stderr=output)
    try:
        grounded.wait("the management API", lambda: _is_ready(f"http://{address}/readyz"), timeout_s=60)
        yield f"http://{address}"
    finally:
        server.terminate()
        server.wait(30)
        grounded.run("delete", "flightplans", "--all", "-n", NAMESPACE, timeout_s=180)
        grounded.run("delete", "namespace", NAMESPACE)
        grounded.run("delete", "applicationtemplates", "--all")
        grounded.run("delete", "clusterrolebindings", "alice-drones", "alice-apps")


def _is_ready(url: str) -> bool:
    try:
        with urlopen(url, timeout=5) as response:
            return bool(response.status == 200)
    except OSError:
        return False


def plans(kube: Kube) -> list[Object]:
    """Return the plans except checks, which the operator deletes after a minute."""
    return [plan for plan in kube.all("flightplans", NAMESPACE) if not plan["spec"].get("dryRun")]


def test_documented_commands_approve_order_and_fly(grounded: Kube, api: str, tmp_path: Path) -> None:
    kube = grounded
    before = len(audit_log(kube))
    programs = [Path(sys.executable).parent, kube.kubectl.parent]
    path = ":".join([*map(str, programs), os.environ["PATH"]])
    environment = {**os.environ, "PATH": path, "KUBECONFIG": str(kube.kubeconfig)}

    def run(script: str, folder: Path) -> str:
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", script], cwd=folder, env=environment, capture_output=True, text=True, timeout=120,
            check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"{done.stdout}{done.stderr}"
        return done.stdout

    approve = shell_lines("docs/flight-plans.md", "Approve a template")
    assert "is approved by" in run("\n".join(approve).replace("approve survey", "approve survey --yes"), ROOT)
    lines = [line for line in shell_lines("docs/management-api.md", "Fly in ten minutes") if "--no-buffer" not in line]
    # The flight ends by itself.
    until_flight = lines[: next(i for i, line in enumerate(lines) if ":end?" in line)]
    script = "\n".join(until_flight).replace("http://127.0.0.1:8660", api)
    assert START in script
    soon = f"{datetime.now(UTC) + timedelta(seconds=20):%Y-%m-%dT%H:%M:%SZ}"
    output = run(script.replace(START, f"START={soon}"), tmp_path)
    assert "Accepted" in output
    kube.wait("the drone flies", lambda: flight_state(kube) == "flying", timeout_s=120)
    (plan,) = plans(kube)
    assert plan["status"]["state"] == "Activated", plan["status"]
    plan = kube.wait(
        "the plan is over",
        lambda: next((p for p in plans(kube) if p["status"]["state"] == "Ended"), None),
        timeout_s=240,
    )
    assert "1 of 1 waypoints reached" in plan["status"]["message"], plan["status"]
    flown = [entry for entry in audit_log(kube)[before:] if entry.get("method") == "Goto"]
    assert [entry["action"] for entry in flown] == ["allow"]
