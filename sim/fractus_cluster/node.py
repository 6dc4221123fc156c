"""A node of an embedded cluster: files, power, uplink and commands."""

from __future__ import annotations

import hashlib
import json
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from ipaddress import IPv4Address
from pathlib import Path

import yaml

from fractus_cluster import network, nodeconfig
from fractus_cluster.binaries import Binaries
from fractus_cluster.cgroups import Branch
from fractus_cluster.commands import run
from fractus_cluster.controlplane import server_url
from fractus_cluster.disk import mount_disk, unmount_below
from fractus_cluster.errors import ClusterError
from fractus_cluster.hardware import hardware_commands, hardware_environment
from fractus_cluster.manifests import VOLUMES
from fractus_cluster.pki import Authority, write_private
from fractus_cluster.prerequisites import machine, plugin_directory
from fractus_cluster.processes import command_line, kill_recorded, running, spawn, write_record
from fractus_cluster.spec import NodeSpec, Place
from fractus_cluster.state import StateDirectory
from fractus_cluster.supervisor import ENVIRONMENT

_PROGRAMS = ("kubelet", "kube-proxy")
_HARDWARE = ("vehicle", "camera")
_FOLDERS = ("etc", "etc-work", "var-lib", "var-log", "config")


def init_command(config: Path, namespace: Path) -> list[str]:
    """Return the command that runs the first program of a node or control plane in new namespaces.

    When the process of this command is killed, all processes in the namespaces end.
    """
    return [
        "nsenter",
        f"--net={namespace}",
        "unshare",
        *("--mount", "--uts", "--ipc", "--pid", "--fork", "--kill-child", "--mount-proc"),
        *(sys.executable, "-E", "-s", "-m", "fractus_cluster.node_init", str(config)),
    ]


@dataclass(frozen=True, slots=True)
class Node:
    """A node: real containerd, kubelet and kube-proxy in separate namespaces.

    Attributes:
        spec: Part of the cluster file that describes the node.
        index: Index of the node in the addressing.
        wiring: Network of the cluster.
        state: State directory of the cluster.
        branch: Control group of the cluster.
        world_origin: Centre of the landscape of the cluster's cameras.
    """

    spec: NodeSpec
    index: int
    wiring: network.Wiring
    state: StateDirectory
    branch: Branch
    world_origin: Place | None = None

    @property
    def name(self) -> str:
        """Name of the Kubernetes node."""
        return self.spec.name

    @property
    def address(self) -> IPv4Address:
        """Address in the cluster network."""
        return self.wiring.addressing.node(self.index)

    @property
    def directory(self) -> Path:
        """Directory of the node's files. It contains `var-lib/`, the node's /var/lib, and `etc/`, its changes to /etc."""
        return self.state.node(self.name)

    @property
    def fractus_state(self) -> Path:
        """Directory that is mounted as /var/lib/fractus on the node."""
        return self.directory / "var-lib" / "fractus"

    def volume(self, number: int) -> Path:
        """Return the directory of a volume of the node."""
        return self.directory / "var-lib" / Path(VOLUMES).name / str(number)

    @property
    def powered(self) -> bool:
        """True if the node is running."""
        return running(self.state.process(f"node.{self.name}")) is not None

    @property
    def vehicle_running(self) -> bool | None:
        """True if the node's vehicle is running. None without vehicle."""
        return None if self.spec.vehicle() is None else self._runs("vehicle")

    @property
    def camera_running(self) -> bool | None:
        """True if the node's simulated camera is running. None without camera."""
        return None if self.spec.hardware.camera is None else self._runs("camera")

    def _runs(self, hardware: str) -> bool:
        return running(self.state.process(f"{hardware}.{self.name}")) is not None

    @property
    def _cgroup(self) -> Branch:
        return self.branch.below("nodes").below(self.name)

    @property
    def _hardware_cgroup(self) -> Branch:
        return self.branch.below("hardware").below(self.name)

    def init_pid(self) -> int:
        """Return the process id of the node's first program.

        Raises:
            ClusterError: The node is off.
        """
        record = running(self.state.process(f"node.{self.name}"))
        if record is not None:
            children = Path(f"/proc/{record.pid}/task/{record.pid}/children").read_text().split()
            if children:
                return int(children[0])
        raise ClusterError(f"node {self.name} is powered off; power it on: fractus cluster power on {self.name}")

    def exec_command(self, argv: Sequence[str]) -> list[str]:
        """Return a command for this machine that runs `argv` on the node.

        Raises:
            ClusterError: The node is off.
        """
        enter = ["nsenter", f"--target={self.init_pid()}", "--mount", "--uts", "--ipc", "--net", "--pid"]
        return [*enter, "--", *argv]

    def exec(
        self, argv: Sequence[str], *, input_text: str | None = None, timeout_s: float = 60.0, check: bool = True
    ) -> subprocess.CompletedProcess[str]:
        """Run a program on the node as root and return its output.

        Raises:
            ClusterError: The node is powered off, or the program failed (with `check`) or timed out.
        """
        return run(self.exec_command(argv), input_text=input_text, timeout_s=timeout_s, check=check, env=ENVIRONMENT)

    def cut_link(self) -> None:
        """Cut the node's uplink. The node keeps running."""
        network.cut_link(self.wiring, self.index)

    def heal_link(self) -> None:
        """Restore the node's uplink."""
        network.heal_link(self.wiring, self.index)

    def power_off(self) -> None:
        """Power off the node: kill all its processes. Its vehicle keeps running."""
        record_path = self.state.process(f"node.{self.name}")
        kill_recorded(record_path)
        self._cgroup.kill_all()
        record_path.unlink(missing_ok=True)
        # Control groups of old pods would slow down the kubelet at its next start.
        self._cgroup.remove()

    def power_on(self) -> bool:
        """Power on the node with the last written configuration. Nothing changes if it is running.

        Returns:
            True if the node was powered off.
        """
        if self.powered:
            return False
        self.power_off()
        if self.spec.hardware.disk is not None:
            mount_disk(self.directory / "disk.img", self.fractus_state, self.spec.hardware.disk.size_bytes)
        network.flush_firewall(self.wiring, self.name)
        record = spawn(
            init_command(self.directory / "config" / "init.json", self.wiring.namespace_path(self.name)),
            log=self.state.logs / self.name / "init.log",
            cgroup_files=self._cgroup.create(),
            env=ENVIRONMENT,
        )
        write_record(self.state.process(f"node.{self.name}"), record)
        return True

    def start_hardware(self) -> None:
        """Start the node's vehicle and camera if they are configured and not running.

        Raises:
            ClusterError: The simulator is not installed, or the position of the vehicle is not specified.
        """
        for name, command in hardware_commands(self.spec, self.world_origin).items():
            if self._runs(name):
                continue
            record = spawn(
                ["nsenter", f"--net={self.wiring.namespace_path(self.name)}", *command],
                log=self.state.logs / self.name / f"{name}.log",
                cgroup_files=self._hardware_cgroup.create(),
                env=hardware_environment(),
            )
            write_record(self.state.process(f"{name}.{self.name}"), record)

    def changed_hardware(self) -> dict[str, str]:
        """Return the running hardware that no longer matches the cluster file.

        Returns:
            The arguments in the cluster file, by `vehicle` and `camera`. They are empty if the file has no such hardware.
        """
        commands = hardware_commands(self.spec, self.world_origin)
        changed: dict[str, str] = {}
        for name in _HARDWARE:
            record = running(self.state.process(f"{name}.{self.name}"))
            if record is None:
                continue
            program, *arguments = commands.get(name, [""])
            words = command_line(record)
            # A script is run by its interpreter, so the program is not the first word.
            at = next((at for at, word in enumerate(words) if Path(word).name == Path(program).name), len(words))
            if words[at + 1 :] != arguments or name not in commands:
                changed[name] = shlex.join(arguments)
        return changed

    def stop_part(self, name: str) -> None:
        """Stop `vehicle` or `camera`."""
        path = self.state.process(f"{name}.{self.name}")
        kill_recorded(path)
        path.unlink(missing_ok=True)

    def stop_hardware(self) -> None:
        """Stop the node's vehicle and camera."""
        for name in _HARDWARE:
            self.stop_part(name)
        self._hardware_cgroup.kill_all()
        self._hardware_cgroup.remove()

    def remove(self) -> None:
        """Remove the node from the machine: processes, network namespace and files."""
        self.power_off()
        self.stop_hardware()
        network.unwire_node(self.wiring, self.name, self.index)
        unmount_below(self.directory)
        shutil.rmtree(self.directory, ignore_errors=True)
        shutil.rmtree(self.state.logs / self.name, ignore_errors=True)

    def files(self, binaries: Binaries, authority: Authority) -> dict[str, str]:
        """Return the content of the node's files by their path below its directory. Secrets are in `config/`.

        Raises:
            ClusterError: The CNI plugins are not installed.
        """
        plugins = plugin_directory()
        if plugins is None:
            raise ClusterError("no CNI plugins; install containernetworking-plugins")
        place = self.wiring.addressing
        server = server_url(place)
        kubelet = authority.issue(
            f"kubelet.{self.name}",
            common_name=f"system:node:{self.name}",
            organizations=("system:nodes",),
            alternative_names=(self.name, self.address),
        )
        proxy = authority.issue("kube-proxy", common_name="system:kube-proxy")
        cluster = self.wiring.cluster
        content = {
            "etc/hostname": self.name + "\n",
            "etc/machine-id": hashlib.sha256(f"{cluster}/{self.name}".encode()).hexdigest()[:32] + "\n",
            "etc/hosts": nodeconfig.hosts_file(self.name),
            "etc/resolv.conf": nodeconfig.resolver_file(place),
            "config/ca.crt": authority.credential.certificate.read_text(),
            "config/kubelet.crt": kubelet.certificate.read_text(),
            "config/kubelet.key": kubelet.key.read_text(),
            "config/kubelet.kubeconfig": authority.kubeconfig(kubelet, server=server, cluster=cluster),
            "config/kube-proxy.kubeconfig": authority.kubeconfig(proxy, server=server, cluster=cluster),
            "config/kubelet.yaml": nodeconfig.kubelet_config(
                self.spec,
                cgroup_root=self._cgroup.path,
                cgroup_version=self._cgroup.hierarchies.version,
                machine=machine(),
            ),
            "config/kube-proxy.yaml": nodeconfig.kube_proxy_config(self.spec, place),
            "config/containerd.toml": nodeconfig.containerd_config(plugin_directory=plugins),
            "config/cni/10-fractus-sim.conflist": nodeconfig.cni_config(self.index, place),
            "config/init.json": self._init(binaries),
        }
        if self.spec.manifest is not None:
            content["etc/fractus/node.yaml"] = yaml.safe_dump(self.spec.manifest, sort_keys=False, allow_unicode=True)
        return content

    def _init(self, binaries: Binaries) -> str:
        view = {
            "hostname": self.name,
            "files": str(self.directory),
            "logs": str(self.state.logs / self.name),
            "programs": {name: str(binaries[name].resolve()) for name in _PROGRAMS},
            "sysctls": nodeconfig.SHOWN_SYSCTLS,
        }
        return json.dumps(
            {"view": view, "units": nodeconfig.node_units(self.spec, address=str(self.address))}, indent=1
        )

    def write_files(self, content: dict[str, str]) -> bool:
        """Write the node's files if they changed. A running node is powered off first.

        Returns:
            True if a file changed.
        """
        digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
        stamp = self.directory / "digest"
        if stamp.exists() and stamp.read_text() == digest:
            return False
        self.power_off()
        stamp.unlink(missing_ok=True)
        for name in _FOLDERS:
            (self.directory / name).mkdir(parents=True, exist_ok=True)
        shutil.rmtree(self.directory / "etc-work")
        (self.directory / "etc-work").mkdir()
        (self.state.logs / self.name).mkdir(parents=True, exist_ok=True)
        for name, text in content.items():
            path = self.directory / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if name.startswith("config/"):
                write_private(path, text)
            else:
                path.write_text(text)
        stamp.write_text(digest)
        return True
