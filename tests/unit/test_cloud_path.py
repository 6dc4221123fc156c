"""Cloud path: reachability and performance, tested with a fake network and simulated time."""

from __future__ import annotations

import asyncio

import pytest
from fractus_agent.links import cloud_path
from fractus_agent.links.cloud_path import SILENT_S, STEADY_S, CloudPath, ReachabilityMonitor
from fractus_core.api.nodes import Drone


def monitor(*responses_s: float, requests_s: range) -> ReachabilityMonitor:
    """Return a monitor after one request per second.

    Requests in the seconds `responses_s` get an immediate response.
    """
    path = ReachabilityMonitor()
    for now_s in requests_s:
        path.on_request(now_s)
        if now_s in responses_s:
            path.on_response(now_s)
    return path


def test_path_without_responses_becomes_unreachable() -> None:
    assert ReachabilityMonitor().is_reachable(0.0), "the path counts as reachable before the first request"
    path = monitor(0, requests_s=range(3))
    assert path.is_reachable(SILENT_S + 0.9)
    assert not path.is_reachable(SILENT_S + 1.0)


def test_path_without_requests_stays_reachable() -> None:
    assert monitor(0, requests_s=range(1)).is_reachable(1000.0)


def test_unreachable_path_recovers_after_steady_responses() -> None:
    path = monitor(0, *range(20, 30), requests_s=range(25))
    assert not path.is_reachable(24.0)
    path.on_request(25.0)
    path.on_response(20.0 + STEADY_S)
    assert path.is_reachable(25.0)


def test_flapping_path_stays_unreachable() -> None:
    path = ReachabilityMonitor()
    reachable = []
    for now_s in range(1, 200):
        path.on_request(now_s)
        if now_s % 8 < 2:
            path.on_response(now_s + 0.1)
        reachable.append(path.is_reachable(now_s + 0.2))
    assert not any(reachable[10:])


DRONE = Drone.from_body({
    "apiVersion": "fractus.dev/v1alpha1", "kind": "Drone", "metadata": {"name": "d1"},
    "spec": {"interfaces": [{"technology": "4G", "bandwidth": 3}, {"technology": "5G", "bandwidth": 5}]},
})  # fmt: skip


def test_latency_is_the_default_of_the_technology_until_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cloud_path, "PROBE_S", 0.0)
    responses = iter([True] * 5 + [False] * 5)
    probes = 0

    async def probe(timeout_s: float) -> bool:
        nonlocal probes
        assert timeout_s == cloud_path.PROBE_TIMEOUT_S
        probes += 1
        await asyncio.sleep(0.01)
        return next(responses)

    async def run() -> None:
        path = CloudPath(lambda: DRONE, probe)
        first = path.metrics()
        assert first is not None
        assert (first.ingress_mbps, first.ingress_latency_ms) == (5.0, 15.0)
        running = asyncio.create_task(path.run())
        async with asyncio.timeout(30):
            while probes < 9:  # noqa: ASYNC110 (the loop under test has no event)
                await asyncio.sleep(0.001)
        measured = path.metrics()
        assert measured is not None
        assert (measured.ingress_mbps, measured.egress_mbps) == (5.0, 5.0)
        assert measured.ingress_latency_ms > 4.0, "the latency is half of the round-trip time of 10 ms"
        monkeypatch.setattr(cloud_path, "SILENT_S", 0.0)
        assert path.metrics() is None
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    asyncio.run(run())
