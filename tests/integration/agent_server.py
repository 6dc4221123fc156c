"""Control plane for tests of the agent. Its API server can be stopped, killed, frozen and started again."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import signal
import subprocess
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from agent_pki import TestAuthority
from control_plane import ControlPlane, programs, wait_for
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from fractus_core.api.grants import NODE_GRANTS_NAMESPACE, pack
from fractus_runtime.kubernetes import KubeError

FRACTUS = "/apis/fractus.dev/v1alpha1"
REQUESTS = "/apis/certificates.k8s.io/v1/certificatesigningrequests"
RULES: list[dict[str, list[str]]] = [
    {"apiGroups": ["fractus.dev"], "resources": ["drones", "edgenodes"], "verbs": ["get", "create", "update"]},
    {"apiGroups": ["fractus.dev"], "resources": ["directlinks"], "verbs": ["get", "list", "watch"]},
    {
        "apiGroups": ["fractus.dev"],
        "resources": ["drones/status", "edgenodes/status", "directlinks/status"],
        "verbs": ["patch"],
    },
    {"apiGroups": [""], "resources": ["nodes"], "verbs": ["get"]},
    {
        "apiGroups": ["certificates.k8s.io"],
        "resources": ["certificatesigningrequests"],
        "verbs": ["create", "get", "list", "delete"],
    },
    {"apiGroups": [""], "resources": ["configmaps"], "resourceNames": ["fractus-ca"], "verbs": ["get"]},
]
"""Permissions of the agent in the chart."""
RBAC = "/apis/rbac.authorization.k8s.io/v1"
ACCOUNTS = f"/api/v1/namespaces/{NODE_GRANTS_NAMESPACE}/serviceaccounts"
NODE_GRANTS = f"{FRACTUS}/namespaces/{NODE_GRANTS_NAMESPACE}/nodegrants"


class ApiServer(ControlPlane):
    """A control plane whose API server can be stopped and started again with its data.

    Attributes:
        signer: Key and certificate with which Grants are signed.
    """

    signer: tuple[ec.EllipticCurvePrivateKey, x509.Certificate]

    def stop_apiserver(self, number: int = signal.SIGKILL) -> None:
        process = self._processes["kube-apiserver"]
        process.send_signal(number)
        process.wait(20)

    def start_apiserver(self) -> None:
        with (self._directory / "kube-apiserver.log").open("ab") as log:
            process = subprocess.Popen(self._arguments(), stdout=log, stderr=log, cwd=self._directory)
        self._processes["kube-apiserver"] = process
        wait_for(self.admin.ready, "the API server", timeout_s=60)

    def _arguments(self) -> list[str]:
        arguments = self._processes["kube-apiserver"].args
        assert isinstance(arguments, list)
        return [str(a) for a in arguments]

    @contextlib.contextmanager
    def frozen(self) -> Iterator[None]:
        """Stop the API server's process, so that it keeps its connections but sends nothing."""
        pid = self._processes["kube-apiserver"].pid
        os.kill(pid, signal.SIGSTOP)
        try:
            yield
        finally:
            os.kill(pid, signal.SIGCONT)

    def compact(self) -> None:
        """Remove old revisions from etcd, so that the API server refuses watches from these revisions with 410."""
        etcd = next(a for a in self._arguments() if a.startswith("--etcd-servers=")).split("=", 1)[1]
        key = base64.b64encode(b"/").decode()
        revision = _post(f"{etcd}/v3/kv/range", {"key": key})["header"]["revision"]
        _post(f"{etcd}/v3/kv/compaction", {"revision": revision})

    def get(self, path: str) -> dict[str, Any] | None:
        return self.admin.get(path)

    def post(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        return self.admin.call("POST", path, body)

    def delete(self, path: str) -> None:
        with contextlib.suppress(KubeError):
            self.admin.call("DELETE", path)

    @property
    def agent_kubeconfig(self) -> Path:
        """Kubeconfig with the permissions of the agent."""
        return self._directory / "agent.kubeconfig"

    def furnish(self, ca_pem: bytes) -> None:
        """Create the namespaces of Fractus, the published authority, and the permissions of the agent."""
        self.write_kubeconfig("agent", "agent")
        for namespace in ("fractus-system", NODE_GRANTS_NAMESPACE):
            self.post("/api/v1/namespaces", {"metadata": {"name": namespace}})
        data = {"metadata": {"name": "fractus-ca"}, "data": {"ca.crt": ca_pem.decode()}}
        self.post("/api/v1/namespaces/fractus-system/configmaps", data)
        self.post(f"{RBAC}/clusterroles", {"metadata": {"name": "agent"}, "rules": RULES})
        self.post(f"{RBAC}/clusterrolebindings", _binding("agent", "ClusterRole", AGENT))
        tokens = {"apiGroups": [""], "resources": ["serviceaccounts/token"], "verbs": ["create"]}
        self._permit("agent", [tokens], AGENT)

    def publish(self, node: str) -> None:
        """Create the objects of a node like the operator: its NodeGrants object, and an account that may read it."""
        if self.get(f"{ACCOUNTS}/{node}") is None:
            self.post(ACCOUNTS, {"metadata": {"name": node}})
        if self.get(f"{RBAC}/namespaces/{NODE_GRANTS_NAMESPACE}/roles/{node}") is None:
            of_node = {"apiGroups": ["fractus.dev"], "resourceNames": [node]}
            rules = [
                of_node | {"resources": ["nodegrants"], "verbs": ["get", "list", "watch"]},
                of_node | {"resources": ["nodegrants/status"], "verbs": ["patch"]},
            ]
            self._permit(node, rules, {"kind": "ServiceAccount", "name": node, "namespace": NODE_GRANTS_NAMESPACE})
        grants = self.admin.list(f"{FRACTUS}/grants", fieldSelector=f"spec.node={node}")
        body = {
            "apiVersion": "fractus.dev/v1alpha1",
            "kind": "NodeGrants",
            "metadata": {"name": node, "namespace": NODE_GRANTS_NAMESPACE},
            "spec": {"count": len(grants), "packed": pack(grants)},
        }
        self.admin.apply(f"{NODE_GRANTS}/{node}", body)

    def reported(self, node: str, grant: str) -> dict[str, Any]:
        """Return the reported state of a Grant in the status of the NodeGrants, or an empty dict."""
        status = (self.get(f"{NODE_GRANTS}/{node}") or {}).get("status") or {}
        return next((report for report in status.get("grants", ()) if report["name"] == grant), {})

    def _permit(self, name: str, rules: list[dict[str, Any]], subject: dict[str, str]) -> None:
        path = f"{RBAC}/namespaces/{NODE_GRANTS_NAMESPACE}"
        self.post(f"{path}/roles", {"metadata": {"name": name}, "rules": rules})
        self.post(f"{path}/rolebindings", _binding(name, "Role", subject))

    def sign_requests(self, authority: TestAuthority) -> int:
        """Approve and sign all pending signing requests like the operator, and return their number."""
        signed = 0
        for body in self.admin.list(REQUESTS):
            status = body.get("status") or {}
            if status.get("certificate") or status.get("conditions"):
                continue
            path = f"{REQUESTS}/{body['metadata']['name']}"
            body["status"] = {"conditions": [{"type": "Approved", "status": "True", "reason": "Test", "message": "x"}]}
            approved = self.admin.call("PUT", f"{path}/approval", body)
            pem = authority.sign(base64.b64decode(approved["spec"]["request"]))
            approved["status"]["certificate"] = base64.b64encode(pem).decode()
            self.admin.call("PUT", f"{path}/status", approved)
            signed += 1
        return signed


AGENT = {"kind": "User", "name": "agent", "apiGroup": "rbac.authorization.k8s.io"}


def _binding(name: str, kind: str, subject: dict[str, str]) -> dict[str, Any]:
    role = {"apiGroup": "rbac.authorization.k8s.io", "kind": kind, "name": name}
    return {"metadata": {"name": name}, "roleRef": role, "subjects": [subject]}


def _post(url: str, body: dict[str, Any]) -> dict[str, Any]:
    request = urllib.request.Request(url, json.dumps(body).encode(), {"Content-Type": "application/json"})
    with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(request, timeout=5.0) as response:
        return dict(json.load(response))


@contextlib.contextmanager
def running(directory: Path) -> Iterator[ApiServer]:
    """Run a control plane until the block ends."""
    server = ApiServer(programs(), directory)
    try:
        server.start()
        yield server
    finally:
        server.stop()
