"""Network of a cluster: a namespace for the control plane and a namespace for each node, connected by a bridge.

The bridge is in the namespace of the control plane. Therefore firewall and forwarding of the machine do not affect the
traffic of the cluster. The machine itself only gets one link and one route.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass
from ipaddress import IPv4Network
from pathlib import Path
from typing import Any

from fractus_cluster.addressing import Addressing
from fractus_cluster.commands import run

NETNS_DIRECTORY = Path("/run/netns")
_BRIDGE = "br0"
UPLINK = "eth0"


@dataclass(frozen=True, slots=True)
class Wiring:
    """Names of a cluster's network namespaces and links.

    Attributes:
        cluster: Name of the cluster.
        addressing: Its addresses.
        marks: Directory that records which namespaces were set up completely.
    """

    cluster: str
    addressing: Addressing
    marks: Path

    @property
    def host_link(self) -> str:
        """Name of the machine's end of its link into the cluster."""
        return host_link(self.cluster)

    def namespace(self, node: str | None = None) -> str:
        """Return the name of the network namespace of a node, by default of the control plane."""
        return _namespace_name(self.cluster) + ("" if node is None else f".{node}")

    def namespace_path(self, node: str | None = None) -> Path:
        """Return the file of a network namespace."""
        return NETNS_DIRECTORY / self.namespace(node)


@dataclass(frozen=True, slots=True)
class _Mark:
    """Record of a completely configured network namespace.

    Attributes:
        inode: Inode number of the namespace.
        hub: Inode number of the control plane's namespace. 0 in the record of the control plane itself.
        mobile: True if the uplink is a simulated mobile uplink.
    """

    inode: int
    hub: int
    mobile: bool = False


def host_link(cluster: str) -> str:
    """Return the device name of the machine's end of its link into a cluster. Linux allows at most 15 characters."""
    return "fx-" + hashlib.sha256(cluster.encode()).hexdigest()[:10]


def _namespace_name(cluster: str) -> str:
    return f"fractus.{cluster}"


def networks_in_use() -> list[IPv4Network]:
    """Return the networks of all IPv4 routes and addresses of the machine."""
    networks: list[IPv4Network] = []
    for route in _json(["ip", "-4", "-j", "route", "show", "table", "all"]):
        destination = str(route["dst"])
        if destination != "default":
            networks.append(IPv4Network(destination, strict=False))
    for link in _json(["ip", "-4", "-j", "address"]):
        addresses = link.get("addr_info", ())
        networks.extend(IPv4Network(f"{entry['local']}/{entry['prefixlen']}", strict=False) for entry in addresses)
    return networks


def wire_control_plane(wiring: Wiring) -> None:
    """Create the control plane's namespace with the bridge and the machine's link, unless they exist."""
    path = wiring.namespace_path()
    inode = _inode(path)
    if _read_mark(wiring, None) == _Mark(inode, 0) and inode and _link_exists(wiring.host_link):
        return
    _mark_path(wiring, None).unlink(missing_ok=True)
    if inode:
        run(["ip", "netns", "delete", wiring.namespace()])
    _delete_link(wiring.host_link)
    run(["ip", "netns", "add", wiring.namespace()])
    place = wiring.addressing
    prefix = place.node_network.prefixlen
    _ip(
        wiring.namespace(),
        "link set lo up",
        f"link add {_BRIDGE} type bridge forward_delay 0 mcast_snooping 0",
        f"address add {place.control_plane}/{prefix} dev {_BRIDGE}",
        f"link set {_BRIDGE} up",
        f"link add {wiring.host_link} type veth peer name host",
        f"link set host master {_BRIDGE} up",
        f"link set {wiring.host_link} netns {os.getpid()}",
    )
    _ip(
        None,
        f"address add {place.host}/{prefix} dev {wiring.host_link}",
        f"link set {wiring.host_link} up",
        f"route add {place.pod_network} via {place.control_plane} dev {wiring.host_link}",
    )
    _settings(path, {"ip_forward": "1", "conf/all/rp_filter": "0", "conf/all/send_redirects": "0"})
    _write_mark(wiring, None, _Mark(_inode(path), 0))


def wire_node(wiring: Wiring, node: str, index: int, *, mobile: bool = False) -> None:
    """Create a node's namespace and uplink unless they exist. Restore the uplink if it is cut.

    Args:
        wiring: Network of the cluster.
        node: Name of the node.
        index: Index of the node in the addressing.
        mobile: True if the radio carries the uplink between two devices. False for a wire.
    """
    path = wiring.namespace_path(node)
    hub = _inode(wiring.namespace_path())
    inode = _inode(path)
    if inode and _read_mark(wiring, node) == _Mark(inode, hub, mobile):
        heal_link(wiring, index)
        return
    _mark_path(wiring, node).unlink(missing_ok=True)
    if not inode:
        run(["ip", "netns", "add", wiring.namespace(node)])
    place = wiring.addressing
    device = port(index)
    _delete_link(UPLINK, wiring.namespace(node))
    _delete_link(device, wiring.namespace())
    if mobile:
        # These devices are persistent: after the radio process has ended, they remain without a carrier.
        _ip(wiring.namespace(node), f"tuntap add dev {UPLINK} mode tap")
        _ip(wiring.namespace(), f"tuntap add dev {device} mode tap")
    else:
        _ip(wiring.namespace(), f"link add {device} type veth peer name {UPLINK} netns {wiring.namespace(node)}")
    _ip(
        wiring.namespace(),
        f"link set {device} master {_BRIDGE} up",
        f"route replace {place.pods(index)} via {place.node(index)} dev {_BRIDGE}",
    )
    _ip(
        wiring.namespace(node),
        "link set lo up",
        f"address add {place.node(index)}/{place.node_network.prefixlen} dev {UPLINK}",
        f"link set {UPLINK} up",
        f"route add default via {place.control_plane} dev {UPLINK}",
    )
    _settings(path, {"ip_forward": "1", "conf/all/rp_filter": "0", "conf/default/rp_filter": "0"})
    _write_mark(wiring, node, _Mark(_inode(path), hub, mobile))


def unwire_node(wiring: Wiring, node: str, index: int) -> None:
    """Remove a node's namespace and its port on the bridge."""
    if wiring.namespace_path().exists():
        _delete_link(port(index), wiring.namespace())
        run(["ip", "-n", wiring.namespace(), "route", "del", str(wiring.addressing.pods(index))], check=False)
    if wiring.namespace_path(node).exists():
        run(["ip", "netns", "delete", wiring.namespace(node)])
    _mark_path(wiring, node).unlink(missing_ok=True)


def unwire(cluster: str) -> None:
    """Remove every namespace and link of a cluster."""
    _delete_link(host_link(cluster))
    name = _namespace_name(cluster)
    if NETNS_DIRECTORY.is_dir():
        for path in sorted(NETNS_DIRECTORY.iterdir()):
            if path.name == name or path.name.startswith(name + "."):
                run(["ip", "netns", "delete", path.name])


def cut_link(wiring: Wiring, index: int) -> None:
    """Take a node's uplink down at its remote end. For the node, this looks like a loss of radio contact."""
    _ip(wiring.namespace(), f"link set {port(index)} down")


def heal_link(wiring: Wiring, index: int) -> None:
    """Restore a node's uplink."""
    _ip(wiring.namespace(), f"link set {port(index)} up")


def links_cut(wiring: Wiring) -> set[int]:
    """Return the indexes of the nodes whose uplink is down."""
    if not wiring.namespace_path().exists():
        return set()
    down: set[int] = set()
    for link in _json(["ip", "-n", wiring.namespace(), "-j", "link", "show", "master", _BRIDGE]):
        name = str(link["ifname"])
        if name.startswith("node") and "UP" not in link["flags"]:
            down.add(int(name.removeprefix("node")))
    return down


def flush_firewall(wiring: Wiring, node: str) -> None:
    """Remove a node's firewall rules, which do not survive a loss of power."""
    run(["ip", "netns", "exec", wiring.namespace(node), "nft", "flush", "ruleset"])


def port(index: int) -> str:
    """Return the name of the bridge's end of a node's uplink."""
    return f"node{index}"


def _ip(namespace: str | None, *commands: str) -> None:
    argv = ["ip", *(["-n", namespace] if namespace else []), "-batch", "-"]
    run(argv, input_text="\n".join(commands) + "\n", timeout_s=30)


def _json(argv: list[str]) -> list[dict[str, Any]]:
    text = run(argv, timeout_s=30).stdout.strip()
    content = json.loads(text) if text else []
    return [entry for entry in content if entry]


def _link_exists(name: str, namespace: str | None = None) -> bool:
    argv = ["ip", *(["-n", namespace] if namespace else []), "link", "show", "dev", name]
    return run(argv, check=False, timeout_s=30).returncode == 0


def _delete_link(name: str, namespace: str | None = None) -> None:
    if _link_exists(name, namespace):
        run(["ip", *(["-n", namespace] if namespace else []), "link", "delete", "dev", name], timeout_s=30)


def _settings(namespace: Path, values: dict[str, str]) -> None:
    script = "\n".join(f"echo {value} > /proc/sys/net/ipv4/{name}" for name, value in values.items())
    run(["nsenter", f"--net={namespace}", "sh", "-ec", script], timeout_s=30)


def _inode(path: Path) -> int:
    """Return the identity of a network namespace, or 0 if the file does not exist or refers to no namespace."""
    try:
        facts = path.stat()
    except FileNotFoundError:
        return 0
    if facts.st_dev != NETNS_DIRECTORY.stat().st_dev:
        return facts.st_ino
    # An interrupted `ip netns add` leaves a regular file on the file system of /run.
    path.unlink()
    return 0


def _mark_path(wiring: Wiring, node: str | None) -> Path:
    return wiring.marks / ("control-plane.json" if node is None else f"node.{node}.json")


def _read_mark(wiring: Wiring, node: str | None) -> _Mark | None:
    try:
        return _Mark(**json.loads(_mark_path(wiring, node).read_text()))
    except (FileNotFoundError, json.JSONDecodeError, TypeError):
        return None


def _write_mark(wiring: Wiring, node: str | None, mark: _Mark) -> None:
    path = _mark_path(wiring, node)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(asdict(mark)))
