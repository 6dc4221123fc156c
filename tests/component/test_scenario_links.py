"""The links scenario: site, evidence from logs, and report."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from fractus_sim.scenarios.links.link_rules import constant_speed_flight
from fractus_sim.scenarios.links.links_evidence import (
    AGENT,
    CHECKER,
    VIEWER,
    Evidence,
    LogLine,
    PodLogFollower,
    parse_log_line,
    read_evidence,
)
from fractus_sim.scenarios.links.links_report import write_links_report
from fractus_sim.scenarios.links.links_results import evaluate_run, gains
from fractus_sim.scenarios.links.links_site import DRONE, Site, read_site

BEGIN_S = 1_000_000.0


@pytest.fixture(scope="module")
def site() -> Site:
    return read_site()


def flight(site: Site) -> list[tuple[float, tuple[float, float, float]]]:
    positions, _ = constant_speed_flight(site.path, 3.0)
    return [(BEGIN_S + 0.1 * step, position) for step, position in enumerate(positions)]


def agent(at_s: float, text: str) -> LogLine:
    return LogLine(BEGIN_S + at_s, DRONE, AGENT, f"2026-11-22 INFO fractus_agent.links: {text}")


def picture(number: int, at_s: float, *nodes: str, delay_s: float = 0.2, answered: bool = True) -> list[LogLine]:
    sent = {"event": "sent", "picture": number, "at": BEGIN_S + at_s, "bytes": 100_000}
    lines = [LogLine(BEGIN_S + at_s, DRONE, VIEWER, json.dumps(sent))]
    for node in nodes:
        received = {"event": "received", "picture": number, "at": BEGIN_S + at_s + delay_s, "by": node, "attempt": 1}
        lines.append(LogLine(BEGIN_S + at_s + delay_s, node, CHECKER, json.dumps(received)))
    if answered:
        response = {
            "event": "answered",
            "picture": number,
            "at": BEGIN_S + at_s + 2 * delay_s,
            "by": nodes[-1],
            "took_s": 0.4,
        }
        lines.append(LogLine(BEGIN_S + at_s + 2 * delay_s, DRONE, VIEWER, json.dumps(response)))
    return lines


def run_of(site: Site, *more: LogLine) -> Evidence:
    """Return a run whose pictures go to edge-1 between 10 s and 25 s, and to the cloud at other times."""
    links = [
        agent(8.0, "links: decided (on=link peer=edge-1): Connect: edge-1, 60 m away, offers more than the cloud path"),
        agent(8.1, "links: connecting (peer=edge-1 reason=wanted)"),
        agent(8.9, "links: up (peer=edge-1 reason=paired)"),
        agent(9.2, "links: measured (peer=edge-1 mbps=11.8 latency_ms=1.9)"),
        agent(
            9.3,
            "links: decided (on=default/links peer=edge-1): BetterPath: the direct link scores 11.8, the present path 8",
        ),
        agent(25.0, "links: decided (on=default/links peer=edge-1): Leaving: the drone leaves its reach"),
        agent(26.0, "links: none (peer=edge-1 reason=no peer is selected)"),
    ]
    pictures = [line for n in range(1, 41) for line in picture(n, n - 1.0, "edge-1" if 10 <= n - 1 < 25 else "cloud-1")]
    return read_evidence([*links, *pictures, *more], flight(site), DRONE)


def test_site_is_read_from_the_example(site: Site) -> None:
    assert [peer.name for peer in site.peers] == ["edge-1", "edge-3", "edge-4", "edge-5", "edge-6"]
    assert len(site.edges) == 6
    assert [round(x) for x, _, _ in site.path] == [0, 240, 240]
    near = {peer.name: min(math.dist(peer.position, at) for _, at in flight(site)) for peer in site.peers}
    assert near.pop("edge-5") > 80.0
    assert all(distance < 80.0 for distance in near.values())


def test_site_scales_the_actual_radio_range_by_the_factor() -> None:
    short = read_site(0.8)
    assert {peer.range_m for peer in short.peers} == {80.0}
    assert [node.wifi() for node in short.cluster.nodes if node.name == "edge-1"] == [("wlan0", 64.0)]


def test_link_use_contains_all_events_from_the_decision_to_the_end(site: Site) -> None:
    (use,) = run_of(site).link_uses
    times = (use.decided_s, use.up_s, use.measured_s, use.redirected_s, use.first_s, use.back_s)
    assert [round((at or 0) - BEGIN_S, 1) for at in times] == [8.0, 8.9, 9.2, 9.3, 10.2, 25.0]
    assert (use.mbps, use.left) == (11.8, "Leaving: the drone leaves its reach")
    assert use.ended_s == BEGIN_S + 26.0


def test_link_use_has_several_traffic_spans_and_a_loss(site: Site) -> None:
    first, second = read_evidence(
        [
            agent(0.0, "links: connecting (peer=edge-1 reason=pairing)"),
            agent(0.1, "links: up (peer=edge-1 reason=paired)"),
            agent(1.0, "links: decided (on=default/links peer=edge-1): BetterPath: the direct link scores 12, the present path 8"),
            agent(5.0, "links: decided (on=default/links peer=edge-1): BetterPath: the cloud path scores 8, the present path 2"),
            agent(7.0, "links: decided (on=default/links peer=edge-1): BetterPath: the direct link scores 12, the present path 8"),
            agent(9.0, "links: decided (on=link peer=edge-3): BetterPeer: edge-3, 60 m away, is better than edge-1 from here on"),
            agent(9.1, "links: none (peer=edge-1 reason=edge-1 has been silent for 0.6 s)"),
            agent(9.2, "links: connecting (peer=edge-3 reason=pairing)"),
            agent(9.9, "links: up (peer=edge-3 reason=paired)"),
            *picture(1, 8.0, "edge-1"), *picture(2, 10.0, "cloud-1"), *picture(3, 11.0, "cloud-1"),
        ],
        flight(site),
        DRONE,
    ).link_uses  # fmt: skip
    spans = [(begin - BEGIN_S, (end or 0.0) - BEGIN_S) for begin, end in first.spans]
    assert spans == [pytest.approx((1.0, 5.0)), pytest.approx((7.0, 9.1))]
    assert (first.lost, first.peer, second.peer, second.spans) == (True, "edge-1", "edge-3", [])
    assert (second.decided_s - BEGIN_S, (second.up_s or 0.0) - BEGIN_S) == (pytest.approx(9.0), pytest.approx(9.9))


def test_link_loss_is_recognised_by_a_traffic_decision_before_the_end_of_the_link(site: Site) -> None:
    lost = [
        agent(30.0, "links: up (peer=edge-3 reason=paired)"),
        agent(30.1, "links: decided (on=default/links peer=edge-3): BetterPath: the direct link scores 12, the present path 8"),
        agent(42.0, "links: decided (on=default/links peer=edge-3): NoDirectLink: there is no direct link"),
        agent(42.1, "links: none (peer=edge-3 reason=edge-3 has been silent for 0.6 s)"),
    ]  # fmt: skip
    run = run_of(
        site, agent(29.9, "links: connecting (peer=edge-3 reason=pairing)"), *lost, *picture(41, 42.5, "cloud-1")
    )
    assert [use.lost for use in run.link_uses] == [False, True]
    assert (run.gap_s(abrupt=False), run.gap_s(abrupt=True)) == (pytest.approx(1.0), pytest.approx(3.5))


def test_gaps_at_a_link_loss_are_separate_from_other_gaps(site: Site) -> None:
    run = run_of(site, *picture(41, 42.0, "cloud-1"))
    assert (run.gap_s(abrupt=False), run.gap_s(abrupt=True)) == (pytest.approx(3.0), 0.0)
    (use,) = run.link_uses
    use.lost = True
    use.ended_s = BEGIN_S + 40.5
    assert (run.gap_s(abrupt=False), run.gap_s(abrupt=True)) == (pytest.approx(1.0), pytest.approx(3.0))


def test_pictures_are_counted_by_delivery(site: Site) -> None:
    lost = picture(41, 40.0, answered=False)
    twice = picture(42, 41.0, "edge-1", "edge-1")
    two_instances = picture(43, 42.0, "edge-1", "cloud-1")
    counts = run_of(site, *lost, *twice, *two_instances).counts()
    assert counts == {"sent": 43, "received": 42, "lost": 1, "doubled": 1, "repeated_elsewhere": 1, "late": 1}
    assert run_of(site, *lost, *twice).longest_gap_s == pytest.approx(2.0)
    assert run_of(site).by_node() == {"cloud-1": 25, "edge-1": 15}


def test_gain_is_given_as_share_of_the_maximum(site: Site) -> None:
    table = {gain.name: gain for gain in gains(site, run_of(site))}
    assert table["maximum"].share == 1.0
    assert 0.3 < table["flown"].share < 0.6
    assert table["rule of Fractus, modelled"].share >= table["rule of the thesis, modelled"].share
    assert table["flown"].gain_mbit == pytest.approx((25.0 - 9.3) * 4.0, abs=1.0)


def test_failed_expectations_are_listed(site: Site) -> None:
    run = run_of(site, *picture(41, 40.0, answered=False))
    failed = [e.text for e in evaluate_run(run, gains(site, run)) if not e.holds]
    assert "no picture is lost" in failed
    assert any("maximum possible gain" in text for text in failed)


def test_links_report_is_written(site: Site, tmp_path: Path) -> None:
    run = run_of(site)
    expectations = write_links_report(site, run, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"summary.md", "report.json", "map.png", "bandwidth.png"}
    results = json.loads((tmp_path / "report.json").read_text())
    assert results["switches"][0]["spans"] == [[9.3, 25.0]]
    assert len(results["checks"]) == len(expectations)
    page = (tmp_path / "summary.md").read_text()
    assert "| edge-1 | 8.00 | 8.90 | 9.20 | 11.8 | 9.30 | 10.20 | 25.00 | 26.00 |" in page


def test_pod_logs_are_kept_after_the_pod_is_deleted(tmp_path: Path) -> None:
    folder = tmp_path / "var-log" / "pods" / "default_viewer-1_uid" / VIEWER
    folder.mkdir(parents=True)
    log = folder / "0.log"
    log.write_text("2026-11-22T16:00:01.5+00:00 stdout F one\n2026-11-22T16:00:02+00:00 stdout F tw")
    logs = PodLogFollower({"drone-1": tmp_path}, {VIEWER})
    logs.read_new_lines()
    with log.open("a") as file:
        file.write("o\n")
        log.unlink()
    logs.start()
    assert [(line.text, line.node, line.container) for line in logs.close()] == [
        ("one", "drone-1", VIEWER),
        ("two", "drone-1", VIEWER),
    ]
    assert parse_log_line(b"nothing", "n", "c") is None
    assert parse_log_line(b"yesterday stdout F x", "n", "c") is None
