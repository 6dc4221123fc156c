"""Configuration files of a node's daemons. All functions are pure."""

from __future__ import annotations

import json
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

import yaml

from fractus_cluster.addressing import DNS_SERVICE, Addressing
from fractus_cluster.node_init import RUN
from fractus_cluster.spec import NodeSpec, parse_quantity
from fractus_cluster.supervisor import ENVIRONMENT

SANDBOX_IMAGE = "localhost/fractus/pause:1"
CONTAINERD_SOCKET = "/run/containerd/containerd.sock"
CONFIG = RUN / "config"

SHOWN_SYSCTLS = {
    # kubelet sets these kernel settings unless they have the values that it requires. It must not change the machine.
    "vm.overcommit_memory": "1",
    "vm.panic_on_oom": "0",
    "kernel.panic": "10",
    "kernel.panic_on_oops": "1",
    "kernel.keys.root_maxkeys": "1000000",
    "kernel.keys.root_maxbytes": "25000000",
}


@dataclass(frozen=True, slots=True)
class Machine:
    """Resources of the machine.

    Attributes:
        cpus: Number of CPUs.
        memory_bytes: Memory.
    """

    cpus: int
    memory_bytes: int


def shortfalls(node: NodeSpec, machine: Machine) -> list[str]:
    """Return a sentence for each resource that the specification of the node sets above the amount of the machine."""
    sentences = []
    cpu = node.resources.get("cpu")
    memory = node.resources.get("memory")
    if cpu and parse_quantity(cpu) > machine.cpus:
        sentences.append(
            f"node {node.name} offers {machine.cpus} CPUs instead of {cpu}, because the machine has no more"
        )
    if memory and parse_quantity(memory) > machine.memory_bytes:
        mebibytes = machine.memory_bytes >> 20
        sentences.append(
            f"node {node.name} offers {mebibytes}Mi of memory instead of {memory}, because the machine has no more"
        )
    return sentences


def _reserved(node: NodeSpec, machine: Machine) -> dict[str, str]:
    """Return the resources that kubelet must reserve, so that the remainder equals the node's resources."""
    reserved: dict[str, str] = {}
    cpu = node.resources.get("cpu")
    memory = node.resources.get("memory")
    if cpu and (kept := machine.cpus - parse_quantity(cpu)) > 0:
        reserved["cpu"] = f"{int(kept * 1000)}m"
    if memory and (left := Decimal(machine.memory_bytes) - parse_quantity(memory)) > 0:
        reserved["memory"] = str(int(left))
    return reserved


def kubelet_config(node: NodeSpec, *, cgroup_root: str, cgroup_version: int, machine: Machine) -> str:
    """Return kubelet's configuration file."""
    content: dict[str, Any] = {
        "apiVersion": "kubelet.config.k8s.io/v1beta1",
        "kind": "KubeletConfiguration",
        "authentication": {
            "anonymous": {"enabled": False},
            "webhook": {"enabled": True},
            "x509": {"clientCAFile": f"{CONFIG}/ca.crt"},
        },
        "authorization": {"mode": "Webhook"},
        "tlsCertFile": f"{CONFIG}/kubelet.crt",
        "tlsPrivateKeyFile": f"{CONFIG}/kubelet.key",
        "containerRuntimeEndpoint": f"unix://{CONTAINERD_SOCKET}",
        "cgroupDriver": "cgroupfs",
        "cgroupRoot": f"/{cgroup_root}",
        "clusterDNS": [str(DNS_SERVICE)],
        "clusterDomain": "cluster.local",
        "resolvConf": "/etc/resolv.conf",
        "volumePluginDir": "/var/lib/kubelet/volume-plugins",
        "failSwapOn": False,
        "readOnlyPort": 0,
        "maxPods": int(parse_quantity(node.resources.get("pods", "110"))),
        "systemReserved": _reserved(node, machine),
        "registryPullQPS": 0,
        "serializeImagePulls": False,
        # Evictions and image garbage collection are disabled, because all nodes share the disk of the machine.
        "evictionHard": dict.fromkeys(
            ("memory.available", "nodefs.available", "nodefs.inodesFree", "imagefs.available"), "0%"
        ),
        "imageGCHighThresholdPercent": 100,
        "imageGCLowThresholdPercent": 99,
        # With these values, a lost node is detected within seconds. Shorter intervals would load an idle machine.
        "nodeLeaseDurationSeconds": 8,
        "nodeStatusUpdateFrequency": "10s",
        "nodeStatusReportFrequency": "5m",
        "volumeStatsAggPeriod": "-1s",
        "shutdownGracePeriod": "0s",
    }
    if cgroup_version == 1:
        content["failCgroupV1"] = False
    return yaml.safe_dump(content, sort_keys=False)


def kube_proxy_config(node: NodeSpec, addressing: Addressing) -> str:
    """Return kube-proxy's configuration file."""
    content: dict[str, Any] = {
        "apiVersion": "kubeproxy.config.k8s.io/v1alpha1",
        "kind": "KubeProxyConfiguration",
        "mode": "nftables",
        "clientConnection": {"kubeconfig": f"{CONFIG}/kube-proxy.kubeconfig"},
        "clusterCIDR": str(addressing.pod_network),
        "hostnameOverride": node.name,
        "healthzBindAddress": "127.0.0.1:10256",
        "metricsBindAddress": "127.0.0.1:10249",
        "conntrack": {"maxPerCore": 0, "min": 0},
        "configSyncPeriod": "15m",
        "nftables": {"syncPeriod": "5m", "minSyncPeriod": "50ms"},
    }
    return yaml.safe_dump(content, sort_keys=False)


def containerd_config(*, plugin_directory: str) -> str:
    """Return containerd's configuration file.

    Args:
        plugin_directory: Directory of the machine's CNI plugins.
    """
    return f"""\
version = 2
root = "/var/lib/containerd"
state = "/run/containerd"
disabled_plugins = [
  "io.containerd.internal.v1.opt",
  "io.containerd.internal.v1.tracing",
  "io.containerd.tracing.processor.v1.otlp",
  "io.containerd.snapshotter.v1.aufs",
  "io.containerd.snapshotter.v1.btrfs",
  "io.containerd.snapshotter.v1.devmapper",
  "io.containerd.snapshotter.v1.zfs",
]

[grpc]
  address = "{CONTAINERD_SOCKET}"

[plugins."io.containerd.grpc.v1.cri"]
  sandbox_image = "{SANDBOX_IMAGE}"
  restrict_oom_score_adj = true
  disable_hugetlb_controller = true
  disable_apparmor = true
  stats_collect_period = 60

  [plugins."io.containerd.grpc.v1.cri".containerd]
    snapshotter = "overlayfs"
    default_runtime_name = "runc"

    [plugins."io.containerd.grpc.v1.cri".containerd.runtimes.runc]
      runtime_type = "io.containerd.runc.v2"

      [plugins."io.containerd.grpc.v1.cri".containerd.runtimes.runc.options]
        SystemdCgroup = false

  [plugins."io.containerd.grpc.v1.cri".cni]
    bin_dir = "{plugin_directory}"
    conf_dir = "{CONFIG}/cni"

  [plugins."io.containerd.grpc.v1.cri".registry]
    config_path = "/etc/containerd/certs.d"
"""


def cni_config(index: int, addressing: Addressing) -> str:
    """Return the CNI configuration: a point-to-point link between pod and node, and host ports."""
    content = {
        "cniVersion": "1.0.0",
        "name": "fractus-sim",
        "plugins": [
            {
                "type": "ptp",
                "ipMasq": False,
                "ipam": {
                    "type": "host-local",
                    "ranges": [[{"subnet": str(addressing.pods(index))}]],
                    "routes": [{"dst": "0.0.0.0/0"}],
                    "dataDir": "/run/cni-addresses",
                },
            },
            {"type": "portmap", "capabilities": {"portMappings": True}},
        ],
    }
    return json.dumps(content, indent=1)


def hosts_file(name: str) -> str:
    """Return a node's /etc/hosts."""
    return f"127.0.0.1 localhost\n::1 localhost ip6-localhost\n127.0.1.1 {name}\n"


def resolver_file(addressing: Addressing) -> str:
    """Return a node's /etc/resolv.conf."""
    return f"nameserver {addressing.control_plane}\noptions ndots:1\n"


def node_units(node: NodeSpec, *, address: str) -> list[dict[str, Any]]:
    """Return the units that the node's first program supervises."""
    logs = RUN / "logs"
    # kubelet exits if the socket of the container runtime does not exist yet.
    wait = f'i=0; while [ ! -S {CONTAINERD_SOCKET} ] && [ $i -lt 400 ]; do sleep 0.05; i=$((i+1)); done; exec "$@"'
    kubelet = [
        f"{RUN}/bin/kubelet",
        f"--config={CONFIG}/kubelet.yaml",
        f"--kubeconfig={CONFIG}/kubelet.kubeconfig",
        f"--hostname-override={node.name}",
        f"--node-ip={address}",
        "--v=1",
    ]
    argvs = {
        "containerd": ["containerd", "--config", f"{CONFIG}/containerd.toml", "--log-level", "warn"],
        "kubelet": ["/bin/sh", "-c", wait, "sh", *kubelet],
        "kube-proxy": [f"{RUN}/bin/kube-proxy", f"--config={CONFIG}/kube-proxy.yaml", "--v=1"],
    }
    return [
        {"name": name, "argv": argv, "log": f"{logs}/{name}.log", "env": ENVIRONMENT} for name, argv in argvs.items()
    ]
