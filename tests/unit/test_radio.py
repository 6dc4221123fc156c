"""Simulated radio and mobile uplink.

The radio is compared with 802.11g of ns-3: rates over distance, half duplex and faults.
"""

from __future__ import annotations

import math
import random

import pytest
from fractus_radio.medium import ATTEMPTS, QUEUE_FRAMES, Medium, Station, airtime_s
from fractus_radio.propagation import Propagation
from fractus_radio.shared_network import SharedNetwork
from fractus_radio.uplink import Uplink

NS3_POWER_DBM = 16.02
NS3_EXPONENT = 3.0
UDP_BYTES = 1400
FRAME_BYTES = UDP_BYTES + 8 + 20 + 14

A = b"\x02aaaaa"
B = b"\x02bbbbb"
C = b"\x02ccccc"


def frame(to: bytes, size: int = FRAME_BYTES) -> bytes:
    return to + b"\x02fffff" + b"\x08\x00" + b"x" * (size - 14)


def pair(distance_m: float, propagation: Propagation, seed: int = 1) -> Medium:
    medium = Medium(propagation, seed)
    medium.add("a", Station((0.0, 0.0, 0.0), A, "net"))
    medium.add("b", Station((distance_m, 0.0, 0.0), B, "net"))
    return medium


def udp_mbps(medium: Medium, seconds: float = 2.0) -> float:
    """Return the received payload in Mbit/s. The queue of the sender is never empty."""
    now = 0.0
    arrived = 0
    while now < seconds:
        while len(medium.stations["a"].queue) < 10:
            medium.offer("a", frame(B), now)
        now = medium.next_s
        arrived += sum(1 for _ in medium.advance(now))
    return arrived * UDP_BYTES * 8 / seconds / 1e6


@pytest.mark.parametrize(
    ("distance_m", "fading", "ns3_mbps", "tolerance"),
    [
        (10, None, 14.68, 0.02), (50, None, 14.67, 0.02), (51, None, 14.67, 0.02), (52, None, 0.0, 0.0),
        (10, 1.5, 14.65, 0.03), (30, 1.5, 11.3, 0.12), (90, 1.5, 0.0, 0.0),
    ],
)  # fmt: skip
def test_radio_rate_matches_ns3(distance_m: float, fading: float | None, ns3_mbps: float, tolerance: float) -> None:
    propagation = Propagation(NS3_POWER_DBM, NS3_EXPONENT, fading)
    assert udp_mbps(pair(distance_m, propagation)) == pytest.approx(ns3_mbps, rel=tolerance, abs=0.02)


@pytest.mark.parametrize(("distance_m", "ns3_mbps"), [(50, 0.96), (60, 0.35), (70, 0.10)])
def test_radio_rate_at_the_range_limit_fades_as_in_ns3(distance_m: float, ns3_mbps: float) -> None:
    rate_mbps = udp_mbps(pair(distance_m, Propagation(NS3_POWER_DBM, NS3_EXPONENT, 1.5)), 10.0)
    assert rate_mbps == pytest.approx(ns3_mbps, rel=0.25, abs=0.1)


@pytest.mark.parametrize("range_m", [80.0, 100.0, 120.0])
def test_radio_link_ends_at_the_declared_range(range_m: float) -> None:
    propagation = Propagation.reaching(range_m)
    assert udp_mbps(pair(range_m - 0.5, propagation), 0.5) > 14
    assert udp_mbps(pair(range_m + 0.5, propagation), 0.5) == 0


@pytest.mark.parametrize("size", [40, 200, 800, 1400])
def test_airtime_includes_overhead_of_each_frame(size: int) -> None:
    assert airtime_s(size + 14) == pytest.approx((size + 76) * 8 / 24e6 + 269e-6)


def test_both_directions_share_the_channel() -> None:
    medium = pair(10, Propagation.reaching(100))
    now = 0.0
    arrived = {"a": 0, "b": 0}
    while now < 2.0:
        for name, to in (("a", B), ("b", A)):
            while len(medium.stations[name].queue) < 10:
                medium.offer(name, frame(to), now)
        now = medium.next_s
        for arrival in medium.advance(now):
            arrived[arrival.station] += 1
    assert arrived["a"] == pytest.approx(arrived["b"], rel=0.01)
    assert sum(arrived.values()) * UDP_BYTES * 8 / 2.0 / 1e6 == pytest.approx(14.68, rel=0.02)


def test_frames_arrive_once_and_in_order() -> None:
    medium = pair(60, Propagation(NS3_POWER_DBM, NS3_EXPONENT, 1.5), seed=5)
    sent = [frame(B, 100)[:-4] + n.to_bytes(4, "big") for n in range(400)]
    received = []
    now = 0.0
    for data in sent:
        medium.offer("a", data, now)
        while medium.next_s < math.inf:
            now = medium.next_s
            received += [arrival.frame for arrival in medium.advance(now)]
    assert len(received) == len(set(received))
    assert received == sorted(received)
    assert len(received) < len(sent)  # some frames are dropped after their last attempt


def test_only_stations_of_one_network_in_range_receive_frames() -> None:
    medium = pair(10, Propagation.reaching(100))
    medium.add("c", Station((20.0, 0.0, 0.0), C, "other"))
    medium.add("d", Station((200.0, 0.0, 0.0), b"\x02ddddd", "net"))
    medium.offer("a", frame(b"\xff" * 6), 0.0)
    assert [arrival.station for arrival in medium.advance(1.0)] == ["b"]
    assert list(medium.neighbours("a")) == ["b"]


@pytest.mark.parametrize("fault", [{"off": True}, {"silent": True}, {"loss_db": 60.0}])
def test_faulty_station_sends_no_frames(fault: dict[str, object]) -> None:
    medium = pair(10, Propagation.reaching(100))
    for name, value in fault.items():
        setattr(medium.stations["b"], name, value)
    medium.offer("b", frame(A), 0.0)
    assert not list(medium.advance(1.0))


def test_full_radio_queue_drops_frames() -> None:
    medium = pair(10, Propagation.reaching(100))
    for _ in range(QUEUE_FRAMES + 11):
        medium.offer("a", frame(B), 0.0)
    assert medium.stations["a"].dropped == 10  # the queue does not count the frame in transmission


def test_sending_out_of_range_ends_after_the_last_attempt() -> None:
    medium = pair(200, Propagation.reaching(100))
    medium.offer("a", frame(B), 0.0)
    assert not list(medium.advance(10.0))
    assert medium.next_s == math.inf
    assert sum(airtime_s(FRAME_BYTES, n) for n in range(ATTEMPTS)) < 0.1


def test_radio_is_deterministic_for_a_seed() -> None:
    rates = [udp_mbps(pair(40, Propagation(NS3_POWER_DBM, NS3_EXPONENT, 1.5), seed=9), 0.5) for _ in range(2)]
    assert rates[0] == rates[1]


def test_uplink_has_rate_delay_and_queue() -> None:
    uplink = Uplink()
    uplink.offer(b"x" * 1000, 0.0)
    assert uplink.next_s == pytest.approx(0.061)
    assert not list(uplink.advance(0.0609))
    assert list(uplink.advance(0.0611)) == [b"x" * 1000]
    rng = random.Random(2)
    now = 1.0
    arrived = 0
    while now < 3.0:
        uplink.offer(b"x" * 1500, now)
        now += rng.uniform(0.0005, 0.0015)  # the offered traffic is 12 Mbit/s
        arrived += sum(len(packet) for packet in uplink.advance(now))
    assert arrived * 8 / 2.0 == pytest.approx(8e6, rel=0.06)
    assert uplink.dropped > 0


def test_disabled_uplink_drops_packets() -> None:
    uplink = Uplink()
    uplink.offer(b"x", 0.0)
    uplink.off = True
    uplink.offer(b"y", 0.01)
    assert not list(uplink.advance(1.0))
    uplink.off = False
    uplink.offer(b"z", 1.0)
    assert list(uplink.advance(2.0)) == [b"z"]


def test_shared_network_has_range_delay_and_rate() -> None:
    network = SharedNetwork(range_m=100.0, delay_s=0.02, rate_bps=8e6)
    network.add("drone", A, (0.0, 0.0, 0.0))
    edge = network.add("edge", B, (60.0, 0.0, 80.0))
    network.add("cloud", C)
    network.offer("drone", frame(B, 1000), 0.0)
    network.offer("drone", frame(C, 1000), 0.0)
    assert network.next_s == pytest.approx(0.021)
    assert [arrival.station for arrival in network.advance(0.0211)] == ["edge"]
    assert [arrival.station for arrival in network.advance(0.0221)] == ["cloud"]
    edge.position = (60.0, 0.0, 80.1)
    network.offer("drone", frame(B), 1.0)
    network.offer("cloud", frame(b"\xff" * 6), 1.0)
    assert {arrival.station for arrival in network.advance(2.0)} == {"drone", "edge"}
    assert math.isinf(network.next_s)


def test_shared_network_loses_the_declared_share_of_frames() -> None:
    network = SharedNetwork(loss=0.1, seed=3)
    network.add("a", A)
    network.add("b", B)
    arrived = 0
    for number in range(20_000):
        network.offer("a", frame(B, 100), float(number))
        arrived += len(list(network.advance(number + 0.5)))
    assert arrived / 20_000 == pytest.approx(0.9, abs=0.01)
