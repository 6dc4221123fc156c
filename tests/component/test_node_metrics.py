"""What the workloads of a node tell Prometheus: the figures that docs/metrics.md names, and the right ones."""

from __future__ import annotations

import asyncio
import json
import math
from ipaddress import IPv4Address
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from exposed import assert_documented, values
from fractus_agent.agent_metrics import AgentMetrics
from fractus_agent.links.decisions import LinkActions
from fractus_agent.links.link_metrics import LinkMetrics
from fractus_agent.links.link_status import DroneLinkReport
from fractus_agent.links.traffic_rates import ServiceRate
from fractus_agent.redirector.nft_maps import Endpoint
from fractus_core.linking import NO_LINK, PathMetrics, Peer
from fractus_runtime.audit import AuditLog
from fractus_runtime.figures import text_of
from fractus_services.grant_files import GrantFiles
from fractus_services.metrics import MAX_POLICIES, DecisionMetrics, ServiceMetrics, common_figures
from fractus_services.mobility.rpc.flight_metrics import flight_figures
from mobility_world import World, spec
from virtual_time import fly


def text(*figures: Any) -> str:
    return text_of(figure for each in figures for figure in each()).decode()


def entry(kind: str, action: str, *policies: str, **more: str) -> dict[str, Any]:
    return {"time": "", "kind": kind, "action": action, "code": "Code", "policies": list(policies), **more}


def test_decisions_are_counted_as_the_audit_log_has_them() -> None:
    counted = DecisionMetrics()
    for each in (
        entry("call", "allow"),
        entry("call", "correct", "fence"),
        entry("call", "deny", "fence", "campus"),
        entry("check", "deny", "fence"),
        entry("takeover", "hover", controller="system"),
        entry("monitor", "deny", "fence"),
        {"time": "", "kind": "state", "lat": 1.0},
    ):
        counted.take_entry(each)
    seen = values(text(counted.figures))
    assert {key: value for key, value in seen.items() if key[0] == "fractus_verdicts_total"} == {
        ("fractus_verdicts_total", action, "Code"): 1.0 for action in ("allow", "correct", "deny")
    }
    assert seen["fractus_policy_verdicts_total", "correct", "fence"] == 1.0
    assert seen["fractus_policy_verdicts_total", "deny", "fence"] == 1.0
    assert seen["fractus_policy_verdicts_total", "deny", "campus"] == 1.0
    assert seen["fractus_takeovers_total", "Code", "system"] == 1.0
    assert seen["fractus_monitor_interventions_total", "deny", "Code"] == 1.0


def test_policies_without_number_do_not_fill_the_memory() -> None:
    counted = DecisionMetrics()
    for number in range(MAX_POLICIES + 10):
        counted.take_entry(entry("call", "deny", f"policy-{number}"))
    seen = values(text(counted.figures))
    assert seen["fractus_policy_verdicts_total", "deny", "other"] == 10.0
    assert len([key for key in seen if key[0] == "fractus_policy_verdicts_total"]) == MAX_POLICIES + 1


def test_the_mobility_service_tells_what_is_documented(tmp_path: Path) -> None:
    metrics = ServiceMetrics()
    audit = AuditLog(tmp_path / "audit.jsonl", lambda: 1_780_000_000.0, copied=metrics.take_entry)
    grants = cast(GrantFiles, SimpleNamespace(active={"a": None, "b": None}))
    problem = [""]
    metrics.observe(lambda: common_figures(lambda: 2e9, grants, audit, lambda: problem[0]))
    for kind in ("call", "takeover", "monitor"):
        audit.append(kind, {"action": "deny", "code": "Code", "policies": ["p"], "controller": "system"})
    asyncio.run(audit.close())
    told = []

    async def flight() -> None:
        async with World(tmp_path) as world:
            told.append(text(lambda: flight_figures(world.control, world.supervisor)))
            await world.up(world.grants.put(spec()))
            told.append(text(lambda: flight_figures(world.control, world.supervisor)))

    fly(flight)
    on_ground = values(told[0])
    assert on_ground["fractus_in_air",] == 0
    assert on_ground["fractus_control_authority", "system"] == 1
    whole = metrics.text().decode() + told[1]
    assert_documented(whole, "Mobility and camera", "Mobility")
    seen = values(whole)
    assert seen["fractus_audit_sequence",] == 3
    last = json.loads((tmp_path / "audit.jsonl").read_text().splitlines()[-1])
    assert f"{int(seen['fractus_audit_head',]):013x}" == last["hash"][:13]
    assert seen["fractus_audit_waiting",] == seen["fractus_audit_failing",] == seen["fractus_recording_failing",] == 0
    assert seen["fractus_grants",] == 2
    assert seen["fractus_in_air",] == seen["fractus_companion_alive",] == seen["fractus_failsafes_verified",] == 1
    assert seen["fractus_control_authority", "driver"] == 1
    assert 0 <= seen["fractus_telemetry_age_seconds",] < 1
    assert 0 <= seen["fractus_autopilot_heartbeat_age_seconds",] < 3
    problem[0] = "the disk is full"
    assert values(metrics.text().decode())["fractus_recording_failing",] == 1


def test_the_agent_tells_what_is_documented() -> None:
    figures = AgentMetrics(
        expires_s=2e9,
        watch_ages_s={"grants": 3.0},
        report_age_s=math.inf,
        telemetry_age_s=0.5,
        grants={"stored": 2, "unverified": 0},
        checkpoints={"mobility": (7, "fedcba9876543210" * 4)},
    )
    told = text(figures.metrics)
    assert_documented(told, "Agent")
    seen = values(told)
    assert seen["fractus_agent_report_age_seconds",] == math.inf
    assert seen["fractus_agent_watch_age_seconds", "grants"] == 3.0
    assert seen["fractus_audit_checkpoint_sequence", "mobility"] == 7.0
    assert seen["fractus_audit_checkpoint_head", "mobility"] == 0xFEDCBA9876543


def test_the_drones_links_tell_what_is_documented() -> None:
    offers = PathMetrics(8.0, 8.0, 5.0, 5.0, direct=True)
    peer = Peer("e1", (0.0, 0.0, 0.0), 50.0, offers)
    service = Endpoint(IPv4Address("10.96.0.5"), 8080)
    report = DroneLinkReport(
        links=(), link=NO_LINK, actions=cast(LinkActions, None), direct=frozenset({service}), measured=None, ranges={}, unknown={},
        cloud=None, expected={peer: offers}, rates={service: ServiceRate(1.5, 0.5)},
    )  # fmt: skip
    metrics = LinkMetrics()
    metrics.update(report)
    told = text(metrics.collect)
    assert_documented(told, "Direct links of a drone")
    seen = values(told)
    assert seen["fractus_switches_total",] == seen["fractus_traffic_direct",] == 1
    assert seen["fractus_path_bandwidth_mbps", "cloud"] == 0
    assert seen["fractus_path_bandwidth_mbps", "e1"] == 8.0
