"""The chart fractus on a bare control plane: what it makes, but its workloads."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from fractus_cluster.binaries import KUBERNETES_VERSIONS, chosen_kubernetes
from operator_world import SYSTEM, World

Body = dict[str, Any]
CHARTS = Path(__file__).parents[2] / "charts"
_GOLDEN = Path(__file__).parents[1] / "golden" / "charts" / "values"
EVERYTHING = {chart: _GOLDEN / f"{chart}.yaml" for chart in ("fractus", "fractus-demo")}
"""Values with all switched on that can be, and all set that is empty by itself."""

KUBERNETES = f"--kube-version={KUBERNETES_VERSIONS[chosen_kubernetes()]}"
_PLURALS = {
    "NetworkPolicy": "networkpolicies",
    "PriorityClass": "priorityclasses",
    "ValidatingAdmissionPolicy": "validatingadmissionpolicies",
}


def install(world: World) -> None:
    """Make accounts, roles and admission policies."""
    world.api.apply(
        f"/api/v1/namespaces/{SYSTEM}", {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": SYSTEM}}
    )
    for body in render():
        if body["kind"] not in {"Deployment", "DaemonSet", "Pod"}:
            world.api.apply(path_of(body), body)


def uninstall(world: World) -> None:
    """Lift what would refuse later tests what they do as administrators, such as removing drones that fly."""
    for body in render():
        if body["kind"] == "ValidatingAdmissionPolicyBinding":
            world.api.delete(path_of(body))


def render(*arguments: str, chart: str | Path = "fractus") -> list[Body]:
    """The objects of a chart, one of the checkout's by its name or another by its path, rendered by helm."""
    argv = [helm(), "template", Path(chart).stem, str(CHARTS / chart), "--namespace", SYSTEM, KUBERNETES]
    done = subprocess.run([*argv, *arguments], capture_output=True, text=True, timeout=60, check=True)
    return [body for body in yaml.load_all(done.stdout, Loader=yaml.CSafeLoader) if body]


def values_of(chart: str) -> Iterator[tuple[str, Any]]:
    """The values of a chart with their names, but for limits and labels, where one that is missing is meant to be."""

    def within(values: Body, above: str) -> Iterator[tuple[str, Any]]:
        for key, value in values.items():
            yield f"{above}{key}", value
            if isinstance(value, dict) and key not in {"resources", "labels"}:
                yield from within(value, f"{above}{key}.")

    return within(yaml.safe_load((CHARTS / chart / "values.yaml").read_text()), "")


def helm() -> str:
    """The program, as the embedded cluster has it, or from the PATH."""
    caches = sorted((Path.home() / ".cache" / "fractus").glob("*/bin/helm"), reverse=True)
    return str(caches[0]) if caches else "helm"


def operator_token(world: World) -> str:
    """A token of the operator's account."""
    path = f"/api/v1/namespaces/{SYSTEM}/serviceaccounts/fractus-operator/token"
    request = {"apiVersion": "authentication.k8s.io/v1", "kind": "TokenRequest", "spec": {"expirationSeconds": 600}}
    return str(world.api.call("POST", path, request)["status"]["token"])


def path_of(body: Body) -> str:
    """Where the API server keeps an object."""
    plural = _PLURALS.get(body["kind"], f"{body['kind'].lower()}s")
    root = "/apis/" if "/" in body["apiVersion"] else "/api/"
    namespace = body["metadata"].get("namespace")
    scope = f"/namespaces/{namespace}" if namespace else ""
    return f"{root}{body['apiVersion']}{scope}/{plural}/{body['metadata']['name']}"
