"""Rendering of the charts, and objects of the chart fractus on a control plane without nodes."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Any

import yaml
from control_plane import wait_for
from fractus_cluster.binaries import KUBERNETES_VERSIONS, chosen_kubernetes
from fractus_runtime.kubernetes import KubeError
from operator_world import SYSTEM, World

Body = dict[str, Any]
CHARTS = Path(__file__).parents[2] / "charts"
_GOLDEN = Path(__file__).parents[1] / "golden" / "charts" / "values"
EVERYTHING = {chart: _GOLDEN / f"{chart}.yaml" for chart in ("fractus", "fractus-demo")}
"""Values files that enable every option and set every value that is empty by default."""

KUBERNETES = f"--kube-version={KUBERNETES_VERSIONS[chosen_kubernetes()]}"
_PLURALS = {
    "NetworkPolicy": "networkpolicies",
    "PriorityClass": "priorityclasses",
    "ValidatingAdmissionPolicy": "validatingadmissionpolicies",
}
_LAST = "last-policy"
"""Name of the admission policy that is created after those of the chart, and of the ConfigMap that it refuses."""


def install(world: World) -> None:
    """Create the objects of the chart except workloads: accounts, roles and admission policies."""
    world.api.apply(
        f"/api/v1/namespaces/{SYSTEM}", {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": SYSTEM}}
    )
    for body in render():
        if body["kind"] not in {"Deployment", "DaemonSet", "Pod"}:
            world.api.apply(path_of(body), body)
    _await_policies(world)


def _await_policies(world: World) -> None:
    """Wait until the admission policies are in force, with a policy that is created after them and refuses one ConfigMap.

    The API server adopts new policies about once per second, all of them together.
    """
    rule = {"apiGroups": [""], "apiVersions": ["v1"], "resources": ["configmaps"], "operations": ["CREATE"]}
    specs = {
        "ValidatingAdmissionPolicy": {
            "matchConstraints": {"resourceRules": [rule]},
            "validations": [{"expression": f"object.metadata.name != '{_LAST}'"}],
        },
        "ValidatingAdmissionPolicyBinding": {"policyName": _LAST, "validationActions": ["Deny"]},
    }
    objects = [
        {"apiVersion": "admissionregistration.k8s.io/v1", "kind": kind, "metadata": {"name": _LAST}, "spec": spec}
        for kind, spec in specs.items()
    ]
    probe = {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": _LAST}}

    def in_force() -> bool:
        try:
            world.api.call("POST", f"/api/v1/namespaces/{SYSTEM}/configmaps?dryRun=All", probe)
        except KubeError as error:
            return error.status == HTTPStatus.UNPROCESSABLE_ENTITY
        return False

    try:
        for body in objects:
            world.api.apply(path_of(body), body)
        wait_for(in_force, "the admission policies to be in force")
    finally:
        for body in objects:
            world.api.delete(path_of(body))


def uninstall(world: World) -> None:
    """Remove the admission policies, which would refuse actions of later tests, such as removing drones in flight."""
    for body in render():
        if body["kind"] == "ValidatingAdmissionPolicyBinding":
            world.api.delete(path_of(body))


def render(*arguments: str, chart: str | Path = "fractus") -> list[Body]:
    """Return the objects of a chart, rendered by helm.

    Args:
        arguments: Further arguments of `helm template`.
        chart: Name of a chart of the checkout, or path of another chart.
    """
    argv = [helm(), "template", Path(chart).stem, str(CHARTS / chart), "--namespace", SYSTEM, KUBERNETES]
    result = subprocess.run([*argv, *arguments], capture_output=True, text=True, timeout=60, check=True)
    return [body for body in yaml.load_all(result.stdout, Loader=yaml.CSafeLoader) if body]


def values_of(chart: str) -> Iterator[tuple[str, Any]]:
    """Return the names and default values of a chart. Fields of resources and labels are omitted, because they are optional."""

    def within(values: Body, prefix: str) -> Iterator[tuple[str, Any]]:
        for key, value in values.items():
            yield f"{prefix}{key}", value
            if isinstance(value, dict) and key not in {"resources", "labels"}:
                yield from within(value, f"{prefix}{key}.")

    return within(yaml.safe_load((CHARTS / chart / "values.yaml").read_text()), "")


def helm() -> str:
    """Return the path of helm: the program of the embedded cluster, or `helm` on the PATH."""
    caches = sorted((Path.home() / ".cache" / "fractus").glob("*/bin/helm"), reverse=True)
    return str(caches[0]) if caches else "helm"


def operator_token(world: World) -> str:
    """Return a token of the operator's account."""
    path = f"/api/v1/namespaces/{SYSTEM}/serviceaccounts/fractus-operator/token"
    request = {"apiVersion": "authentication.k8s.io/v1", "kind": "TokenRequest", "spec": {"expirationSeconds": 600}}
    return str(world.api.call("POST", path, request)["status"]["token"])


def path_of(body: Body) -> str:
    """Return the path of an object at the API server."""
    plural = _PLURALS.get(body["kind"], f"{body['kind'].lower()}s")
    root = "/apis/" if "/" in body["apiVersion"] else "/api/"
    namespace = body["metadata"].get("namespace")
    scope = f"/namespaces/{namespace}" if namespace else ""
    return f"{root}{body['apiVersion']}{scope}/{plural}/{body['metadata']['name']}"
