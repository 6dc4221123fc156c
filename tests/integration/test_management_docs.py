"""The walkthrough of docs/management-api.md, on a real API server with the operator."""

from __future__ import annotations

from pathlib import Path

from docs_pages import shell_lines
from docs_shell import Shell
from management_server import ManagementServer, User
from operator_world import World


def test_documented_walkthrough_orders_and_ends_a_flight(
    pilot: User, world: World, management: ManagementServer, tmp_path: Path
) -> None:
    lines = shell_lines("docs/management-api.md", "Fly in ten minutes")
    script = "\n".join(line for line in lines if "--no-buffer" not in line)
    assert "API=http://127.0.0.1:8660\n" in script
    script = script.replace("http://127.0.0.1:8660", management.url)
    script = script.replace("50.864239", "39.36105").replace("4.679068", "22.93128")
    try:
        output = Shell(tmp_path, world.plane).type(f"set -eu\n{script}")
    finally:
        world.api.delete("/api/v1/namespaces/team")
        for name in ("alice-drones", "alice-apps"):
            world.api.delete(f"/apis/rbac.authorization.k8s.io/v1/clusterrolebindings/{name}")
    shown = output.splitlines()
    for expected in ("survey", "Accepted", "drone-1 is reserved", "Accepted", "drone-1", "InUse", "Accepted", "Ended"):
        assert expected in shown, output
        shown = shown[shown.index(expected) + 1 :]
