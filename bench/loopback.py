"""A control plane on loopback with as many simulated nodes (kwok) as wanted: for measuring; pods are bound, nothing runs.

Unlike the embedded cluster (`fractus_cluster`) it needs neither root nor Linux, and no node of it costs more than a few objects.
"""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

import yaml
from fractus_cluster.apiclient import administrating
from fractus_cluster.binaries import Binaries, ensure_binaries
from fractus_cluster.errors import ClusterError
from fractus_cluster.pki import Authority, Credential, write_private
from fractus_cluster.ports import free_port

PROGRAMS = ("etcd", "kube-apiserver", "kube-controller-manager", "kube-scheduler", "kwok")
NODE_LABEL = "type"
NODE_VALUE = "kwok"

_START_TIMEOUT_S = 60.0
_STOP_TIMEOUT_S = 10.0
_LEASE_S = 40_000
"""Renewed after a quarter: the heartbeats of thousands of nodes would take most of the machine that is measured on."""
_GRACE_S = 20_000
_STARTS_MS = 1000
"""From bound to Running, no less than any kubelet takes: Running pods set off writes that it is too early for before."""
_MEMORY = {"GOGC": "400"}
"""Rather memory than time: else a third of the API server's work at 5,000 nodes is to look for what it may forget."""

Report = Callable[[str], None]
Body = dict[str, Any]


class LoopbackCluster:
    """etcd, API server, controller manager, scheduler and kwok as processes of this user."""

    def __init__(self, directory: Path, *, report: Report, audited: str = "") -> None:
        """Make a handle; nothing happens yet.

        Args:
            directory: For keys, data and logs; the caller removes it.
            report: Told about programs that have to be built.
            audited: A user whose requests the API server records in `audit_log`, one JSON object a line.
        """
        self._directory = directory
        self._audited = audited
        self.audit_log = directory / "audit.log"
        self._binaries: Binaries = ensure_binaries(PROGRAMS, report=report)
        self._processes: list[subprocess.Popen[bytes]] = []
        self._authority = Authority(directory / "pki")
        self._port = free_port()
        self.server = f"https://127.0.0.1:{self._port}"
        self.kubeconfig = self.kubeconfig_of("admin")

    @property
    def ca(self) -> Path:
        """The CA certificate of the API server."""
        return self._authority.credential.certificate

    @property
    def credential(self) -> tuple[Path, Path]:
        """Certificate and key of the administrator."""
        issued = self._authority.issue("admin", common_name="admin", organizations=("system:masters",))
        return issued.certificate, issued.key

    def start(self) -> None:
        """Start everything and wait until the API server is ready.

        Raises:
            ClusterError: it was not in time; the logs are in the directory.
        """
        self._run("etcd", *self._etcd())
        self._run("kube-apiserver", *self._api_server())
        with administrating(self.server, self.ca, Credential(*self.credential)) as api:
            api.wait_ready(_START_TIMEOUT_S)
        config = f"--kubeconfig={self.kubeconfig}"
        accounts = self._authority.service_account_key()
        self._run(
            "kube-controller-manager",
            config,
            "--secure-port=0",
            "--leader-elect=false",
            f"--root-ca-file={self.ca}",
            f"--service-account-private-key-file={accounts.key}",
            "--controllers=deployment-controller,replicaset-controller,garbage-collector-controller,"
            "namespace-controller,serviceaccount-controller,root-ca-certificate-publisher-controller,"
            "endpointslice-controller,node-lifecycle-controller",
            f"--node-monitor-grace-period={_GRACE_S}s",
            "--kube-api-qps=200",
            "--kube-api-burst=400",
        )
        self._run("kube-scheduler", config, "--secure-port=0", "--leader-elect=false")
        stages = self._directory / "stages.yaml"
        stages.write_text(yaml.safe_dump_all(STAGES))
        self._run(
            "kwok",
            config,
            f"--config={stages}",
            f"--manage-nodes-with-label-selector={NODE_LABEL}={NODE_VALUE}",
            f"--node-lease-duration-seconds={_LEASE_S}",
            "--node-ip=127.0.0.1",
        )

    def stop(self) -> None:
        """End every process, the last started first."""
        for process in reversed(self._processes):
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(_STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait(_STOP_TIMEOUT_S)
        self._processes.clear()

    def check(self) -> None:
        """Check that every process still runs.

        Raises:
            ClusterError: one has ended.
        """
        for process in self._processes:
            if process.poll() is not None:
                program = Path(str(process.args[0])).name  # type: ignore[index]
                raise ClusterError(f"{program} has ended; see {self._directory / program}.log")

    def kubeconfig_of(self, user: str) -> Path:
        """The kubeconfig of a user who may do everything."""
        credential = self._authority.issue(user, common_name=user, organizations=("system:masters",))
        path = self._directory / f"{user}.kubeconfig"
        write_private(path, self._authority.kubeconfig(credential, server=self.server, cluster="loopback"))
        return path

    def _run(self, program: str, *arguments: str) -> None:
        with (self._directory / f"{program}.log").open("wb") as log:
            argv = [str(self._binaries[program]), *arguments]
            process = subprocess.Popen(argv, stdout=log, stderr=log, cwd=self._directory, env=os.environ | _MEMORY)
            self._processes.append(process)

    def _etcd(self) -> list[str]:
        self._etcd_url = f"http://127.0.0.1:{free_port()}"
        peer = f"http://127.0.0.1:{free_port()}"
        return [
            f"--data-dir={self._directory / 'etcd'}",
            f"--listen-client-urls={self._etcd_url}",
            f"--advertise-client-urls={self._etcd_url}",
            f"--listen-peer-urls={peer}",
            f"--initial-advertise-peer-urls={peer}",
            f"--initial-cluster=default={peer}",
            "--unsafe-no-fsync",
            "--log-level=error",
        ]

    def _api_server(self) -> list[str]:
        accounts = self._authority.service_account_key()
        serving = self._authority.issue(
            "server",
            common_name="kube-apiserver",
            alternative_names=("localhost", IPv4Address("127.0.0.1"), "kubernetes.default.svc"),
        )
        return [
            f"--etcd-servers={self._etcd_url}",
            "--bind-address=127.0.0.1",
            "--advertise-address=127.0.0.1",
            f"--secure-port={self._port}",
            f"--tls-cert-file={serving.certificate}",
            f"--tls-private-key-file={serving.key}",
            f"--client-ca-file={self.ca}",
            "--service-cluster-ip-range=10.97.0.0/16",
            "--authorization-mode=Node,RBAC",
            "--service-account-issuer=https://kubernetes.default.svc",
            f"--service-account-key-file={accounts.certificate}",
            f"--service-account-signing-key-file={accounts.key}",
            "--endpoint-reconciler-type=none",
            *self._audit(),
        ]

    def _audit(self) -> list[str]:
        if not self._audited:
            return []
        policy = self._directory / "audit-policy.yaml"
        rules = [{"level": "Metadata", "users": [self._audited], "omitStages": ["RequestReceived"]}, {"level": "None"}]
        policy.write_text(yaml.safe_dump({"apiVersion": "audit.k8s.io/v1", "kind": "Policy", "rules": rules}))
        # In one file: what is rotated away would not be counted.
        return [
            f"--audit-policy-file={policy}",
            f"--audit-log-path={self.audit_log}",
            "--audit-log-maxsize=10000",
        ]


def simulated_node(name: str, node_class: str, allocatable: Body) -> Body:
    """A Node that kwok keeps Ready."""
    labels = {NODE_LABEL: NODE_VALUE, "fractus.dev/class": node_class, "kubernetes.io/hostname": name}
    return {
        "apiVersion": "v1",
        "kind": "Node",
        "metadata": {"name": name, "labels": labels, "annotations": {"kwok.x-k8s.io/node": "fake"}},
        "status": {"allocatable": allocatable, "capacity": allocatable},
    }


def wait_until(question: Callable[[], bool], what: str, *, timeout_s: float, pause_s: float = 0.05) -> None:
    """Ask until the answer is yes.

    Raises:
        ClusterError: it was not in time.
    """
    deadline = time.monotonic() + timeout_s
    while not question():
        if time.monotonic() > deadline:
            raise ClusterError(f"waited {timeout_s:.0f} s without success for {what}")
        time.sleep(pause_s)


def _stage(name: str, kind: str, selector: list[Body], status: str = "", **more: Any) -> Body:
    return {
        "apiVersion": "kwok.x-k8s.io/v1alpha1",
        "kind": "Stage",
        "metadata": {"name": name},
        "spec": {
            "resourceRef": {"apiGroup": "v1", "kind": kind},
            "selector": {"matchExpressions": selector},
            "next": {"statusTemplate": status} if status else {"delete": True},
            **more,
        },
    }


_READY = '.status.conditions.[] | select( .type == "Ready" ) | .status'
_NODE_STATUS = """
{{ $now := Now }}
conditions:
{{ range NodeConditions }}
- {lastHeartbeatTime: {{ $now | Quote }}, lastTransitionTime: {{ $now | Quote }}, message: {{ .message | Quote }}, reason: {{ .reason | Quote }}, status: {{ .status | Quote }}, type: {{ .type | Quote }}}
{{ end }}
phase: Running
"""
_POD_STATUS = """
{{ $now := Now }}
conditions:
- {lastTransitionTime: {{ $now | Quote }}, status: "True", type: Initialized}
- {lastTransitionTime: {{ $now | Quote }}, status: "True", type: Ready}
- {lastTransitionTime: {{ $now | Quote }}, status: "True", type: ContainersReady}
containerStatuses:
{{ range .spec.containers }}
- {image: {{ .image | Quote }}, name: {{ .name | Quote }}, ready: true, restartCount: 0, state: {running: {startedAt: {{ $now | Quote }}}}}
{{ end }}
{{ with PodIPsWith .spec.nodeName false ( or .metadata.uid "" ) ( or .metadata.name "" ) ( or .metadata.namespace "" ) }}
podIP: {{ index . 0 | Quote }}
podIPs: [{ip: {{ index . 0 | Quote }}}]
{{ end }}
phase: Running
startTime: {{ $now | Quote }}
"""

STAGES = (
    _stage("node-ready", "Node", [{"key": _READY, "operator": "NotIn", "values": ["True"]}], _NODE_STATUS),
    _stage(
        "pod-ready",
        "Pod",
        [
            {"key": ".metadata.deletionTimestamp", "operator": "DoesNotExist"},
            {"key": ".status.phase", "operator": "In", "values": ["Pending"]},
            {"key": _READY, "operator": "NotIn", "values": ["True"]},
        ],
        _POD_STATUS,
        delay={"durationMilliseconds": _STARTS_MS},
    ),
    _stage("pod-delete", "Pod", [{"key": ".metadata.deletionTimestamp", "operator": "Exists"}]),
)
"""What kwok does: it says of new nodes and bound pods that they are Ready, and lets deleted pods go."""
