"""A bare API server for the agent's tests: etcd and kube-apiserver as processes, the CRDs, the agent's rights."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import shutil
import socket
import ssl
import subprocess
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import yaml
from agent_pki import TestAuthority
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import rsa

T = TypeVar("T")
ROOT = Path(__file__).parents[2]
CRDS = ROOT / "crds"
FRACTUS = "/apis/fractus.dev/v1alpha1"
REQUESTS = "/apis/certificates.k8s.io/v1/certificatesigningrequests"
RULES: list[dict[str, list[str]]] = [
    {"apiGroups": ["fractus.dev"], "resources": ["drones", "edgenodes"], "verbs": ["get", "create", "update"]},
    {"apiGroups": ["fractus.dev"], "resources": ["grants"], "verbs": ["get", "list", "watch"]},
    {
        "apiGroups": ["fractus.dev"],
        "resources": ["drones/status", "edgenodes/status", "grants/status"],
        "verbs": ["patch"],
    },
    {"apiGroups": [""], "resources": ["nodes"], "verbs": ["get", "patch"]},
    {
        "apiGroups": ["certificates.k8s.io"],
        "resources": ["certificatesigningrequests"],
        "verbs": ["create", "get", "list", "delete"],
    },
    {"apiGroups": [""], "resources": ["configmaps"], "resourceNames": ["fractus-ca"], "verbs": ["get"]},
]
"""What charts/ gives the agent; tests run with no more."""


def find_binary(name: str) -> Path | None:
    """A control-plane binary from KUBEBUILDER_ASSETS, PATH or the embedded cluster's cache."""
    places = [Path(p) / name for p in filter(None, [os.environ.get("KUBEBUILDER_ASSETS")])]
    if found := shutil.which(name):
        places.append(Path(found))
    places += sorted(Path.home().glob(f".cache/fractus/*/bin/{name}"), reverse=True)
    return next((p for p in places if p.exists()), None)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_for(read: Callable[[], T], timeout_s: float = 30.0, what: str = "condition") -> T:
    """The first true value of read within the timeout."""
    until_s = time.monotonic() + timeout_s
    pause = threading.Event()
    while time.monotonic() < until_s:
        if value := read():
            return value
        pause.wait(0.05)
    raise AssertionError(f"no {what} within {timeout_s} s")


class ApiServer:
    """etcd and kube-apiserver on loopback; can be stopped and started again with its data."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.port, self._etcd_port, self._peer_port = free_port(), free_port(), free_port()
        self._processes: list[subprocess.Popen[bytes]] = []
        key = rsa.generate_private_key(public_exponent=65537, key_size=2048)
        (directory / "sa.key").write_bytes(
            key.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
            )
        )
        (directory / "tokens.csv").write_text(
            'admin-token,admin,admin,"system:masters"\nagent-token,agent,agent,"agents"\n'
        )

    def start(self) -> None:
        self.start_etcd()
        self.start_apiserver()

    def start_etcd(self) -> None:
        urls = f"http://127.0.0.1:{self._etcd_port}"
        peer = f"http://127.0.0.1:{self._peer_port}"
        self._run(
            "etcd", "--data-dir", str(self.directory / "etcd"), "--listen-client-urls", urls,
            "--advertise-client-urls", urls, "--listen-peer-urls", peer, "--initial-advertise-peer-urls", peer,
            "--initial-cluster", f"default={peer}", "--unsafe-no-fsync", "--log-level", "error",
        )  # fmt: skip

    def start_apiserver(self) -> None:
        self._run(
            "kube-apiserver", "--etcd-servers", f"http://127.0.0.1:{self._etcd_port}",
            "--secure-port", str(self.port), "--bind-address", "127.0.0.1", "--advertise-address", "127.0.0.1",
            "--cert-dir", str(self.directory / "certs"), "--service-cluster-ip-range", "10.96.0.0/16",
            "--service-account-issuer", "https://kubernetes.default.svc",
            "--service-account-key-file", str(self.directory / "sa.key"),
            "--service-account-signing-key-file", str(self.directory / "sa.key"),
            "--token-auth-file", str(self.directory / "tokens.csv"), "--authorization-mode", "RBAC",
            "--disable-admission-plugins", "ServiceAccount", "--event-ttl", "5m",
        )  # fmt: skip
        wait_for(self._healthy, 60.0, "healthy API server")

    def stop_apiserver(self, kill: bool = False) -> None:
        self._stop(self._processes.pop(), kill)

    def stop(self) -> None:
        while self._processes:
            self._stop(self._processes.pop(), kill=True)

    def compact(self) -> None:
        """Make etcd forget every version before now, so that watches from before are answered with 410."""
        base = f"http://127.0.0.1:{self._etcd_port}/v3/kv"
        range_ = json.dumps({"key": base64.b64encode(b"/").decode()}).encode()
        with urllib.request.urlopen(f"{base}/range", range_, timeout=5) as answer:
            revision = json.load(answer)["header"]["revision"]
        with urllib.request.urlopen(f"{base}/compaction", json.dumps({"revision": revision}).encode(), timeout=5):
            pass

    def kubeconfig(self, user: str) -> Path:
        path = self.directory / f"{user}.kubeconfig"
        cluster = {
            "server": f"https://127.0.0.1:{self.port}",
            "certificate-authority": str(self.directory / "certs" / "apiserver.crt"),
        }
        body = {
            "apiVersion": "v1",
            "kind": "Config",
            "clusters": [{"name": "c", "cluster": cluster}],
            "users": [{"name": user, "user": {"token": f"{user}-token"}}],
            "contexts": [{"name": "c", "context": {"cluster": "c", "user": user}}],
            "current-context": "c",
        }
        path.write_text(yaml.safe_dump(body))
        return path

    def call(self, method: str, path: str, body: Any = None, content: str = "application/json") -> dict[str, Any]:
        """One request as cluster admin.

        Raises:
            urllib.error.HTTPError: the server says no.
        """
        request = urllib.request.Request(
            f"https://127.0.0.1:{self.port}{path}",
            method=method,
            data=None if body is None else json.dumps(body).encode(),
            headers={"Authorization": "Bearer admin-token", "Content-Type": content},
        )
        context = ssl.create_default_context(cafile=str(self.directory / "certs" / "apiserver.crt"))
        with urllib.request.urlopen(request, timeout=10, context=context) as answer:
            return dict(json.load(answer))

    def get(self, path: str) -> dict[str, Any] | None:
        """An object or list; None when it is absent, or its kind not served yet."""
        try:
            return self.call("GET", path)
        except urllib.error.HTTPError as error:
            if error.code in (404, 429):
                return None
            raise

    def post(self, path: str, body: Any) -> dict[str, Any]:
        return self.call("POST", path, body)

    def merge(self, path: str, body: Any) -> dict[str, Any]:
        return self.call("PATCH", path, body, "application/merge-patch+json")

    def delete(self, path: str) -> None:
        with contextlib.suppress(urllib.error.HTTPError):
            self.call("DELETE", path)

    def furnish(self, ca_pem: bytes) -> None:
        """CRDs, the system's namespace with the authority, and the agent's rights."""
        for file in sorted(CRDS.glob("*.yaml")):
            for body in yaml.safe_load_all(file.read_text()):
                self.post("/apis/apiextensions.k8s.io/v1/customresourcedefinitions", body)
        self.post("/api/v1/namespaces", {"metadata": {"name": "fractus-system"}})
        data = {"metadata": {"name": "fractus-ca"}, "data": {"ca.crt": ca_pem.decode()}}
        self.post("/api/v1/namespaces/fractus-system/configmaps", data)
        rbac = "/apis/rbac.authorization.k8s.io/v1"
        self.post(f"{rbac}/clusterroles", {"metadata": {"name": "agent"}, "rules": RULES})
        binding = {
            "metadata": {"name": "agent"},
            "roleRef": {"apiGroup": "rbac.authorization.k8s.io", "kind": "ClusterRole", "name": "agent"},
            "subjects": [{"kind": "User", "name": "agent", "apiGroup": "rbac.authorization.k8s.io"}],
        }
        self.post(f"{rbac}/clusterrolebindings", binding)
        wait_for(lambda: self.get(f"{FRACTUS}/grants?fieldSelector=spec.node%3Dx"), 30.0, "grants API")
        wait_for(lambda: self.get(f"{FRACTUS}/drones"), 30.0, "drones API")

    def sign_requests(self, authority: TestAuthority) -> int:
        """Approve and sign what waits, as the operator does; how many."""
        signed = 0
        for body in self.call("GET", REQUESTS)["items"]:
            status = body.get("status") or {}
            if status.get("certificate") or status.get("conditions"):
                continue
            path = f"{REQUESTS}/{body['metadata']['name']}"
            body["status"] = {"conditions": [{"type": "Approved", "status": "True", "reason": "Test", "message": "x"}]}
            approved = self.call("PUT", f"{path}/approval", body)
            pem = authority.sign(base64.b64decode(approved["spec"]["request"]))
            approved["status"]["certificate"] = base64.b64encode(pem).decode()
            self.call("PUT", f"{path}/status", approved)
            signed += 1
        return signed

    def _healthy(self) -> bool:
        try:
            return self.call("GET", "/apis") is not None and self._ready()
        except (OSError, ssl.SSLError, ValueError):
            return False

    def _ready(self) -> bool:
        context = ssl.create_default_context(cafile=str(self.directory / "certs" / "apiserver.crt"))
        request = urllib.request.Request(
            f"https://127.0.0.1:{self.port}/readyz", headers={"Authorization": "Bearer admin-token"}
        )
        with urllib.request.urlopen(request, timeout=5, context=context) as answer:
            return bool(answer.status == 200)

    def _run(self, name: str, *arguments: str) -> None:
        binary = find_binary(name)
        assert binary is not None
        log = (self.directory / f"{name}.log").open("ab")
        self._processes.append(subprocess.Popen([str(binary), *arguments], stdout=log, stderr=log))

    def _stop(self, process: subprocess.Popen[bytes], kill: bool) -> None:
        process.kill() if kill else process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait(10)


@contextlib.contextmanager
def running(directory: Path) -> Iterator[ApiServer]:
    """An API server for the length of a block."""
    server = ApiServer(directory)
    try:
        server.start()
        yield server
    finally:
        server.stop()
