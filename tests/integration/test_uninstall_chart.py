"""Hooks of `helm uninstall`: when they wipe nodes, and which objects they remove on a real API server."""

from __future__ import annotations

import base64
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from chart import path_of, render
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from operator_world import SYSTEM, World

pytestmark = pytest.mark.slow

Body = dict[str, Any]
WIPE_NODES = "--set=uninstall.wipeNodes=true"
WIPE = (WIPE_NODES, "--is-upgrade")
CORE = f"/api/v1/namespaces/{SYSTEM}"
LEASES = f"/apis/coordination.k8s.io/v1/namespaces/{SYSTEM}/leases"
REQUESTS = "/apis/certificates.k8s.io/v1/certificatesigningrequests"


def is_hook(body: Body) -> bool:
    """Return True if helm creates the object after it has deleted the release."""
    return (body["metadata"].get("annotations") or {}).get("helm.sh/hook") == "post-delete"


def hooks(*arguments: str) -> list[Body]:
    """Return the objects that helm creates after it has deleted the release, in order of creation."""
    return sorted(
        filter(is_hook, render(*arguments)),
        key=lambda body: int(body["metadata"]["annotations"]["helm.sh/hook-weight"]),
    )


def test_uninstall_wipes_nodes_only_if_enabled() -> None:
    disabled = render()
    enabled = render(*WIPE)
    created = hooks(*WIPE)
    assert not [body for body in disabled if "wipe" in str(body)]
    release = [body for body in disabled if not is_hook(body)]
    assert [body for body in enabled if not is_hook(body)] == release, (
        "the value uninstall.wipeNodes changes running workloads"
    )
    assert [body["kind"] for body in created][-2:] == ["DaemonSet", "Job"]
    for body in created:
        assert body["metadata"]["annotations"]["helm.sh/hook-delete-policy"] == "before-hook-creation,hook-succeeded"


def test_wipe_pod_has_access_only_to_state_of_node() -> None:
    (body,) = (body for body in hooks(*WIPE, "--set=host.state=/data/fractus") if body["kind"] == "DaemonSet")
    pod = body["spec"]["template"]["spec"]
    sets = {b["metadata"]["name"]: b["spec"]["template"] for b in render() if b["kind"] == "DaemonSet"}
    agent = sets["fractus-agent"]["spec"]
    assert pod["affinity"]["nodeAffinity"] == agent["affinity"]["nodeAffinity"]
    assert pod["tolerations"] == agent["tolerations"]
    assert pod["volumes"] == [{"name": "state", "hostPath": {"path": "/data/fractus", "type": "DirectoryOrCreate"}}]
    (apart,) = pod["affinity"]["podAntiAffinity"]["requiredDuringSchedulingIgnoredDuringExecution"]
    services = {template["metadata"]["labels"]["app.kubernetes.io/component"] for template in sets.values()}
    assert set(apart["labelSelector"]["matchExpressions"][1]["values"]) == services
    for key in ("hostNetwork", "hostPID", "hostIPC", "priorityClassName"):
        assert key not in pod  # helm has already deleted the PriorityClass
    assert not pod["automountServiceAccountToken"]
    for container in pod["initContainers"] + pod["containers"]:
        assert not container["securityContext"]["allowPrivilegeEscalation"]
        assert container["securityContext"]["capabilities"] == {"drop": ["ALL"]}


@pytest.mark.parametrize(
    "path",
    [
        *("/data", "/var/lib", "/fractus", "/data/fractus/..", "/", "var/lib/fractus", "", "/fractus/"),
        *("/home/fractus", "/home/fractus/data", "/root/fractus", "/var/lib/fractusd-shared", "/data/my-fractus"),
    ],
)
def test_wipe_is_refused_for_ambiguous_directory(path: str) -> None:
    with pytest.raises(subprocess.CalledProcessError) as refused:
        render(*WIPE, f"--set=host.state={path}")
    assert "host" in refused.value.stderr
    assert "state" in refused.value.stderr


@pytest.mark.parametrize("path", ["/var/lib/fractus", "/data/fractus/", "/opt/fractus/state"])
def test_wipe_is_accepted_for_directory_of_fractus(path: str) -> None:
    assert render(*WIPE, f"--set=host.state={path}")


@pytest.mark.parametrize(
    ("state", "config"),
    [
        ("/var/lib/fractus", "/var/lib/fractus/etc"),
        ("/etc/fractus", "/etc/fractus"),
        ("/data/fractus/", "/data//x/../fractus/./etc/"),
    ],
)
def test_wipe_is_refused_if_directory_contains_node_descriptions(state: str, config: str) -> None:
    set_ = (f"--set=host.state={state}", f"--set=host.config={config}")
    assert render(*set_)
    with pytest.raises(subprocess.CalledProcessError) as refused:
        render(*WIPE, *set_)
    assert f"host.config, {config}, with the node descriptions, is inside host.state, {state}" in refused.value.stderr
    assert render(*WIPE, "--set=host.state=/data/fractus", "--set=host.config=/data/fractus-config")


def test_wipe_is_not_rendered_without_cluster() -> None:
    """Argo CD always renders the chart as an installation. A wipe value that remains must not block other changes."""
    assert render(WIPE_NODES) == render()


def test_wipe_is_refused_at_installation(world: World) -> None:
    """A failed `helm install --atomic` runs the uninstall hooks, which would wipe existing data of nodes."""
    with pytest.raises(subprocess.CalledProcessError) as refused:
        render(*with_lookups(world, WIPE_NODES))
    assert "set it with an upgrade just before uninstalling" in refused.value.stderr


def with_lookups(world: World, *arguments: str) -> tuple[str, ...]:
    """Return arguments with which helm looks up objects of the API server while it renders."""
    return (*arguments, "--dry-run=server", f"--kubeconfig={world.plane.kubeconfig}")


@pytest.mark.parametrize("arguments", [(), ("--is-upgrade",)])
def test_chart_is_refused_while_wipe_daemon_set_remains(world: World, arguments: tuple[str, ...]) -> None:
    """A wipe DaemonSet that remains would keep agents from its nodes, or wipe a node in use."""
    assert render(*with_lookups(world, *arguments))
    (body,) = (body for body in hooks(*WIPE) if body["kind"] == "DaemonSet")
    world.api.apply(path_of(body), body)
    try:
        with pytest.raises(subprocess.CalledProcessError) as refused:
            render(*with_lookups(world, *arguments))
    finally:
        world.api.delete(path_of(body))
    assert f"kubectl -n {SYSTEM} delete daemonset fractus-wipe" in refused.value.stderr


def test_failed_installation_keeps_existing_authority(world: World, remaining: list[str], tmp_path: Path) -> None:
    """The rollback of a failed installation must not delete an authority that was restored from a backup."""
    upgraded = hooks(*with_lookups(world, "--is-upgrade"))
    installed = hooks(*with_lookups(world))
    assert "keep" not in str(upgraded)
    for body in installed:
        if body["kind"] == "Role":
            assert not [rule for rule in body["rules"] if "secrets" in rule["resources"]]
            world.api.apply(path_of(body), body)
    result = run_removal(world, tmp_path, installed)
    assert result.returncode == 0, result.stderr
    assert [path for path in remaining if world.api.get(path)] == [f"{CORE}/secrets/fractus-ca"]


@pytest.fixture
def remaining(world: World) -> Iterator[list[str]]:
    """Create the objects that operator and agents leave when the release is deleted, and return their paths.

    Also create similar objects of other owners, which must not be removed.
    """
    for body in hooks():
        if body["kind"] != "Job":
            world.api.apply(path_of(body), body)
    authority = {"apiVersion": "v1", "kind": "Secret", "metadata": {"name": "fractus-ca", "namespace": SYSTEM}}
    world.api.apply(f"{CORE}/secrets/fractus-ca", authority)
    world.api.apply(f"{CORE}/secrets/other", authority | {"metadata": {"name": "other", "namespace": SYSTEM}})
    public = authority | {"kind": "ConfigMap"}
    world.api.apply(f"{CORE}/configmaps/fractus-ca", public)
    lease = {"apiVersion": "coordination.k8s.io/v1", "kind": "Lease", "metadata": {"name": "fractus-operator", "namespace": SYSTEM}}  # fmt: skip
    world.api.apply(f"{LEASES}/fractus-operator", lease)
    labels = {f"fractus.dev/{n}": "true" for n in ("depot", "geohash", "guarded", "interface-wifi")}
    world.api.merge("/api/v1/nodes/drone-1", {"metadata": {"labels": labels | {"example.com/mine": "yes"}}})
    for name, signer in (("fractus-node", "fractus.dev/node"), ("foreign", "example.com/other")):
        spec = {
            "request": base64.b64encode(signing_request()).decode(),
            "signerName": signer,
            "usages": ["client auth"],
        }
        head = {"apiVersion": "certificates.k8s.io/v1", "kind": "CertificateSigningRequest", "metadata": {"name": name}}
        if not world.api.get(f"{REQUESTS}/{name}"):
            world.api.call("POST", REQUESTS, head | {"spec": spec})
    created = [f"{CORE}/secrets/fractus-ca", f"{CORE}/configmaps/fractus-ca", f"{LEASES}/fractus-operator"]
    yield [*created, f"{REQUESTS}/fractus-node"]
    for path in (f"{CORE}/secrets/other", f"{REQUESTS}/foreign", *created, *map(path_of, hooks())):
        if world.api.get(path):
            world.api.delete(path)


def signing_request() -> bytes:
    """Return a certificate signing request in PEM."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "drone-1")])
    signed = x509.CertificateSigningRequestBuilder().subject_name(name).sign(key, hashes.SHA256())
    return signed.public_bytes(serialization.Encoding.PEM)


def run_removal(world: World, tmp_path: Path, objects: list[Body] | None = None) -> subprocess.CompletedProcess[str]:
    """Run the program of the Job fractus-removal with the Job's account."""
    request = {"apiVersion": "authentication.k8s.io/v1", "kind": "TokenRequest", "spec": {"expirationSeconds": 600}}
    token = world.api.call("POST", f"{CORE}/serviceaccounts/fractus-removal/token", request)["status"]["token"]
    config = {
        "apiVersion": "v1",
        "kind": "Config",
        "current-context": "removal",
        "clusters": [
            {"name": "test", "cluster": {"server": world.plane.server, "certificate-authority": str(world.plane.ca)}}
        ],
        "users": [{"name": "removal", "user": {"token": token}}],
        "contexts": [{"name": "removal", "context": {"cluster": "test", "user": "removal"}}],
    }
    kubeconfig = tmp_path / "kubeconfig"
    kubeconfig.write_text(yaml.safe_dump(config))
    (job,) = (body for body in objects or hooks() if body["kind"] == "Job")
    (container,) = job["spec"]["template"]["spec"]["containers"]
    command = [sys.executable, *container["command"][1:], *container["args"]]
    return subprocess.run(
        command, env={**os.environ, "KUBECONFIG": str(kubeconfig)}, capture_output=True, text=True, timeout=120, check=False
    )  # fmt: skip


def test_uninstall_removes_only_objects_of_operator(world: World, remaining: list[str], tmp_path: Path) -> None:
    for attempt in ("first", "repeated"):
        result = run_removal(world, tmp_path)
        assert result.returncode == 0, (attempt, result.stderr)
        assert not [path for path in remaining if world.api.get(path)]
    node = world.api.get("/api/v1/nodes/drone-1") or {}
    labels = {label: value for label, value in node["metadata"]["labels"].items() if "fractus.dev" in label}
    assert labels == {"fractus.dev/class": "drone"}
    assert node["metadata"]["labels"]["example.com/mine"] == "yes"
    assert world.api.get(f"{CORE}/secrets/other")
    assert world.api.get(f"{REQUESTS}/foreign")


def test_uninstall_reports_refused_deletions(world: World, remaining: list[str], tmp_path: Path) -> None:
    role = next(path_of(body) for body in hooks() if body["kind"] == "Role")
    world.api.delete(role)
    result = run_removal(world, tmp_path)
    assert result.returncode == 1
    assert "some objects of Fractus were not removed" in result.stderr
    assert f"Secret {SYSTEM}/fractus-ca" in result.stderr
    assert [path for path in remaining if world.api.get(path)] == [path for path in remaining if SYSTEM in path]


def test_uninstall_job_removes_nothing_while_operator_is_installed(
    world: World, remaining: list[str], tmp_path: Path
) -> None:
    """Tools without hook support create the Job together with the objects that it would remove."""
    (operator,) = (body for body in render() if body["kind"] == "Deployment" and "operator" in body["metadata"]["name"])
    world.api.apply(path_of(operator), operator)
    try:
        result = run_removal(world, tmp_path)
    finally:
        world.api.delete(path_of(operator))
    assert result.returncode == 1
    assert f"nothing was removed: Fractus is installed in {SYSTEM}" in result.stderr
    assert [path for path in remaining if world.api.get(path)] == remaining
    assert run_removal(world, tmp_path).returncode == 0
