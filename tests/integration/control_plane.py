"""Control plane without nodes (etcd, API server, controller manager) on loopback ports, with clients.

There are no kubelets, so pods do not run. Tests write the status of pods instead of kubelets.
"""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Mapping
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any, TypeVar

from fractus_cluster.binaries import ensure_binaries
from fractus_cluster.pki import Authority
from fractus_cluster.ports import free_port
from fractus_core.api import KINDS
from fractus_core.api.crd import crd
from fractus_runtime.kubernetes import BlockingClient, KubeError, with_certificate

T = TypeVar("T")
Body = dict[str, Any]

POLL_S = 0.1
"""Pause between two polls. Polls need processor time of the test and of the API server, which the operator waits for."""

PROGRAMS = ("etcd", "kube-apiserver", "kube-controller-manager")
_ENVIRONMENT = {"GOGC": "400", "GOMEMLIMIT": "1GiB"}
"""Settings of Go's garbage collector. With its defaults, the API server spends a fifth of its processor time in it."""

_CONTROLLERS = (
    "garbage-collector-controller",
    "namespace-controller",
    "serviceaccount-controller",
    "root-ca-certificate-publisher-controller",
    "deployment-controller",
    "replicaset-controller",
    "clusterrole-aggregation-controller",
)


def programs() -> dict[str, Path]:
    """Return the programs of a control plane. Build missing programs, as `fractus cluster binaries` does."""
    paths = ensure_binaries(PROGRAMS, report=print)
    return {name: paths[name] for name in PROGRAMS}


def wait_for(poll: Callable[[], T | None], description: str | Callable[[], str], timeout_s: float = 60.0) -> T:
    """Poll a function until it returns a true value, and return this value.

    Raises:
        AssertionError: The timeout has passed. The message contains the description.
    """
    end = time.monotonic() + timeout_s
    while True:
        result = poll()
        if result:
            return result
        if time.monotonic() > end:
            text = description if isinstance(description, str) else description()
            raise AssertionError(f"waited {timeout_s:.0f} s for {text}")
        select_pause(POLL_S)


def select_pause(seconds: float) -> None:
    import select

    select.select([], [], [], seconds)


class ControlPlane:
    """etcd, kube-apiserver and kube-controller-manager of one test session.

    Args:
        programs: Files of the programs.
        directory: Directory of data, keys and logs.
        arguments: Additional arguments by program.
    """

    def __init__(
        self, programs: Mapping[str, Path], directory: Path, arguments: Mapping[str, tuple[str, ...]] | None = None
    ) -> None:
        self._programs = programs
        self._extra_arguments = arguments or {}
        self._directory = directory
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._started: dict[str, tuple[str, ...]] = {}
        self.data = directory / "etcd"
        """Data directory of etcd. Tests may copy or replace this directory while etcd is stopped."""
        (directory / "pki").mkdir(parents=True)
        self.authority = Authority(directory / "pki")
        self.server = f"https://127.0.0.1:{free_port()}"
        self.ca = self.authority.credential.certificate
        self.admin = self._admin()
        self.kubeconfig = self.write_kubeconfig("admin", "admin", ("system:masters",))

    def _admin(self) -> BlockingClient:
        credential = self.authority.issue("admin", common_name="admin", organizations=("system:masters",))
        access = with_certificate(self.server, self.ca, (credential.certificate, credential.key))
        return BlockingClient(access, "kubectl")

    def write_kubeconfig(self, name: str, user: str, groups: tuple[str, ...] = ()) -> Path:
        credential = self.authority.issue(name, common_name=user, organizations=groups)
        path = self._directory / f"{name}.kubeconfig"
        path.write_text(self.authority.kubeconfig(credential, server=self.server, cluster="test"))
        return path

    def as_user(self, name: str, user: str, groups: tuple[str, ...]) -> BlockingClient:
        """Return a client with a certificate of a user and the user's groups."""
        credential = self.authority.issue(name, common_name=user, organizations=groups)
        return BlockingClient(
            with_certificate(self.server, self.ca, (credential.certificate, credential.key)), "kubectl"
        )

    def with_token(self, token: str) -> BlockingClient:
        return BlockingClient(with_certificate(self.server, self.ca, token=token), "kubectl")

    def start(self, kinds: bool = True) -> None:
        """Start the control plane. Install the CRDs if `kinds` is set."""
        client = free_port()
        peer = free_port()
        accounts = self.authority.service_account_key()
        serving = self.authority.issue(
            "server",
            common_name="kube-apiserver",
            alternative_names=("localhost", IPv4Address("127.0.0.1"), "kubernetes.default.svc"),
        )
        etcd = f"http://127.0.0.1:{client}"
        self._run(
            "etcd",
            f"--data-dir={self.data}",
            f"--listen-client-urls={etcd}",
            f"--advertise-client-urls={etcd}",
            f"--listen-peer-urls=http://127.0.0.1:{peer}",
            f"--initial-advertise-peer-urls=http://127.0.0.1:{peer}",
            f"--initial-cluster=default=http://127.0.0.1:{peer}",
            "--unsafe-no-fsync",
            "--log-level=error",
        )
        self._run(
            "kube-apiserver",
            f"--etcd-servers={etcd}",
            "--bind-address=127.0.0.1",
            "--advertise-address=127.0.0.1",
            f"--secure-port={self.server.rsplit(':', 1)[1]}",
            f"--tls-cert-file={serving.certificate}",
            f"--tls-private-key-file={serving.key}",
            f"--client-ca-file={self.ca}",
            "--service-cluster-ip-range=10.97.0.0/16",
            "--authorization-mode=Node,RBAC",
            "--enable-admission-plugins=NodeRestriction,OwnerReferencesPermissionEnforcement",
            "--service-account-issuer=https://kubernetes.default.svc",
            f"--service-account-key-file={accounts.certificate}",
            f"--service-account-signing-key-file={accounts.key}",
            "--allow-privileged=true",
            "--endpoint-reconciler-type=none",
        )
        wait_for(self.admin.ready, "the API server", timeout_s=60)
        if kinds:
            # The garbage collector looks for new kinds only every 30 s, so install the CRDs before it starts.
            self._install_crds()
        self._run(
            "kube-controller-manager",
            f"--kubeconfig={self.kubeconfig}",
            "--bind-address=127.0.0.1",
            "--secure-port=0",
            "--leader-elect=false",
            f"--root-ca-file={self.ca}",
            f"--service-account-private-key-file={accounts.key}",
            f"--controllers={','.join(_CONTROLLERS)}",
        )

    def stop(self) -> None:
        """Kill all processes. An API server with open watches would need ten seconds for a graceful exit."""
        self.admin.close()
        for process in reversed(self._processes.values()):
            process.kill()
            process.wait(10)

    def stop_storage(self) -> Callable[[], None]:
        """Stop etcd and the API server, which caches the data of etcd.

        Returns:
            Function that starts both of them on the current content of `data`.
        """
        stopped = [(program, self._started[program]) for program in ("etcd", "kube-apiserver")]
        for program, _ in reversed(stopped):
            process = self._processes.pop(program)
            process.kill()
            process.wait(10)

        def start() -> None:
            for program, arguments in stopped:
                self._run(program, *arguments)
            wait_for(self.admin.ready, "the API server", timeout_s=60)

        return start

    def _run(self, program: str, *arguments: str) -> None:
        self._started[program] = arguments
        with (self._directory / f"{program}.log").open("ab") as log:
            argv = [str(self._programs[program]), *arguments, *self._extra_arguments.get(program, ())]
            environment = {**os.environ, **_ENVIRONMENT}
            self._processes[program] = subprocess.Popen(
                argv, env=environment, stdout=log, stderr=log, cwd=self._directory
            )

    def _install_crds(self) -> None:
        root = "/apis/apiextensions.k8s.io/v1/customresourcedefinitions"
        names = []
        for kind in KINDS:
            body = crd(kind)
            names.append(body["metadata"]["name"])
            self.admin.apply(f"{root}/{names[-1]}", body)
        for name in names:
            wait_for(lambda name=name: self._established(f"{root}/{name}"), f"CRD {name}")

    def _established(self, path: str) -> bool:
        body = self.admin.get(path) or {}
        conditions = body.get("status", {}).get("conditions", [])
        if not any(c["type"] == "Established" and c["status"] == "True" for c in conditions):
            return False
        try:
            self.admin.list(f"/apis/fractus.dev/v1alpha1/{body['spec']['names']['plural']}")
        except KubeError:
            # the API server answers "storage is (re)initializing"
            return False
        return True
