"""Prerequisites of a cluster on this machine: root, programs and kernel features, with remedies."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from fractus_cluster.cgroups import find_hierarchies
from fractus_cluster.commands import run
from fractus_cluster.errors import ClusterError, PrerequisiteError
from fractus_cluster.nodeconfig import Machine

_PACKAGES = {
    "containerd": "containerd",
    "ctr": "containerd",
    "runc": "runc",
    "nft": "nftables",
    "iptables": "iptables",
    "ip": "iproute2",
    "nsenter": "util-linux",
    "unshare": "util-linux",
    "mount": "mount",
}
_PLUGIN_DIRECTORIES = ("/usr/lib/cni", "/opt/cni/bin", "/usr/libexec/cni")
_PLUGINS = ("ptp", "portmap", "host-local", "loopback")
_NAMESPACES = ("net", "mnt", "pid", "uts", "ipc")

# Firewall rules of the kinds that kube-proxy and the redirector need, created in a temporary network namespace.
_FIREWALL_TRIAL = """
table ip fractus_trial {
  map targets { type ipv4_addr . inet_proto . inet_service : verdict; }
  chain two { ip protocol tcp dnat to 10.0.0.1:80; }
  chain one { numgen random mod 2 vmap { 0 : goto two, 1 : goto two }; }
  chain pre { type nat hook prerouting priority dstnat; fib daddr type local ip daddr . meta l4proto . th dport vmap @targets; }
  chain post { type nat hook postrouting priority srcnat; meta mark and 0x1 != 0 masquerade; }
}
"""


def check_root() -> None:
    """Check that this process may create namespaces and mounts.

    Raises:
        PrerequisiteError: The process is not root, or the system is not Linux.
    """
    if sys.platform != "linux":
        raise PrerequisiteError("the embedded cluster needs Linux; elsewhere use kind or k3s through KUBECONFIG")
    if os.geteuid() != 0:
        raise PrerequisiteError(
            "the embedded cluster needs root, because it creates network namespaces, mounts and control groups; "
            "run the command with sudo, or use another cluster through KUBECONFIG"
        )


def check_prerequisites() -> None:
    """Check all requirements on the machine except the Kubernetes programs.

    Raises:
        PrerequisiteError: A requirement is not met. The message says what to do.
    """
    check_root()
    packages = missing_packages()
    if packages:
        raise PrerequisiteError(f"missing packages; install them: apt-get install {' '.join(packages)}")
    find_hierarchies()
    for name in _NAMESPACES:
        if not Path(f"/proc/self/ns/{name}").exists():
            raise PrerequisiteError(f"the kernel has no {name} namespaces (CONFIG_NAMESPACES)")
    _check_file_system("overlay", "CONFIG_OVERLAY_FS")
    _check_network()


def missing_packages() -> list[str]:
    """Return the Debian packages of missing programs."""
    path = os.environ.get("PATH", "") + ":/usr/sbin:/sbin"
    packages = {package for program, package in _PACKAGES.items() if shutil.which(program, path=path) is None}
    if plugin_directory() is None:
        packages.add("containernetworking-plugins")
    return sorted(packages)


def plugin_directory() -> str | None:
    """Return the directory of the CNI plugins, or None."""
    for directory in _PLUGIN_DIRECTORIES:
        if all(os.access(f"{directory}/{plugin}", os.X_OK) for plugin in _PLUGINS):
            return directory
    return None


def machine() -> Machine:
    """Return the resources of the machine."""
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemTotal:"):
            return Machine(os.cpu_count() or 1, int(line.split()[1]) * 1024)
    raise ClusterError("/proc/meminfo contains no MemTotal")


def _check_file_system(name: str, option: str) -> None:
    def known() -> bool:
        return any(line.split()[-1] == name for line in Path("/proc/filesystems").read_text().splitlines())

    if not known() and shutil.which("modprobe"):
        subprocess.run(["modprobe", name], check=False, capture_output=True, timeout=30)
    if not known():
        raise PrerequisiteError(f"the kernel has no {name} file system ({option})")


def _check_network() -> None:
    """Create the links and firewall rules of a cluster in a temporary network namespace."""
    trials = {
        "ip link add name a type veth peer name b": "veth links (CONFIG_VETH)",
        "ip link add name c type bridge": "bridges (CONFIG_BRIDGE)",
        "nft -f -": "nftables with NAT, fib and numgen (CONFIG_NF_TABLES, CONFIG_NFT_NAT, CONFIG_NFT_FIB_INET, "
        "CONFIG_NFT_NUMGEN, CONFIG_NFT_MASQ)",
    }
    script = "\n".join(f"{command} || exit {code}" for code, command in enumerate(trials, start=11))
    done = run(["unshare", "--net", "sh", "-c", script], input_text=_FIREWALL_TRIAL, timeout_s=60, check=False)
    if done.returncode != 0:
        features = dict(enumerate(trials.values(), start=11))
        feature = features.get(done.returncode, "network namespaces (CONFIG_NET_NS)")
        raise PrerequisiteError(f"the kernel lacks {feature}: {done.stderr.strip()[:300]}")
