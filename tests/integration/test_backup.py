"""Run the commands of docs/backup.md: restore objects and authority in a second cluster. Then uninstall Fractus."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from control_plane import ControlPlane, programs, wait_for
from cryptography import x509
from docs_pages import ROOT, shell_lines
from docs_shell import Shell
from fractus_core.api import Grant
from fractus_core.policy.grant_signatures import verify
from operator_world import FRACTUS, SYSTEM, Body, OperatorProcess, World, at, fractus_object, traffic

pytestmark = pytest.mark.slow

PAGE = "docs/backup.md"
*BACK_UP, VALUES = (line for line in shell_lines(PAGE, "Back up") if "MOBILITY-POD" not in line)
RESTORE = shell_lines(PAGE, "Restore")
KEPT = ("policies", "zones", "depots", "drones", "edgenodes", "applications")
SERVER_S = {"uid", "resourceVersion", "generation", "creationTimestamp", "managedFields", "annotations"}
"""Metadata that an API server or kubectl writes."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder that contains the charts, like a checkout."""
    (tmp_path / "charts").symlink_to(ROOT / "charts")
    return tmp_path


@pytest.fixture
def found(folder: Path, namespace: str) -> Iterator[World]:
    """A cluster without Fractus that has nodes and the namespace of the Applications."""
    plane = ControlPlane(programs(), folder / "found")
    try:
        plane.start(kinds=False)
        world = World(plane)
        for name, of in (("drone-1", "drone"), *((f"edge-{i}", "edge") for i in (1, 2, 3)), ("cloud-1", "cloud")):
            world.add_node(name, of)
        world.api.apply(
            f"/api/v1/namespaces/{namespace}",
            {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": namespace}},
        )
        yield world
    finally:
        plane.stop()


def written(world: World) -> dict[str, Body]:
    """Return the objects of users and authorities by kind and name, without status and server metadata."""
    found = {}
    for body in (body for plural in KEPT for body in world.api.list(f"{FRACTUS}/{plural}")):
        metadata = {key: value for key, value in body["metadata"].items() if key not in SERVER_S}
        found[f"{body['kind']} {metadata['name']}"] = {**body, "metadata": metadata, "status": None}
    return found


def granted(world: World, namespace: str) -> dict[str, Body]:
    """Return the specs of the application's Grants without the fields that differ between missions."""
    grants = {body["metadata"]["name"]: dict(body["spec"]) for body in world.grants(namespace)}
    for spec in grants.values():
        del spec["mission"], spec["application"]["uid"], spec["issuedAt"]
    return grants


def authority(world: World) -> bytes:
    """Return the CA certificate with which nodes verify Grants, in PEM."""
    public = world.api.get(f"/api/v1/namespaces/{SYSTEM}/configmaps/fractus-ca") or {}
    return str(public["data"]["ca.crt"]).encode()


def test_backup_is_restored_into_another_cluster_and_uninstalled(
    world: World, operator: OperatorProcess, found: World, namespace: str, folder: Path
) -> None:
    world.put(fractus_object("Zone", "school", {"area": {"circle": {"center": at(40, 180), "radius": 30}}}))
    no_school = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["school"]}}
    world.put(fractus_object("Policy", "no-school", no_school))
    (folder / "application.yaml").write_text(json.dumps(traffic(namespace)))
    lost = Shell(folder, world.plane)
    shell = Shell(folder, found.plane)
    lost.type("kubectl apply -f application.yaml")
    world.phase(namespace, "Deploying")
    operator.stop(signal.SIGKILL)
    before = written(world)
    may = granted(world, namespace)
    signed_by = authority(world)
    for line in BACK_UP:
        lost.type(line)

    values = {"logFormat": "json", "operator": {"replicas": 1}}
    (folder / "values.yaml").write_text(yaml.safe_dump(values))
    for line in RESTORE:
        shell.type(line)
    assert found.api.get(f"{FRACTUS}/drones/drone-1"), (
        "the Drone is missing, so an agent would create it from the node description"
    )
    found.drone_status("drone-1", "inactive")
    again = OperatorProcess(found.plane.kubeconfig, folder / "found.log")
    again.start()
    try:
        found.phase(namespace, "Deploying")
        assert written(found) == before
        assert granted(found, namespace) == may != {}
        assert authority(found) == signed_by
        for body in found.grants(namespace):
            verify(Grant.from_body(body), x509.load_pem_x509_certificates(signed_by))

        (folder / "values.yaml").unlink()
        shell.type(VALUES)
        assert yaml.safe_load((folder / "values.yaml").read_text()) == values
        found.api.delete(f"{FRACTUS}/zones/school")
        found.api.merge(f"{FRACTUS}/drones/drone-1", {"spec": {"home": at(9, 9, alt=9)}})
        shell.type("kubectl apply -f fractus.yaml")
        assert written(found) == before
        # The manifest from version control has no finalizer. The operator adds it again.
        shell.type("kubectl apply -f application.yaml")
        wait_for(lambda: written(found) == before, "the Application to equal the backed up Application")
        shell.type(REMOVE[0])
    finally:
        again.stop(signal.SIGKILL)
    remove(found, shell)


REMOVE = shell_lines("docs/upgrades.md", "Uninstall")
EVERYWHERE = "clusterroles,clusterrolebindings,validatingadmissionpolicies,validatingadmissionpolicybindings,priorityclasses,crds"
INSIDE = "deployments,daemonsets,jobs,services,serviceaccounts,roles,rolebindings,secrets,configmaps,leases"


def remove(world: World, shell: Shell) -> None:
    """Uninstall Fractus without helm's hooks, as docs/upgrades.md describes, because hooks need a kubelet."""
    world.api.merge(
        "/api/v1/nodes/drone-1", {"spec": {"taints": [{"key": "fractus.dev/class", "effect": "NoExecute"}]}}
    )
    # Report the drone as landed, like its agent after its Grants are deleted.
    world.drone_status("drone-1", "inactive")
    attempt = f"kubectl -n {SYSTEM} delete daemonset fractus-mobility --dry-run=server || true"
    wait_for(lambda: "deleted" in shell.type(attempt), "the admission policies to allow the deletion")
    for line in REMOVE:
        if re.search(r"uninstall fractus(-crds)?$", line):
            shell.type(f"{line} --no-hooks")
    for line in REMOVE:
        if re.search(r"label|lease|secret|removal", line) and "install" not in line:
            shell.type(line)
    for begins in ("kubectl delete crd", "kubectl label nodes", "kubectl taint nodes"):
        (line,) = re.findall(rf"`({begins}[^`]*)`", (ROOT / "docs/upgrades.md").read_text())
        # kubectl exits with 1 because some nodes do not have the taint.
        shell.type(line, code=1 if "taint" in line else 0)
    assert "fractus" not in shell.type(f"kubectl get {EVERYWHERE} -o name")
    assert "fractus" not in shell.type(f"kubectl get -n {SYSTEM} {INSIDE} -o name")
    nodes = world.api.list("/api/v1/nodes")
    assert len(nodes) == 5
    assert "fractus.dev" not in str([(node["metadata"].get("labels"), node["spec"].get("taints")) for node in nodes])
