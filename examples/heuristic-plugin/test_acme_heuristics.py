"""Tests of the heuristic, alone and in a path decision."""

from __future__ import annotations

from dataclasses import replace

from acme_heuristics import least_cost
from fractus_core.linking import LinkSettings, PathMetrics, choose_path

MOBILE = PathMetrics(ingress_mbps=8.0, egress_mbps=8.0, ingress_latency_ms=60.0, egress_latency_ms=60.0)
WIFI = PathMetrics(ingress_mbps=12.0, egress_mbps=12.0, ingress_latency_ms=3.0, egress_latency_ms=3.0, direct=True)


def test_bandwidth_above_requirement_does_not_raise_the_score() -> None:
    assert least_cost(WIFI) == least_cost(replace(WIFI, ingress_mbps=100.0))


def test_slightly_slower_direct_link_scores_better_than_mobile_network() -> None:
    assert (
        least_cost(replace(WIFI, ingress_mbps=5.0)) > least_cost(MOBILE) > least_cost(replace(WIFI, ingress_mbps=3.0))
    )


def test_traffic_takes_the_path_with_the_better_score() -> None:
    def direct(wifi_mbps: float, is_direct: bool) -> bool:
        wifi = replace(WIFI, ingress_mbps=wifi_mbps)
        decision = choose_path(least_cost, MOBILE, wifi, is_direct=is_direct, leaving=False, settings=LinkSettings())
        return decision.direct

    assert direct(5.0, is_direct=False)
    assert not direct(3.0, is_direct=True)
