"""Address blocks of clusters are unused and disjoint, and each node keeps its index."""

from __future__ import annotations

from ipaddress import IPv4Network

import pytest
from fractus_cluster.addressing import MAX_NODES, SERVICE_NETWORK, Addressing, choose_block
from fractus_cluster.errors import ClusterError
from fractus_cluster.state import ClusterRecord
from hypothesis import given
from hypothesis import strategies as st

BLOCK = IPv4Network("10.200.0.0/16")

networks = st.builds(
    lambda address, length: IPv4Network((address, length), strict=False),
    st.integers(0x0A000000, 0x0AFFFFFF) | st.integers(0xAC100000, 0xAC1FFFFF),
    st.integers(13, 32),
)


@given(st.lists(networks, max_size=30))
def test_chosen_block_overlaps_no_used_network(taken: list[IPv4Network]) -> None:
    block = choose_block(taken)
    first = int(block.network_address)
    last = int(block.broadcast_address)
    for network in taken:  # compares addresses, because `overlaps` is used by the code under test
        assert last < int(network.network_address) or int(network.broadcast_address) < first


def test_clusters_get_different_blocks() -> None:
    first = choose_block([])
    assert not first.overlaps(choose_block([first]))


def test_broad_route_does_not_block_smaller_networks() -> None:
    private = [IPv4Network("10.0.0.0/8"), IPv4Network("172.16.0.0/12")]
    assert choose_block([*private, BLOCK]) == IPv4Network("10.201.0.0/16")


def test_choose_block_raises_when_no_block_is_free() -> None:
    taken = [IPv4Network(f"10.{n}.0.0/16") for n in range(256)] + [
        IPv4Network(f"172.{n}.0.0/16") for n in range(16, 32)
    ]
    with pytest.raises(ClusterError, match="no free addresses"):
        choose_block(taken)


def test_default_route_blocks_no_network() -> None:
    assert choose_block([IPv4Network("0.0.0.0/0")]) == BLOCK


def test_addresses_of_a_cluster_are_distinct() -> None:
    addressing = Addressing(BLOCK)
    nodes = [addressing.node(index) for index in range(MAX_NODES)]
    addresses = [addressing.control_plane, addressing.host, *nodes]
    assert len(set(addresses)) == len(addresses)
    assert all(address in addressing.node_network for address in addresses)
    pods = [addressing.pods(index) for index in range(MAX_NODES)]
    assert len(set(pods)) == MAX_NODES
    assert all(network.subnet_of(addressing.pod_network) for network in pods)
    assert not addressing.node_network.overlaps(addressing.pod_network)
    assert not BLOCK.overlaps(SERVICE_NETWORK)


def test_node_index_beyond_the_block_is_refused() -> None:
    with pytest.raises(ClusterError, match="at most"):
        Addressing(BLOCK).node(MAX_NODES)


@given(st.lists(st.lists(st.sampled_from("abcdefgh"), unique=True, min_size=1), min_size=1, max_size=6))
def test_node_keeps_its_index(histories: list[list[str]]) -> None:
    memory = ClusterRecord(BLOCK, {})
    for names in histories:
        before = memory.indexes
        memory = memory.with_nodes(names)
        assert list(memory.indexes) == names
        assert len(set(memory.indexes.values())) == len(names)
        assert all(memory.indexes[name] == before[name] for name in names if name in before)
        assert max(memory.indexes.values()) < len("abcdefgh")  # a new node gets the lowest free index
