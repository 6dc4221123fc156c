"""Traffic rates computed from byte counters, which may restart."""

from __future__ import annotations

from ipaddress import IPv4Address

import pytest
from fractus_agent.links.traffic_rates import WINDOWS, ServiceRate, TrafficRates
from fractus_agent.redirector.nft_maps import Endpoint

A = Endpoint(IPv4Address("10.96.0.5"), 80)
B = Endpoint(IPv4Address("10.96.0.6"), 80)
MBIT = 125_000


def test_rates_cover_the_last_windows() -> None:
    rates = TrafficRates()
    assert rates.peak_mbps == 0
    assert not rates.by_service
    rates.update(1.0, {A: (5 * MBIT, 0)})
    rates.update(1.5, {A: (6 * MBIT, MBIT)})
    rates.update(2.0, {A: (6 * MBIT, MBIT), B: (2 * MBIT, 0)})
    assert rates.peak_mbps == pytest.approx(4.0), "the peak is 2 Mbit in half a second"
    assert rates.by_service == {
        A: ServiceRate(pytest.approx(1.0), pytest.approx(1.0)),
        B: ServiceRate(pytest.approx(2.0), 0.0),
    }
    for number in range(WINDOWS):
        rates.update(2.1 + number / 10, {A: (6 * MBIT, MBIT)})
    assert rates.peak_mbps == 0


def test_restarted_counter_counts_from_zero() -> None:
    rates = TrafficRates()
    rates.update(1.0, {A: (9 * MBIT, 9 * MBIT)})
    rates.update(2.0, {A: (MBIT, 0)})
    assert rates.by_service[A] == ServiceRate(pytest.approx(1.0), 0.0)
