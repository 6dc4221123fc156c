"""Supervisor units of the control plane. All functions are pure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fractus_cluster.addressing import API_SERVICE, SERVICE_NETWORK, Addressing
from fractus_cluster.binaries import Binaries
from fractus_cluster.manifests import DNS_USER
from fractus_cluster.pki import Authority, Credential, write_private
from fractus_cluster.supervisor import ENVIRONMENT

API_PORT = 6443
DNS_READY_PORT = 8181
CONTROL_PLANE_PROGRAMS = ("etcd", "kube-apiserver", "kube-controller-manager", "kube-scheduler", "coredns")
_ETCD_URL = "http://127.0.0.1:2379"
_CLUSTER_DOMAIN = "cluster.local"


@dataclass(frozen=True, slots=True)
class ControlPlaneFiles:
    """Directories of the control plane.

    Attributes:
        directory: Data of etcd and configuration.
        logs: Logs of its programs.
    """

    directory: Path
    logs: Path

    @property
    def corefile(self) -> Path:
        """The DNS server's configuration."""
        return self.directory / "Corefile"

    def kubeconfig(self, user: str) -> Path:
        """Return a program's kubeconfig."""
        return self.directory / f"{user}.kubeconfig"


def server_url(addressing: Addressing) -> str:
    """Return the URL of the API server."""
    return f"https://{addressing.control_plane}:{API_PORT}"


def server_credential(authority: Authority, addressing: Addressing) -> Credential:
    """Return the certificate that the API server serves with."""
    return authority.issue(
        "kube-apiserver",
        common_name="kube-apiserver",
        alternative_names=(
            "localhost",
            "kubernetes",
            "kubernetes.default",
            "kubernetes.default.svc",
            f"kubernetes.default.svc.{_CLUSTER_DOMAIN}",
            addressing.control_plane,
            API_SERVICE,
        ),
    )


def administrator(authority: Authority) -> Credential:
    """Return the credential of the cluster's administrator."""
    return authority.issue("admin", common_name="fractus-sim:admin", organizations=("system:masters",))


def write_control_plane(
    authority: Authority, addressing: Addressing, files: ControlPlaneFiles, *, cluster: str
) -> None:
    """Write the kubeconfigs of the control plane. The DNS server does not start until `let_dns_start` is called."""
    files.corefile.unlink(missing_ok=True)
    users = {
        "kube-controller-manager": "system:kube-controller-manager",
        "kube-scheduler": "system:kube-scheduler",
        "coredns": DNS_USER,
    }
    for program, user in users.items():
        credential = authority.issue(program, common_name=user)
        text = authority.kubeconfig(credential, server=server_url(addressing), cluster=cluster)
        write_private(files.kubeconfig(program), text)
    files.logs.mkdir(parents=True, exist_ok=True)


def let_dns_start(addressing: Addressing, files: ControlPlaneFiles) -> None:
    """Write the DNS server's configuration, for which its supervisor waits.

    Call this after the permission of the server to read Services has been created. If the permission is missing at its
    start, the server retries only after 30 s.
    """
    if not files.corefile.exists():
        new = files.corefile.with_suffix(".new")
        new.write_text(corefile(addressing, files.kubeconfig("coredns")))
        new.replace(files.corefile)


def corefile(addressing: Addressing, kubeconfig: Path) -> str:
    """Return the DNS server's configuration. The server resolves names of the cluster, and refuses all other names."""
    return f"""\
{_CLUSTER_DOMAIN}:53 in-addr.arpa:53 {{
    bind {addressing.control_plane}
    errors
    ready {addressing.control_plane}:{DNS_READY_PORT}
    kubernetes {_CLUSTER_DOMAIN} in-addr.arpa {{
        kubeconfig {kubeconfig}
        pods insecure
        ttl 5
    }}
    cache 5
    loadbalance
}}
"""


def control_plane_units(
    binaries: Binaries, authority: Authority, addressing: Addressing, files: ControlPlaneFiles
) -> list[dict[str, Any]]:
    """Return the units of the control plane, in the order in which they start."""
    argvs = {
        "etcd": _etcd(files),
        "kube-apiserver": _api_server(authority, addressing),
        "kube-controller-manager": _controller_manager(authority, files),
        "kube-scheduler": [
            f"--kubeconfig={files.kubeconfig('kube-scheduler')}",
            "--bind-address=127.0.0.1",
            "--leader-elect=false",
        ],
        "coredns": ["-conf", str(files.corefile), "-dns.port=53"],
    }
    needs = {"coredns": str(files.corefile)}
    return [
        {
            "name": name,
            "argv": [str(binaries[name]), *argv],
            "log": str(files.logs / f"{name}.log"),
            "env": ENVIRONMENT,
            "needs": needs.get(name, ""),
        }
        for name, argv in argvs.items()
    ]


def _etcd(files: ControlPlaneFiles) -> list[str]:
    peer = "http://127.0.0.1:2380"
    return [
        "--name=control-plane",
        f"--data-dir={files.directory / 'etcd'}",
        f"--listen-client-urls={_ETCD_URL}",
        f"--advertise-client-urls={_ETCD_URL}",
        f"--listen-peer-urls={peer}",
        f"--initial-advertise-peer-urls={peer}",
        f"--initial-cluster=control-plane={peer}",
        "--unsafe-no-fsync",
        "--heartbeat-interval=500",
        "--election-timeout=2500",
        "--auto-compaction-mode=periodic",
        "--auto-compaction-retention=30m",
        "--log-level=warn",
    ]


def _api_server(authority: Authority, addressing: Addressing) -> list[str]:
    server = server_credential(authority, addressing)
    accounts = authority.service_account_key()
    kubelet_client = authority.issue(
        "kube-apiserver-kubelet-client", common_name="kube-apiserver-kubelet-client", organizations=("system:masters",)
    )
    ca = authority.credential.certificate
    return [
        f"--etcd-servers={_ETCD_URL}",
        "--bind-address=0.0.0.0",
        f"--secure-port={API_PORT}",
        f"--advertise-address={addressing.control_plane}",
        f"--service-cluster-ip-range={SERVICE_NETWORK}",
        f"--tls-cert-file={server.certificate}",
        f"--tls-private-key-file={server.key}",
        f"--client-ca-file={ca}",
        f"--kubelet-certificate-authority={ca}",
        f"--kubelet-client-certificate={kubelet_client.certificate}",
        f"--kubelet-client-key={kubelet_client.key}",
        "--kubelet-preferred-address-types=InternalIP",
        "--authorization-mode=Node,RBAC",
        "--enable-admission-plugins=NodeRestriction",
        "--enable-aggregator-routing=true",
        "--allow-privileged=true",
        "--anonymous-auth=false",
        f"--service-account-issuer=https://kubernetes.default.svc.{_CLUSTER_DOMAIN}",
        f"--service-account-key-file={accounts.certificate}",
        f"--service-account-signing-key-file={accounts.key}",
        "--profiling=false",
        "--v=1",
    ]


def _controller_manager(authority: Authority, files: ControlPlaneFiles) -> list[str]:
    return [
        f"--kubeconfig={files.kubeconfig('kube-controller-manager')}",
        "--bind-address=127.0.0.1",
        "--leader-elect=false",
        "--use-service-account-credentials=true",
        f"--root-ca-file={authority.credential.certificate}",
        f"--service-account-private-key-file={authority.service_account_key().key}",
        f"--cluster-signing-cert-file={authority.credential.certificate}",
        f"--cluster-signing-key-file={authority.credential.key}",
        "--node-monitor-period=2s",
        "--node-monitor-grace-period=9s",
        "--profiling=false",
        "--v=1",
    ]
