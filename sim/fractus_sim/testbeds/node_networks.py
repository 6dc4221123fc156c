"""Simulated networks between the drones and nodes of an experiment in mode standalone.

The programs of each participant run in a network namespace of their own. The namespace of a drone has a link to its
services, which run outside of it. `fractus-radio` carries the frames between the namespaces. The kernel counts the sent
bytes of each namespace. A namespace exists as long as its holder process, so nothing remains of a killed experiment.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Mapping
from ipaddress import IPv4Address
from pathlib import Path

from fractus_cluster.commands import run
from fractus_cluster.errors import ClusterError
from fractus_cluster.ports import free_port
from fractus_radio.layout import mac_address

from fractus_sim.errors import ExperimentError
from fractus_sim.experiment.checks import DataLevel
from fractus_sim.experiment.definition import Experiment, SimulatedNetwork
from fractus_sim.testbeds.local_processes import Processes
from fractus_sim.testbeds.standalone_drones import LOOPBACK, base_environment, within

START_TIMEOUT_S = 30.0
_SERVICE_DEVICE = "svc0"
_SERVICE_ADDRESSES = int(IPv4Address("198.18.0.0"))
"""Start of the range of RFC 2544 for tests. Each drone uses two addresses of it."""

_RADIO = "network"


class NetworksUnavailable(ExperimentError):
    """The user is not root, or this machine has no programs to create networks."""


def require_networks() -> None:
    """Check that this process can create network namespaces and devices.

    Raises:
        NetworksUnavailable: The user is not root, or a program is missing.
        ExperimentError: The kernel refuses a namespace or device, or does not create it in time.
    """
    if os.geteuid() != 0:
        raise NetworksUnavailable("simulated networks need root; run the test as root")
    missing = [program for program in ("unshare", "nsenter", "ip") if shutil.which(program) is None]
    if missing:
        raise NetworksUnavailable(f"simulated networks need {', '.join(missing)}; install util-linux and iproute2")
    try:
        run(["unshare", "--net", "ip", "tuntap", "add", "dev", "probe", "mode", "tap"], timeout_s=START_TIMEOUT_S)
    except ClusterError as error:
        raise ExperimentError(f"simulated networks: {error}") from None


class NodeNetworks:
    """Network namespaces of the participants, and the process that carries frames between them.

    Args:
        experiment: Experiment with networks.
        processes: Processes of the experiment.
        folder: Output folder.
    """

    def __init__(self, experiment: Experiment, processes: Processes, folder: Path) -> None:
        self._experiment = experiment
        self._processes = processes
        self._folder = folder
        self._nodes = tuple(dict.fromkeys(name for each in experiment.networks for name in each.participants))
        self._holders: dict[str, int] = {}
        self._service_hosts: dict[str, str] = {}

    def set_up(self) -> None:
        """Create the namespaces with their devices.

        Raises:
            ExperimentError: A namespace or device cannot be created.
        """
        if not self._nodes:
            return
        require_networks()
        vehicles = {setup.name for setup in self._experiment.setups()}
        try:
            for node in self._nodes:
                self._hold_namespace(node)
                if node in vehicles:
                    self._link_services(node)
                for index, network in enumerate(self._experiment.networks):
                    if node in network.participants:
                        self._add_device(node, index)
        except ClusterError as error:
            raise ExperimentError(f"simulated networks: {error}") from None

    def start(self, vehicles: Mapping[str, str]) -> None:
        """Start to carry frames.

        Args:
            vehicles: MAVLink server of each vehicle, `tcp:HOST:PORT`.

        Raises:
            ExperimentError: The process did not start.
        """
        if not self._nodes:
            return
        layout = self._folder / "logs" / f"{_RADIO}.json"
        control = Path("/tmp") / f"fractus-{free_port()}.sock"  # noqa: S108 - the path of a socket must be short
        layout.write_text(json.dumps(self._layout(control, vehicles), indent=1))
        command = [sys.executable, "-m", "fractus_radio", str(layout)]
        self._processes.start(_RADIO, command, base_environment())
        try:
            self._processes.wait(_RADIO, control.exists, START_TIMEOUT_S)
        finally:
            control.unlink(missing_ok=True)

    def service_host(self, vehicle: str) -> str | None:
        """Return the address of this machine that programs of a drone can reach. None: they run without namespace."""
        return self._service_hosts.get(vehicle)

    def namespace(self, node: str) -> Path | None:
        """Return the network namespace of a node. None: its programs run without."""
        return Path(f"/proc/{self._holders[node]}/ns/net") if node in self._holders else None

    def address(self, node: str, other: str) -> str | None:
        """Return the address of another node in the first common network. None if there is no common network.

        Programs of one node, and programs of nodes that take part in no network, use the loopback interface.
        """
        if node == other or not {node, other} & set(self._nodes):
            return LOOPBACK
        for index, network in enumerate(self._experiment.networks):
            if {node, other} <= set(network.participants):
                return self._address(index, other)
        return None

    def measure(self) -> dict[str, dict[DataLevel, int]]:
        """Return the bytes of all frames that programs sent (`app`) and that services sent to them (`runtime`), by node.

        A node whose namespace has ended was not measured, and is missing.
        """
        sent: dict[str, dict[DataLevel, int]] = {}
        for node, pid in self._holders.items():
            devices = _read_devices(Path(f"/proc/{pid}/net/dev"))
            if devices is None:
                continue
            sent[node] = {"app": sum(transmitted for device, (_, transmitted) in devices.items() if device != "lo")}
            if _SERVICE_DEVICE in devices:
                sent[node]["runtime"] = devices[_SERVICE_DEVICE][0]
        return sent

    def _hold_namespace(self, node: str) -> None:
        name = f"{node}-namespace"
        self._processes.start(name, ["unshare", "--net", "sleep", "infinity"], base_environment())
        pid = self._processes.pid(name)
        own = Path("/proc/self/ns/net").stat().st_ino
        namespace = Path(f"/proc/{pid}/ns/net")
        self._processes.wait(name, lambda: namespace.stat().st_ino != own, START_TIMEOUT_S)
        self._holders[node] = pid
        run(
            within(
                self.namespace(node),
                ["sh", "-ec", "echo 1 > /proc/sys/net/ipv6/conf/all/disable_ipv6; ip link set lo up"],
            )
        )

    def _link_services(self, node: str) -> None:
        number = free_port()
        host = str(IPv4Address(_SERVICE_ADDRESSES + 2 * number))
        inside = str(IPv4Address(_SERVICE_ADDRESSES + 2 * number + 1))
        device = f"fxsvc{number}"
        pid = str(self._holders[node])
        run(["ip", "link", "add", device, "type", "veth", "peer", "name", _SERVICE_DEVICE, "netns", pid])
        run(["ip", "address", "add", f"{host}/31", "dev", device])
        run(["ip", "link", "set", device, "up"])
        self._configure(node, _SERVICE_DEVICE, f"{inside}/31")
        self._service_hosts[node] = host

    def _add_device(self, node: str, index: int) -> None:
        device = _device(index)
        run(within(self.namespace(node), ["ip", "tuntap", "add", "dev", device, "mode", "tap"]))
        network = self._experiment.networks[index]
        address = mac_address(f"{network.name} {node}").hex(":")
        run(within(self.namespace(node), ["ip", "link", "set", device, "address", address]))
        self._configure(node, device, f"{self._address(index, node)}/24")

    def _configure(self, node: str, device: str, address: str) -> None:
        run(within(self.namespace(node), ["ip", "address", "add", address, "dev", device]))
        run(within(self.namespace(node), ["ip", "link", "set", device, "up"]))

    def _address(self, index: int, node: str) -> str:
        return f"10.77.{index}.{self._nodes.index(node) + 1}"

    def _layout(self, control: Path, vehicles: Mapping[str, str]) -> dict[str, object]:
        places = {setup.name: setup.home for setup in self._experiment.setups()}
        places |= {node.name: node.place for node in self._experiment.nodes}
        known = [place for place in places.values() if place is not None]

        def member(node: str, index: int) -> dict[str, object]:
            place = places[node]
            return {
                "name": node,
                "namespace": str(self.namespace(node)),
                "device": _device(index),
                "place": None if place is None else {"lat": place.lat, "lon": place.lon, "alt": place.alt},
                "vehicle": vehicles.get(node),
            }

        def network(index: int, each: SimulatedNetwork) -> dict[str, object]:
            return {
                "name": each.name,
                "range_m": each.range,
                "loss": each.loss,
                "delay_s": each.delay,
                "rate_bps": each.bandwidth * 1e6,
                "members": [member(node, index) for node in each.participants],
            }

        origin = known[0]
        return {
            "control": str(control),
            "seed": self._experiment.seed,
            "origin": {"lat": origin.lat, "lon": origin.lon, "alt": origin.alt},
            "networks": [network(index, each) for index, each in enumerate(self._experiment.networks)],
        }


def _device(index: int) -> str:
    return f"net{index}"


def _read_devices(path: Path) -> dict[str, tuple[int, int]] | None:
    """Return received and transmitted bytes of each device in a file like /proc/net/dev. None if its process ended."""
    try:
        lines = path.read_text().splitlines()[2:]
    except OSError:
        return None
    fields = {name.strip(): values.split() for name, _, values in (line.partition(":") for line in lines)}
    return {name: (int(values[0]), int(values[8])) for name, values in fields.items()}
