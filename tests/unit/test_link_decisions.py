"""Decisions and range model of the drone's link controller. The tests need no radio, clock or thread."""

from __future__ import annotations

from dataclasses import replace
from ipaddress import IPv4Address

import pytest
from fractus_agent.links.audit_records import decision_records
from fractus_agent.links.decisions import ApplicationTraffic, LinkActions, LinkSituation, decide
from fractus_agent.redirector.nft_maps import Endpoint
from fractus_core.linking import (
    NO_LINK,
    LearnedRange,
    LinkPhase,
    LinkSettings,
    LinkState,
    PathMetrics,
    Peer,
    Track,
    find_heuristic,
)
from fractus_core.linking.range_model import RangeModel, next_attempt_s

CLOUD = PathMetrics(8.0, 8.0, 60.0, 60.0)
WIFI = PathMetrics(12.0, 12.0, 5.0, 5.0, direct=True)
SETTINGS = LinkSettings()
VIP = Endpoint(IPv4Address("10.96.0.5"), 80)
OTHER_VIP = Endpoint(IPv4Address("10.96.0.6"), 80)
ROUTE = Endpoint(IPv4Address("169.254.7.7"), 30_000)
NEAR = Peer("e1", (10.0, 0.0, 0.0), 80.0, WIFI)
NOW_S = 1000.0
IN_CONTACT = {"e1": LearnedRange(last_beacon_s=NOW_S - 0.1)}
UP = LinkState(LinkPhase.UP, "e1", NOW_S - 60.0)
TRAFFIC = ApplicationTraffic("ns/app", find_heuristic("max", "ingress-bandwidth"), (NEAR,), frozenset({VIP}))
STANDING = Track((0.0, 0.0, 0.0))

LINKED = LinkSituation(NOW_S, STANDING, (TRAFFIC,), UP, IN_CONTACT, CLOUD, WIFI, {VIP: ROUTE})
DIRECT = replace(LINKED, redirects={VIP: ROUTE})


def actions(situation: LinkSituation) -> LinkActions:
    return decide(situation, SETTINGS)


def test_near_peer_with_beacons_is_linked() -> None:
    decided = actions(LinkSituation(NOW_S, STANDING, (TRAFFIC,), NO_LINK, IN_CONTACT, CLOUD))
    assert (decided.peer, decided.link.changes, decided.planned, decided.abrupt) == ("e1", True, {}, {})


@pytest.mark.parametrize("ago_s", [2.5, float("inf")])
def test_peer_without_recent_beacon_is_not_linked(ago_s: float) -> None:
    ranges = {"e1": LearnedRange(last_beacon_s=NOW_S - ago_s)}
    decided = actions(LinkSituation(NOW_S, STANDING, (TRAFFIC,), NO_LINK, ranges, CLOUD))
    assert (decided.peer, decided.link.changes, decided.link.code) == ("", False, "CloudOnly")


def test_peer_with_beacons_is_linked_if_a_better_peer_is_silent() -> None:
    better = Peer("e2", (5.0, 0.0, 0.0), 80.0, replace(WIFI, ingress_mbps=20.0))
    traffic = replace(TRAFFIC, peers=(better, NEAR))
    assert actions(LinkSituation(NOW_S, STANDING, (traffic,), NO_LINK, IN_CONTACT, CLOUD)).peer == "e1"
    both = IN_CONTACT | {"e2": LearnedRange(last_beacon_s=NOW_S)}
    assert actions(LinkSituation(NOW_S, STANDING, (traffic,), NO_LINK, both, CLOUD)).peer == "e2"


def test_traffic_moves_to_link_that_is_measured_and_has_routes() -> None:
    assert actions(replace(LINKED, direct=None)).planned == {}
    unserved = actions(replace(LINKED, routes={}))
    assert (unserved.planned, unserved.targets["ns/app"].code) == ({}, "NotServed")
    decided = actions(LINKED)
    assert (decided.planned, decided.abrupt, decided.targets["ns/app"].code) == ({VIP: ROUTE}, {}, "BetterPath")
    assert actions(DIRECT).planned == actions(DIRECT).abrupt == {}


def test_link_slower_than_the_cloud_path_carries_no_traffic() -> None:
    assert actions(replace(LINKED, direct=replace(WIFI, ingress_mbps=3.0))).planned == {}
    restored = actions(replace(DIRECT, direct=replace(WIFI, ingress_mbps=3.0)))
    assert (restored.planned, restored.abrupt) == ({VIP: None}, {})


def test_traffic_leaves_a_lost_link_without_drain() -> None:
    decided = actions(replace(DIRECT, link=NO_LINK, direct=None, routes={}))
    assert (decided.abrupt, decided.planned) == ({VIP: None}, {})


def test_traffic_leaves_the_link_before_its_range_ends() -> None:
    leaving = Track((-69.0, 0.0, 0.0), velocity_mps=(-3.0, 0.0, 0.0))
    decided = actions(replace(DIRECT, track=leaving))
    assert (decided.planned, decided.targets["ns/app"].code) == ({VIP: None}, "LeavingLink")


def test_traffic_moves_back_before_another_peer_is_linked() -> None:
    far = replace(NEAR, position=(-75.0, 0.0, 0.0))
    better = Peer("e2", (60.0, 0.0, 0.0), 80.0, WIFI)
    flight = Track((3.0, 0.0, 0.0), 3.0, ((300.0, 0.0, 0.0),))
    ranges = IN_CONTACT | {"e2": LearnedRange(last_beacon_s=NOW_S)}
    decided = actions(replace(DIRECT, track=flight, traffic=(replace(TRAFFIC, peers=(far, better)),), ranges=ranges))
    assert (decided.peer, decided.link.changes) == ("e2", True)
    assert (decided.planned, decided.abrupt) == ({VIP: None}, {})


def test_link_stays_unchanged_without_a_position() -> None:
    decided = actions(replace(DIRECT, track=None))
    assert (decided.peer, decided.link.changes, decided.link.code) == ("e1", False, "PositionUnknown")
    assert decided.planned == decided.abrupt == {}


def test_link_ends_if_it_is_no_longer_planned() -> None:
    decided = actions(replace(DIRECT, traffic=()))
    assert (decided.peer, decided.link.changes, decided.planned) == ("", True, {VIP: None})


def test_each_application_takes_its_own_path() -> None:
    quick = ApplicationTraffic("ns/quick", find_heuristic("min", "ingress-latency"), (NEAR,), frozenset({OTHER_VIP}))
    other = replace(ROUTE, port=30_001)
    slow = replace(WIFI, ingress_mbps=3.0)
    decided = actions(replace(LINKED, traffic=(TRAFFIC, quick), routes={VIP: ROUTE, OTHER_VIP: other}, direct=slow))
    assert decided.planned == {OTHER_VIP: other}


def test_traffic_follows_a_moved_pod_and_leaves_a_removed_pod() -> None:
    moved = replace(ROUTE, port=30_002)
    assert actions(replace(DIRECT, routes={VIP: moved})).abrupt == {VIP: moved}
    assert actions(replace(DIRECT, routes={})).abrupt == {VIP: None}


SILENT = {"cloud": None}


@pytest.mark.parametrize(
    "heuristic_of", [("max", "ingress-bandwidth"), ("min", "ingress-latency"), ("preferDirect", None)]
)
def test_traffic_leaves_an_unreachable_cloud_path(heuristic_of: tuple[str, str | None]) -> None:
    traffic = replace(TRAFFIC, heuristic=find_heuristic(*heuristic_of))
    worse = replace(WIFI, ingress_mbps=0.1, egress_mbps=0.1, ingress_latency_ms=500.0)
    linked = replace(LINKED, traffic=(traffic,), direct=worse, **SILENT)
    decided = actions(linked)
    # The connections on the unreachable cloud path hang, so traffic moves without a drain.
    assert (decided.abrupt, decided.planned, decided.targets["ns/app"].code) == ({VIP: ROUTE}, {}, "CloudSilent")
    unchanged = actions(replace(linked, redirects={VIP: ROUTE}))
    assert unchanged.abrupt == unchanged.planned == {}
    # When the cloud path is reachable again, traffic returns to it as from any slower path.
    restored = actions(replace(linked, redirects={VIP: ROUTE}, cloud=CLOUD))
    assert restored.planned == ({} if heuristic_of[0] == "preferDirect" else {VIP: None})


def test_slow_link_is_established_and_kept_without_a_cloud_path() -> None:
    slow = replace(TRAFFIC, peers=(replace(NEAR, offers=replace(WIFI, ingress_mbps=0.5)),))
    alone = LinkSituation(NOW_S, STANDING, (slow,), NO_LINK, IN_CONTACT, CLOUD)
    assert actions(alone).peer == ""
    assert actions(replace(alone, **SILENT)).peer == "e1"
    for east in (-69.0, -75.0):  # shortly before the end of the declared range, and beyond it
        leaving = replace(DIRECT, track=Track((east, 0.0, 0.0), velocity_mps=(-3.0, 0.0, 0.0)), **SILENT)
        decided = actions(leaving)
        assert (decided.peer, decided.planned, decided.abrupt) == ("e1", {}, {})
        assert not actions(replace(leaving, redirects={})).abrupt, "traffic must not move to a link that will soon end"


def test_traffic_waits_for_the_cloud_path_if_no_path_works() -> None:
    decided = actions(replace(DIRECT, link=NO_LINK, direct=None, routes={}, **SILENT))
    assert (decided.abrupt, decided.planned) == ({VIP: None}, {})


# Range model


def range_model(distance_m: float, **learned: float) -> RangeModel:
    model = RangeModel(SETTINGS, position=(0.0, 0.0, 0.0), peers={"e1": replace(NEAR, position=(distance_m, 0.0, 0.0))})
    if learned:
        model.ranges["e1"] = LearnedRange(**learned)
    return model


def test_range_grows_after_measurement_beyond_it_but_not_after_beacon() -> None:
    model = range_model(96.0)
    model.on_beacon("e1", NOW_S)
    assert model.ranges["e1"] == LearnedRange(last_beacon_s=NOW_S)
    model.on_measurement("e1", WIFI)
    assert model.ranges["e1"].range_factor == pytest.approx(1.2 * 1.02)


def test_beacon_restores_at_most_the_declared_range() -> None:
    model = range_model(96.0, range_factor=1.4)
    model.on_link_lost("e1", NOW_S)
    model.on_beacon("e1", NOW_S + 1.0)
    assert model.ranges["e1"].range_factor == pytest.approx(1.2 / 1.02)
    near = range_model(72.0, range_factor=1.4)
    near.on_link_lost("e1", NOW_S)
    near.on_beacon("e1", NOW_S + 1.0)
    assert near.ranges["e1"].range_factor == 1.0


def test_range_model_forgets_peers_that_are_not_planned() -> None:
    model = range_model(64.0)
    for name in ("e1", "e2"):
        model.on_link_up(name, NOW_S)
    model.retain({"e2"})
    assert set(model.ranges) == {"e2"}


def test_link_loss_well_inside_the_range_does_not_shorten_the_range() -> None:
    near = range_model(10.0)
    far = range_model(64.0)
    near.on_link_lost("e1", NOW_S)
    assert (near.ranges["e1"].range_factor, near.ranges["e1"].failures) == (1.0, 1)
    far.on_link_lost("e1", NOW_S)
    assert far.ranges["e1"].range_factor == pytest.approx(0.8 / 1.02)


def test_beacon_at_the_distance_of_the_link_loss_restores_the_range() -> None:
    model = range_model(64.0)
    model.on_link_lost("e1", NOW_S)
    assert model.ranges["e1"].last_failure_s == NOW_S
    model.peers = {"e1": replace(NEAR, position=(50.0, 0.0, 0.0))}
    model.on_beacon("e1", NOW_S + 0.5)
    assert model.ranges["e1"].range_factor == pytest.approx(0.8 / 1.02)
    model.peers = {"e1": replace(NEAR, position=(64.0, 0.0, 0.0))}
    model.on_beacon("e1", NOW_S + 1.0)
    assert model.ranges["e1"].range_factor == 1.0


def test_rate_is_learned_only_well_inside_the_range() -> None:
    inside = range_model(10.0)
    edge = range_model(79.0)
    for model in (inside, edge):
        model.on_measurement("e1", replace(WIFI, ingress_mbps=6.0))
    assert inside.ranges["e1"].rate_factor < 1.0
    assert "e1" not in edge.ranges


def test_failed_pairing_attempts_back_off() -> None:
    model = range_model(10.0)
    model.on_pairing_failed("e1", NOW_S)
    model.on_pairing_failed("e1", NOW_S)
    assert next_attempt_s(model.ranges["e1"], linked=False) == NOW_S + 2.0
    model.on_link_up("e1", NOW_S)
    assert model.ranges["e1"].failures == 0


def test_audit_records_contain_the_inputs_of_a_decision() -> None:
    joining = LinkSituation(NOW_S, STANDING, (TRAFFIC,), NO_LINK, IN_CONTACT, CLOUD)
    ((kind, choice),) = decision_records(actions(joining), joining)
    assert kind == "choice"
    assert choice == {
        "peer": "e1", "code": "Connect", "reason": "e1, 10 m away, offers more than the cloud path", "position": [0, 0, 0],
    }  # fmt: skip
    ((kind, moved),) = decision_records(actions(LINKED), LINKED)
    assert (kind, moved["application"], moved["path"], moved["code"]) == ("traffic", "ns/app", "e1", "BetterPath")
    assert (moved["cloud"]["ingress_mbps"], moved["direct"]["ingress_mbps"]) == (8.0, 12.0)
    without_link = replace(DIRECT, link=NO_LINK, direct=None, routes={})
    ((_, restored),) = [
        decided for decided in decision_records(actions(without_link), without_link) if decided[0] == "traffic"
    ]
    assert (restored["path"], restored["code"], restored["direct"]) == ("cloud", "NoDirectLink", None)


def test_decision_without_changes_has_no_audit_record() -> None:
    assert not list(decision_records(actions(DIRECT), DIRECT))
