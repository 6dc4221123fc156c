"""What a drone's end of direct links does next, and what it learns; without radios, clocks or threads."""

from __future__ import annotations

from dataclasses import replace
from ipaddress import IPv4Address

import pytest
from fractus_agent.links.decisions import Actions, Situation, Traffic, decide
from fractus_agent.links.evidence import records
from fractus_agent.links.lessons import Lessons
from fractus_agent.redirector.nft import Endpoint
from fractus_core.linking import NO_LINK, Link, PathMetrics, Peer, Phase, Reach, Settings, Track, heuristic
from fractus_core.linking.learning import retry_s

CLOUD = PathMetrics(8.0, 8.0, 60.0, 60.0)
WIFI = PathMetrics(12.0, 12.0, 5.0, 5.0, direct=True)
SETTINGS = Settings()
VIP, OTHER_VIP = Endpoint(IPv4Address("10.96.0.5"), 80), Endpoint(IPv4Address("10.96.0.6"), 80)
ROUTE = Endpoint(IPv4Address("169.254.7.7"), 30_000)
NEAR = Peer("e1", (10.0, 0.0, 0.0), 80.0, WIFI)
NOW_S = 1000.0
HEARD = {"e1": Reach(heard_s=NOW_S - 0.1)}
UP = Link(Phase.UP, "e1", NOW_S - 60.0)
TRAFFIC = Traffic("ns/app", heuristic("max", "ingress-bandwidth"), (NEAR,), frozenset({VIP}))
HERE = Track((0.0, 0.0, 0.0))

LINKED = Situation(NOW_S, HERE, (TRAFFIC,), UP, HEARD, CLOUD, WIFI, {VIP: ROUTE})
DIRECT = replace(LINKED, redirects={VIP: ROUTE})


def done(now: Situation) -> Actions:
    return decide(now, SETTINGS)


def test_a_peer_that_is_near_and_heard_is_linked_to() -> None:
    found = done(Situation(NOW_S, HERE, (TRAFFIC,), NO_LINK, HEARD, CLOUD))
    assert (found.peer, found.link.changes, found.planned, found.abrupt) == ("e1", True, {}, {})


@pytest.mark.parametrize("ago_s", [2.5, float("inf")])
def test_a_peer_that_is_not_heard_is_not_tried(ago_s: float) -> None:
    reaches = {"e1": Reach(heard_s=NOW_S - ago_s)}
    found = done(Situation(NOW_S, HERE, (TRAFFIC,), NO_LINK, reaches, CLOUD))
    assert (found.peer, found.link.changes, found.link.code) == ("", False, "CloudOnly")


def test_a_peer_that_is_heard_is_taken_where_a_better_one_is_silent() -> None:
    better = Peer("e2", (5.0, 0.0, 0.0), 80.0, replace(WIFI, ingress_mbps=20.0))
    traffic = replace(TRAFFIC, peers=(better, NEAR))
    assert done(Situation(NOW_S, HERE, (traffic,), NO_LINK, HEARD, CLOUD)).peer == "e1"
    both = HEARD | {"e2": Reach(heard_s=NOW_S)}
    assert done(Situation(NOW_S, HERE, (traffic,), NO_LINK, both, CLOUD)).peer == "e2"


def test_traffic_moves_once_the_link_is_measured_and_serves() -> None:
    assert done(replace(LINKED, direct=None)).planned == {}
    unserved = done(replace(LINKED, routes={}))
    assert (unserved.planned, unserved.targets["ns/app"].code) == ({}, "NotServed")
    found = done(LINKED)
    assert (found.planned, found.abrupt, found.targets["ns/app"].code) == ({VIP: ROUTE}, {}, "BetterPath")
    assert done(DIRECT).planned == done(DIRECT).abrupt == {}


def test_a_slow_link_carries_nothing() -> None:
    assert done(replace(LINKED, direct=replace(WIFI, ingress_mbps=3.0))).planned == {}
    back = done(replace(DIRECT, direct=replace(WIFI, ingress_mbps=3.0)))
    assert (back.planned, back.abrupt) == ({VIP: None}, {})


def test_a_link_that_is_lost_is_left_at_once() -> None:
    found = done(replace(DIRECT, link=NO_LINK, direct=None, routes={}))
    assert (found.abrupt, found.planned) == ({VIP: None}, {})


def test_a_link_is_left_before_its_reach_ends() -> None:
    leaving = Track((-69.0, 0.0, 0.0), velocity_mps=(-3.0, 0.0, 0.0))
    found = done(replace(DIRECT, track=leaving))
    assert (found.planned, found.targets["ns/app"].code) == ({VIP: None}, "LeavingLink")


def test_traffic_is_led_back_before_another_peer_is_linked_to() -> None:
    far, better = replace(NEAR, position=(-75.0, 0.0, 0.0)), Peer("e2", (60.0, 0.0, 0.0), 80.0, WIFI)
    flight = Track((3.0, 0.0, 0.0), 3.0, ((300.0, 0.0, 0.0),))
    reaches = HEARD | {"e2": Reach(heard_s=NOW_S)}
    found = done(replace(DIRECT, track=flight, traffic=(replace(TRAFFIC, peers=(far, better)),), reaches=reaches))
    assert (found.peer, found.link.changes) == ("e2", True)
    assert (found.planned, found.abrupt) == ({VIP: None}, {})


def test_without_a_position_the_link_stays_as_it_is() -> None:
    found = done(replace(DIRECT, track=None))
    assert (found.peer, found.link.changes, found.link.code) == ("e1", False, "PositionUnknown")
    assert found.planned == found.abrupt == {}


def test_links_that_are_planned_no_more_end() -> None:
    found = done(replace(DIRECT, traffic=()))
    assert (found.peer, found.link.changes, found.planned) == ("", True, {VIP: None})


def test_each_application_takes_its_own_path() -> None:
    quick = Traffic("ns/quick", heuristic("min", "ingress-latency"), (NEAR,), frozenset({OTHER_VIP}))
    other = replace(ROUTE, port=30_001)
    slow = replace(WIFI, ingress_mbps=3.0)
    found = done(replace(LINKED, traffic=(TRAFFIC, quick), routes={VIP: ROUTE, OTHER_VIP: other}, direct=slow))
    assert found.planned == {OTHER_VIP: other}


def test_a_pod_that_moves_is_followed_and_one_that_goes_is_left() -> None:
    moved = replace(ROUTE, port=30_002)
    assert done(replace(DIRECT, routes={VIP: moved})).abrupt == {VIP: moved}
    assert done(replace(DIRECT, routes={})).abrupt == {VIP: None}


SILENT = {"cloud": None}


@pytest.mark.parametrize(
    "heuristic_of", [("max", "ingress-bandwidth"), ("min", "ingress-latency"), ("preferDirect", None)]
)
def test_a_cloud_path_that_does_not_answer_is_no_target(heuristic_of: tuple[str, str | None]) -> None:
    traffic = replace(TRAFFIC, heuristic=heuristic(*heuristic_of))
    worse = replace(WIFI, ingress_mbps=0.1, egress_mbps=0.1, ingress_latency_ms=500.0)
    linked = replace(LINKED, traffic=(traffic,), direct=worse, **SILENT)
    found = done(linked)
    # Its connections hang: they are closed, not drained.
    assert (found.abrupt, found.planned, found.targets["ns/app"].code) == ({VIP: ROUTE}, {}, "CloudSilent")
    kept = done(replace(linked, redirects={VIP: ROUTE}))
    assert kept.abrupt == kept.planned == {}
    # Once it answers, traffic goes back to it as from any slower path.
    back = done(replace(linked, redirects={VIP: ROUTE}, cloud=CLOUD))
    assert back.planned == ({} if heuristic_of[0] == "preferDirect" else {VIP: None})


def test_without_a_cloud_path_a_slow_link_is_made_and_kept_to_its_end() -> None:
    slow = replace(TRAFFIC, peers=(replace(NEAR, offers=replace(WIFI, ingress_mbps=0.5)),))
    alone = Situation(NOW_S, HERE, (slow,), NO_LINK, HEARD, CLOUD)
    assert done(alone).peer == ""
    assert done(replace(alone, **SILENT)).peer == "e1"
    for east in (-69.0, -75.0):  # about to leave the declared reach, and beyond it
        leaving = replace(DIRECT, track=Track((east, 0.0, 0.0), velocity_mps=(-3.0, 0.0, 0.0)), **SILENT)
        found = done(leaving)
        assert (found.peer, found.planned, found.abrupt) == ("e1", {}, {})
        assert not done(replace(leaving, redirects={})).abrupt, "nothing is led onto a link that is about to end"


def test_where_nothing_answers_traffic_waits_for_the_cloud_path() -> None:
    found = done(replace(DIRECT, link=NO_LINK, direct=None, routes={}, **SILENT))
    assert (found.abrupt, found.planned) == ({VIP: None}, {})


# Lessons


def lessons(distance_m: float, **reach: float) -> Lessons:
    found = Lessons(SETTINGS, here=(0.0, 0.0, 0.0), peers={"e1": replace(NEAR, position=(distance_m, 0.0, 0.0))})
    if reach:
        found.reaches["e1"] = Reach(**reach)
    return found


def test_a_peer_whose_link_works_afar_reaches_further_and_a_beacon_says_nothing_of_it() -> None:
    found = lessons(96.0)
    found.beacon("e1", NOW_S)
    assert found.reaches["e1"] == Reach(heard_s=NOW_S)
    found.delivered("e1", WIFI)
    assert found.reaches["e1"].range_factor == pytest.approx(1.2 * 1.02)


def test_a_beacon_gives_back_what_a_peer_declares_and_no_more() -> None:
    found = lessons(96.0, range_factor=1.4)
    found.broke("e1", NOW_S)
    found.beacon("e1", NOW_S + 1.0)
    assert found.reaches["e1"].range_factor == pytest.approx(1.2 / 1.02)
    near = lessons(72.0, range_factor=1.4)
    near.broke("e1", NOW_S)
    near.beacon("e1", NOW_S + 1.0)
    assert near.reaches["e1"].range_factor == 1.0


def test_peers_that_are_not_planned_are_forgotten() -> None:
    found = lessons(64.0)
    for name in ("e1", "e2"):
        found.came_up(name, NOW_S)
    found.keep({"e2"})
    assert set(found.reaches) == {"e2"}


def test_links_that_break_near_say_nothing_of_the_reach() -> None:
    near, far = lessons(10.0), lessons(64.0)
    near.broke("e1", NOW_S)
    assert (near.reaches["e1"].range_factor, near.reaches["e1"].failures) == (1.0, 1)
    far.broke("e1", NOW_S)
    assert far.reaches["e1"].range_factor == pytest.approx(0.8 / 1.02)


def test_a_link_that_broke_where_its_peer_is_still_heard_did_not_break_for_the_distance() -> None:
    found = lessons(64.0)
    found.broke("e1", NOW_S)
    assert found.reaches["e1"].failed_s == NOW_S
    found.peers = {"e1": replace(NEAR, position=(50.0, 0.0, 0.0))}
    found.beacon("e1", NOW_S + 0.5)
    assert found.reaches["e1"].range_factor == pytest.approx(0.8 / 1.02)
    found.peers = {"e1": replace(NEAR, position=(64.0, 0.0, 0.0))}
    found.beacon("e1", NOW_S + 1.0)
    assert found.reaches["e1"].range_factor == 1.0


def test_rates_are_learned_well_inside_the_reach_only() -> None:
    inside, edge = lessons(10.0), lessons(79.0)
    for found in (inside, edge):
        found.delivered("e1", replace(WIFI, ingress_mbps=6.0))
    assert inside.reaches["e1"].rate_factor < 1.0
    assert "e1" not in edge.reaches


def test_attempts_that_fail_are_repeated_later_and_later() -> None:
    found = lessons(10.0)
    found.not_paired("e1", NOW_S)
    found.not_paired("e1", NOW_S)
    assert retry_s(found.reaches["e1"], linked=False) == NOW_S + 2.0
    found.came_up("e1", NOW_S)
    assert found.reaches["e1"].failures == 0


def test_the_audit_log_keeps_what_a_decision_was_made_of() -> None:
    joining = Situation(NOW_S, HERE, (TRAFFIC,), NO_LINK, HEARD, CLOUD)
    ((kind, choice),) = records(done(joining), joining)
    assert kind == "choice"
    assert choice == {
        "peer": "e1", "code": "Connect", "reason": "e1, 10 m away, offers more than the cloud path", "position": [0, 0, 0],
    }  # fmt: skip
    ((kind, moved),) = records(done(LINKED), LINKED)
    assert (kind, moved["application"], moved["path"], moved["code"]) == ("traffic", "ns/app", "e1", "BetterPath")
    assert (moved["cloud"]["ingress_mbps"], moved["direct"]["ingress_mbps"]) == (8.0, 12.0)
    gone = replace(DIRECT, link=NO_LINK, direct=None, routes={})
    ((_, back),) = [found for found in records(done(gone), gone) if found[0] == "traffic"]
    assert (back["path"], back["code"], back["direct"]) == ("cloud", "NoDirectLink", None)


def test_a_decision_that_changes_nothing_is_not_kept() -> None:
    assert not list(records(done(DIRECT), DIRECT))
