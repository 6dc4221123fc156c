"""Addresses of clusters: free, disjoint, and the same for a node indefinitely."""

from __future__ import annotations

from ipaddress import IPv4Network

import pytest
from fractus_cluster.addressing import MAX_NODES, SERVICE_NETWORK, Addressing, choose_block
from fractus_cluster.errors import ClusterError
from fractus_cluster.state import Memory
from hypothesis import given
from hypothesis import strategies as st

BLOCK = IPv4Network("10.200.0.0/16")

networks = st.builds(
    lambda address, length: IPv4Network((address, length), strict=False),
    st.integers(0x0A000000, 0x0AFFFFFF) | st.integers(0xAC100000, 0xAC1FFFFF),
    st.integers(13, 32),
)


@given(st.lists(networks, max_size=30))
def test_chosen_block_touches_nothing(taken: list[IPv4Network]) -> None:
    block = choose_block(taken)
    first = int(block.network_address)
    last = int(block.broadcast_address)
    for network in taken:  # without `overlaps`, which the code under test uses
        assert last < int(network.network_address) or int(network.broadcast_address) < first


def test_two_clusters_get_two_blocks() -> None:
    first = choose_block([])
    assert not first.overlaps(choose_block([first]))


def test_broad_route_does_not_forbid_a_block() -> None:
    private = [IPv4Network("10.0.0.0/8"), IPv4Network("172.16.0.0/12")]
    assert choose_block([*private, BLOCK]) == IPv4Network("10.201.0.0/16")


def test_says_so_when_nothing_is_free() -> None:
    taken = [IPv4Network(f"10.{n}.0.0/16") for n in range(256)] + [
        IPv4Network(f"172.{n}.0.0/16") for n in range(16, 32)
    ]
    with pytest.raises(ClusterError, match="no free addresses"):
        choose_block(taken)


def test_default_route_takes_nothing() -> None:
    assert choose_block([IPv4Network("0.0.0.0/0")]) == BLOCK


def test_addresses_of_a_cluster_are_distinct() -> None:
    place = Addressing(BLOCK)
    nodes = [place.node(index) for index in range(MAX_NODES)]
    single = [place.control_plane, place.host, *nodes]
    assert len(set(single)) == len(single)
    assert all(address in place.node_network for address in single)
    pods = [place.pods(index) for index in range(MAX_NODES)]
    assert len(set(pods)) == MAX_NODES
    assert all(network.subnet_of(place.pod_network) for network in pods)
    assert not place.node_network.overlaps(place.pod_network)
    assert not BLOCK.overlaps(SERVICE_NETWORK)


def test_no_more_nodes_than_addresses() -> None:
    with pytest.raises(ClusterError, match="at most"):
        Addressing(BLOCK).node(MAX_NODES)


@given(st.lists(st.lists(st.sampled_from("abcdefgh"), unique=True, min_size=1), min_size=1, max_size=6))
def test_a_node_keeps_its_index(histories: list[list[str]]) -> None:
    memory = Memory(BLOCK, {})
    for names in histories:
        before = memory.indexes
        memory = memory.with_nodes(names)
        assert list(memory.indexes) == names
        assert len(set(memory.indexes.values())) == len(names)
        assert all(memory.indexes[name] == before[name] for name in names if name in before)
        assert max(memory.indexes.values()) < len("abcdefgh")  # the lowest free one is taken
