"""Metrics of the workloads of a node: documented names, types and labels, and correct values."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Callable, Iterable
from ipaddress import IPv4Address
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from fractus_agent.agent_metrics import AgentMetrics
from fractus_agent.links.decisions import LinkActions
from fractus_agent.links.link_metrics import LinkMetrics
from fractus_agent.links.link_status import DroneLinkReport
from fractus_agent.links.traffic_rates import ServiceRate
from fractus_agent.redirector.nft_maps import Endpoint
from fractus_core.linking import NO_LINK, PathMetrics, Peer
from fractus_runtime.audit import AuditLog
from fractus_runtime.metrics import metrics_text
from fractus_services.grant_files import GrantFiles
from fractus_services.mobility.rpc.flight_metrics import flight_metrics
from fractus_services.service_metrics import MAX_POLICIES, ServiceMetrics, common_metrics
from mobility_world import World, spec
from prometheus_client import Metric
from scraping import assert_documented, values
from virtual_time import fly


def text(collect: Callable[[], Iterable[Metric]]) -> str:
    return metrics_text(collect()).decode()


def entry(kind: str, action: str, *policies: str, **more: str) -> dict[str, Any]:
    return {"time": "", "kind": kind, "action": action, "code": "Code", "policies": list(policies), **more}


def test_decision_metrics_count_entries_of_the_audit_log() -> None:
    decisions = ServiceMetrics()
    for each in (
        entry("call", "allow"),
        entry("call", "correct", "fence"),
        entry("call", "deny", "fence", "campus"),
        entry("check", "deny", "fence"),
        entry("takeover", "hover", controller="system"),
        entry("monitor", "deny", "fence"),
        {"time": "", "kind": "state", "lat": 1.0},
    ):
        decisions.take_entry(each)
    samples = values(text(decisions.collect))
    assert {key: value for key, value in samples.items() if key[0] == "fractus_verdicts_total"} == {
        ("fractus_verdicts_total", action, "Code"): 1.0 for action in ("allow", "correct", "deny")
    }
    assert samples["fractus_policy_verdicts_total", "correct", "fence"] == 1.0
    assert samples["fractus_policy_verdicts_total", "deny", "fence"] == 1.0
    assert samples["fractus_policy_verdicts_total", "deny", "campus"] == 1.0
    assert samples["fractus_takeovers_total", "Code", "system"] == 1.0
    assert samples["fractus_monitor_interventions_total", "deny", "Code"] == 1.0


def test_decision_metrics_limit_the_number_of_policy_labels() -> None:
    decisions = ServiceMetrics()
    for number in range(MAX_POLICIES + 10):
        decisions.take_entry(entry("call", "deny", f"policy-{number}"))
    samples = values(text(decisions.collect))
    assert samples["fractus_policy_verdicts_total", "deny", "other"] == 10.0
    assert len([key for key in samples if key[0] == "fractus_policy_verdicts_total"]) == MAX_POLICIES + 1


def test_mobility_service_metrics_equal_their_documentation(tmp_path: Path) -> None:
    metrics = ServiceMetrics()
    audit = AuditLog(tmp_path / "audit.jsonl", lambda: 1_780_000_000.0, listeners=(metrics.take_entry,))
    grants = cast(GrantFiles, SimpleNamespace(active={"a": None, "b": None}))
    problem = [""]
    metrics.add_callback(lambda: common_metrics(lambda: 2e9, grants, audit, lambda: problem[0]))
    for kind in ("call", "takeover", "monitor"):
        audit.append(kind, {"action": "deny", "code": "Code", "policies": ["p"], "controller": "system"})
    asyncio.run(audit.close())
    scrapes = []

    async def flight() -> None:
        async with World(tmp_path) as world:
            scrapes.append(text(lambda: flight_metrics(world.control, world.supervisor)))
            await world.up(world.grants.put(spec()))
            scrapes.append(text(lambda: flight_metrics(world.control, world.supervisor)))

    fly(flight)
    on_ground = values(scrapes[0])
    assert on_ground["fractus_in_air",] == 0
    assert on_ground["fractus_control_authority", "system"] == 1
    whole = text(metrics.collect) + scrapes[1]
    assert_documented(whole, "Mobility and camera", "Mobility")
    samples = values(whole)
    assert samples["fractus_audit_sequence",] == 3
    last = json.loads((tmp_path / "audit.jsonl").read_text().splitlines()[-1])
    assert f"{int(samples['fractus_audit_head',]):013x}" == last["hash"][:13]
    assert (
        samples["fractus_audit_waiting",]
        == samples["fractus_audit_failing",]
        == samples["fractus_recording_failing",]
        == 0
    )
    assert samples["fractus_grants",] == 2
    assert (
        samples["fractus_in_air",] == samples["fractus_companion_alive",] == samples["fractus_failsafes_verified",] == 1
    )
    assert samples["fractus_control_authority", "driver"] == 1
    assert 0 <= samples["fractus_telemetry_age_seconds",] < 1
    assert 0 <= samples["fractus_autopilot_heartbeat_age_seconds",] < 3
    problem[0] = "the disk is full"
    assert values(text(metrics.collect))["fractus_recording_failing",] == 1


def test_agent_metrics_equal_their_documentation() -> None:
    agent = AgentMetrics(
        expires_s=2e9,
        watch_ages_s={"grants": 3.0},
        report_age_s=math.inf,
        telemetry_age_s=0.5,
        grants={"stored": 2, "unverified": 0},
        checkpoints={"mobility": (7, "fedcba9876543210" * 4)},
    )
    scrape = text(agent.collect)
    assert_documented(scrape, "Agent")
    samples = values(scrape)
    assert samples["fractus_agent_report_age_seconds",] == math.inf
    assert samples["fractus_agent_watch_age_seconds", "grants"] == 3.0
    assert samples["fractus_audit_checkpoint_sequence", "mobility"] == 7.0
    assert samples["fractus_audit_checkpoint_head", "mobility"] == 0xFEDCBA9876543


def test_link_metrics_equal_their_documentation() -> None:
    offers = PathMetrics(8.0, 8.0, 5.0, 5.0, direct=True)
    peer = Peer("e1", (0.0, 0.0, 0.0), 50.0, offers)
    service = Endpoint(IPv4Address("10.96.0.5"), 8080)
    report = DroneLinkReport(
        links=(), link=NO_LINK, actions=cast(LinkActions, None), direct=frozenset({service}), measured=None, ranges={}, unknown={},
        cloud=None, expected={peer: offers}, rates={service: ServiceRate(1.5, 0.5)},
    )  # fmt: skip
    metrics = LinkMetrics()
    metrics.update(report)
    scrape = text(metrics.collect)
    assert_documented(scrape, "Direct links of a drone")
    samples = values(scrape)
    assert samples["fractus_switches_total",] == samples["fractus_traffic_direct",] == 1
    assert samples["fractus_path_bandwidth_mbps", "cloud"] == 0
    assert samples["fractus_path_bandwidth_mbps", "e1"] == 8.0
