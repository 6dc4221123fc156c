"""What flows over a link, from counters that grow and begin again."""

from __future__ import annotations

from ipaddress import IPv4Address

import pytest
from fractus_agent.links.flows import KEPT, Flow, Flows
from fractus_agent.redirector.nft import Endpoint

A, B = Endpoint(IPv4Address("10.96.0.5"), 80), Endpoint(IPv4Address("10.96.0.6"), 80)
MBIT = 125_000


def test_rates_are_of_the_last_windows() -> None:
    flows = Flows()
    assert flows.peak_mbps == 0
    assert not flows.by_service
    flows.take(1.0, {A: (5 * MBIT, 0)})
    flows.take(1.5, {A: (6 * MBIT, MBIT)})
    flows.take(2.0, {A: (6 * MBIT, MBIT), B: (2 * MBIT, 0)})
    assert flows.peak_mbps == pytest.approx(4.0), "one a half second each, both ways or both services"
    assert flows.by_service == {A: Flow(pytest.approx(1.0), pytest.approx(1.0)), B: Flow(pytest.approx(2.0), 0.0)}
    for number in range(KEPT):
        flows.take(2.1 + number / 10, {A: (6 * MBIT, MBIT)})
    assert flows.peak_mbps == 0


def test_a_counter_that_begins_again_counts_from_its_beginning() -> None:
    flows = Flows()
    flows.take(1.0, {A: (9 * MBIT, 9 * MBIT)})
    flows.take(2.0, {A: (MBIT, 0)})
    assert flows.by_service[A] == Flow(pytest.approx(1.0), 0.0)
