"""Address allocation of a cluster: one free /16 block, divided between nodes, pods and the host."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network

from fractus_cluster.errors import ClusterError

SERVICE_NETWORK = IPv4Network("10.96.0.0/16")
API_SERVICE = IPv4Address("10.96.0.1")
DNS_SERVICE = IPv4Address("10.96.0.10")

_CANDIDATES = tuple(
    IPv4Network(f"{first}.{second}.0.0/16")
    for first, seconds in ((10, range(200, 250)), (172, range(20, 32)))
    for second in seconds
)
_BROAD = 12
MAX_NODES = 100


@dataclass(frozen=True, slots=True)
class Addressing:
    """Addresses of one cluster.

    Attributes:
        block: The complete block.
    """

    block: IPv4Network

    @property
    def node_network(self) -> IPv4Network:
        """Network of the node uplinks."""
        return next(self.block.subnets(new_prefix=24))

    @property
    def pod_network(self) -> IPv4Network:
        """Network of all pods."""
        return list(self.block.subnets(new_prefix=17))[1]

    @property
    def control_plane(self) -> IPv4Address:
        """Address of the API server and the cluster DNS. It is also the default gateway of the nodes."""
        return self.block.network_address + 1

    @property
    def host(self) -> IPv4Address:
        """Address of the machine in the cluster network."""
        return self.block.network_address + 254

    def node(self, index: int) -> IPv4Address:
        """Return the address of the node with this index."""
        if not 0 <= index < MAX_NODES:
            raise ClusterError(f"a cluster has at most {MAX_NODES} nodes")
        return self.block.network_address + 10 + index

    def pods(self, index: int) -> IPv4Network:
        """Return the network of the pods of the node with this index."""
        return list(self.pod_network.subnets(new_prefix=24))[index]


def choose_block(taken: Iterable[IPv4Network]) -> IPv4Network:
    """Return the first candidate block that does not overlap with a used network.

    Args:
        taken: Networks of the machine's routes and addresses, and the blocks of other clusters.

    Raises:
        ClusterError: Every candidate is in use.
    """
    used = [network for network in taken if network.prefixlen > 0]
    for candidate in _CANDIDATES:
        if not any(candidate.overlaps(network) for network in used):
            return candidate
    # Second attempt: ignore very large networks, such as a VPN route for 10.0.0.0/8. The route of the cluster is more
    # specific and takes precedence.
    narrow = [network for network in used if network.prefixlen > _BROAD]
    for candidate in _CANDIDATES:
        if not any(candidate.overlaps(network) for network in narrow):
            return candidate
    raise ClusterError("no free addresses: routes of the machine use all of 10.200-249.0.0/16 and 172.20-31.0.0/16")
