"""Run the documented commands that show the state of a cluster, on a real API server with an operator."""

from __future__ import annotations

import base64
import re
import shlex
from pathlib import Path

import pytest
from browser import serving, wait_for_events
from control_plane import wait_for
from docs_pages import ROOT, shell_lines
from docs_shell import Shell
from operator_world import FRACTUS, SYSTEM, OperatorProcess, World

pytestmark = pytest.mark.slow

DRONE = f"{FRACTUS}/drones/drone-1"
NAME = "traffic-monitoring"
PODS = 7
"""Number of pods of the example application."""

HEAD = f"mobility:7:{'a' * 64}"

COMMANDS = {
    "fractus explain APP": "drone-1",
    "fractus explain traffic-monitoring": "drone-1",
    "fractus status": r"(?s)LAST SEEN.*drone-1 .*default/traffic-monitoring",
    "kubectl -n fractus-system get lease fractus-operator -o yaml": "holderIdentity: operator",
    "kubectl -n fractus-system get pods -o wide": "fractus-agent-drone-1 .* drone-1",
    "kubectl api-resources --api-group=fractus.dev -o name": r"(?s)drones\.fractus\.dev.*zones\.fractus\.dev",
    "kubectl describe directlink": r"(?s)Kind: +DirectLink.*Spec:",
    "kubectl describe dlk NAME": r"(?s)Kind: +DirectLink.*Spec:",
    "kubectl describe drone NAME": r"(?s)AutopilotConnected.*Certified.*Recording.*TookOff",
    "kubectl describe fapp": r"(?s)Planned.*Events:",
    "kubectl describe fapp traffic-monitoring": r"(?s)Planned.*Events:",
    "kubectl describe grant NAME": r"Component: +Navigator",
    "kubectl explain fapp.spec.components": r"(?s)placement.*<string>",
    "kubectl get --raw /readyz?verbose": "readyz check passed",
    "kubectl get csr": "",
    "kubectl get dlk": r"DRONE +NODE +PHASE +TRAFFIC +REASON",
    "kubectl get drone NAME -o yaml": rf"(?s)\n  audit:\n  - {HEAD}.*\n  position:\n.*  lat: 50",
    "kubectl get events -A --field-selector type=Warning": "",
    "kubectl get grants": "traffic-monitoring-navigator",
    "kubectl get policies,zones,depots,drones,edgenodes,applications -A -o yaml": "kind: List",
}
"""Documented commands, each with a pattern of its output. NAME stands for the name of an object of the kind."""


def furnish(world: World, shell: Shell) -> None:
    """Create the nodes of the example and set their status as agents and kubelets report it."""
    for name in ("depot", "zones", "policies", "drone", "edge-nodes"):
        shell.type(f"kubectl apply -f examples/traffic-monitoring/{name}.yaml")
    world.api.merge(DRONE, {"spec": {"home": None}})
    world.drone_status("drone-1", "inactive")
    depot = world.api.get(f"{FRACTUS}/depots/depot-1") or {}
    conditions = [
        {"type": type_, "status": "True", "reason": reason, "lastTransitionTime": "2026-01-01T00:00:00Z"}
        for type_, reason in (("Ready", "AutopilotConnected"), ("Certified", "Certified"), ("Recording", "Recorded"))
    ]
    status = {"audit": [HEAD], "position": {**depot["spec"]["location"], "alt": 0}, "conditions": conditions}
    world.api.merge(f"{DRONE}/status", {"status": status})
    world.bound_pod(SYSTEM, "fractus-agent-drone-1", "drone-1")


def test_documented_commands_show_the_state_of_the_cluster(
    world: World, operator: OperatorProcess, tmp_path: Path
) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    shell = Shell(tmp_path, world.plane)
    furnish(world, shell)
    typed = [line for line in shell_lines("docs/applications.md") if line.startswith("kubectl")]
    dry_run, apply, _, delete = typed
    shell.type(dry_run)
    assert world.application("default", NAME) is None
    shell.type(apply)
    try:
        world.phase("default", "Deploying", NAME)
        world.api.merge(f"{DRONE}/status", {"status": {"flightState": "flying"}})
        wait_for(lambda: "TookOff" in shell.type("kubectl describe drone drone-1"), operator.log)
        wait_for(lambda: len(world.pods("default")) >= PODS, "the pods")
        world.run_pods("default")
        (link, *_) = wait_for(lambda: list(world.links("default", NAME).values()), operator.log)
        (grant,) = (body for body in world.grants("default", NAME) if body["spec"]["component"] == "Navigator")
        names = {"dlk": link["metadata"]["name"], "grant": grant["metadata"]["name"], "drone": "drone-1"}
        outputs: dict[str, str] = {}
        for line, pattern in COMMANDS.items():
            chosen = re.sub(r"(\w+) NAME", lambda match: f"{match[1]} {names[match[1]]}", line).replace("APP", NAME)
            outputs[chosen] = outputs.get(chosen) or shell.type(chosen)
            assert re.search(pattern, outputs[chosen]), f"{chosen} does not show {pattern}:\n{outputs[chosen]}"
        assert_plan_names_refused_field(shell, tmp_path)
    finally:
        world.drone_status("drone-1", "inactive")
        shell.type(delete)
    assert world.application("default", NAME) is None


def assert_plan_names_refused_field(shell: Shell, folder: Path) -> None:
    """Check that `fractus plan` names file, line and field of an object that the new version refuses."""
    (everything,) = (line for line in COMMANDS if line.endswith("applications -A -o yaml"))
    shell.type(f"{everything} > all.yaml")
    shell.type("fractus plan -f all.yaml")
    file = folder / "all.yaml"
    file.write_text(file.read_text().replace("upperLimit: ", "upperLimit: -", 1))
    assert re.match(r"fractus: all.yaml:\d+: Policy .*upperLimit", shell.type("fractus plan -f all.yaml 2>&1", code=1))


def test_view_opens_with_the_token_of_its_secret(world: World, tmp_path: Path) -> None:
    shell = Shell(tmp_path, world.plane)
    create, _forward, open_ = (line for line in shell_lines("docs/view.md") if "fractus-view" in line)
    secret = f"/api/v1/namespaces/{SYSTEM}/secrets/fractus-view"
    shell.type(create)
    try:
        address = shell.type(open_).strip()
        stored = base64.b64decode((world.api.get(secret) or {})["data"]["token"]).decode()
    finally:
        world.api.delete(secret)
    assert address == f"http://127.0.0.1:8650/?token={stored}"
    assert len(stored) == 48


def test_view_shows_the_cluster_of_kubeconfig(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    line, *_ = (line for line in shell_lines("docs/view.md") if line.startswith("fractus view"))
    monkeypatch.setenv("KUBECONFIG", str(world.plane.kubeconfig))
    with serving(*shlex.split(line, comments=True)[2:]) as address:
        wait_for_events(address, '"drone-1"', '"edge-3"', '"base"')
