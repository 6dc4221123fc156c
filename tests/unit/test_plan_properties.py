"""Plans of random scenes: who is a candidate, what stays, and that nothing depends on order."""

import dataclasses
import itertools
import random
import re

import pytest
from depth import examples
from fractus_core.api import Depot, Drone, InvalidObject
from fractus_core.api.nodes import Interface
from fractus_core.geo import geodesic_m
from fractus_core.planning import Infeasible, NodeLocations, Settings, flight_of, plan
from fractus_core.planning.candidates import direct_range_m, direct_reach_m
from hypothesis import example, given, settings
from hypothesis import strategies as st
from test_planning import (
    CHECKER,
    FRAME,
    PATH,
    STORE,
    VIEWER,
    application,
    at,
    component,
    drone,
    edge,
    host,
    inventory,
    manifest,
    navigator,
    nodes_of,
    reasons,
)

interfaces = st.lists(
    st.builds(
        lambda technology, device, range_, mode: Interface.model_validate(
            {
                "technology": technology,
                "device": device,
                "range": range_,
                "pairing": {"mode": mode, "networkId": "n"} if mode else None,
            }
        ),
        st.sampled_from(["WiFi", "BLE", "4G"]),
        st.sampled_from(["wlan0", None]),
        st.one_of(st.none(), st.floats(1, 500)),
        st.sampled_from(["adhoc", "infrastructure", None]),
    ),
    max_size=4,
)


@given(interfaces, interfaces)
def test_the_interfaces_of_direct_links_match_and_reach_by_the_lesser(ours, theirs):
    """An agent makes links over one interface; what it has no device for links no one."""
    firsts = [[i for i in each if i.device and i.range and i.pairing][:1] for each in (ours, theirs)]
    reaches = [
        min(a.range, b.range)
        for a, b in itertools.product(*firsts)
        if (a.technology, a.pairing.mode) == (b.technology, b.pairing.mode)
    ]
    reach = direct_reach_m(ours, theirs)
    assert reach == (reaches[0] if reaches else None)
    assert reach == direct_reach_m(theirs, ours)
    assert reach is None or reach <= direct_range_m(ours)


VIEWERS = component(
    "GroundViewer",
    "edge",
    egress=["ImageChecker"],
    locations=[
        {"center": at(150, 0), "radius": 120, "instances": 2},
        {"center": at(320, 20), "radius": 90, "instances": "*"},
    ],
    services=[{"service": "camera", "methods": ["CaptureImage"]}],
)
BOTH = CHECKER | {"hybridTo": ["GroundViewer", "AerialViewer"]}
TRAFFIC = application(navigator(PATH), VIEWER, VIEWERS, BOTH, STORE)


def scene(seed, count=14):
    """A random fleet and edge around the path; the first two nodes always suit."""
    rng = random.Random(seed)
    edges = [edge("a0", (150, 10)), edge("a1", (160, -10))]
    edges += [
        edge(
            f"e{i:02d}",
            (rng.uniform(-150, 500), rng.uniform(-150, 150)),
            wifi=rng.choice([None, 40, 80, 80, 120]),
            camera=rng.random() < 0.8,
        )
        for i in range(count)
    ]
    hosts = [host(e.name, "edge", cpu=rng.choice([0.05, 0.25, 4.0])) for e in edges[2:]]
    fleet = [drone(f"d{i}", battery=rng.choice([0.5, 0.9, 1.0]), minutes=30) for i in range(4)]
    return fleet, edges, hosts


@given(st.integers(0, 10_000), st.randoms(use_true_random=False))
@settings(max_examples=examples(25), deadline=None)
def test_plans_do_not_depend_on_order(seed, shuffler):
    fleet, edges, hosts = scene(seed)
    first = plan(TRAFFIC, inventory(fleet, edges, hosts))
    for things in (fleet, edges, hosts):
        shuffler.shuffle(things)
    assert plan(TRAFFIC, inventory(fleet, edges, hosts)) == first


@given(st.integers(0, 10_000))
@settings(max_examples=examples(25), deadline=None)
def test_static_instances_are_the_nearest_that_suit(seed):
    fleet, edges, hosts = scene(seed)
    stock = inventory(fleet, edges, hosts)
    result = plan(TRAFFIC, stock)
    taken: list[str] = []
    for i, location in enumerate(TRAFFIC.spec.component("GroundViewer").locations):
        suitable = sorted(
            (round(geodesic_m(location.center, e.spec.location) * 1000), e.name)
            for e in edges
            if geodesic_m(location.center, e.spec.location) <= location.radius
            and e.spec.services.camera is not None
            and stock.hosts[e.name].allocatable["cpu"] >= 0.1
            and e.name not in taken
        )
        wanted = [name for _, name in suitable][: location.instances if location.instances != "*" else None]
        chosen = [p.node for p in result.placements if p.component == "GroundViewer" and p.location == i]
        assert chosen == wanted
        taken += wanted


@given(st.integers(0, 10_000))
@settings(max_examples=examples(25), deadline=None)
def test_every_candidate_by_place_is_placed_passed_over_or_rejected_for_a_true_reason(seed):
    fleet, edges, hosts = scene(seed)
    stock = inventory(fleet, edges, hosts)
    result = plan(TRAFFIC, stock)
    placed = {(p.component, p.node) for p in result.placements}
    for r in result.rejected:
        assert (r.component, r.node) not in placed
        assert r.message
        assert r.reason[0].isupper()
        if r.reason == "InsufficientResources":
            assert stock.hosts[r.node].allocatable["cpu"] < 0.3
        if r.reason == "ServiceMissing":
            assert stock.edge_nodes[r.node].spec.services.camera is None
        if r.reason == "NoDirectInterface":
            assert len(stock.edge_nodes[r.node].spec.interfaces) == 1


@given(st.integers(0, 10_000), st.data())
@settings(max_examples=examples(25), deadline=None)
def test_replanning_keeps_all_that_still_fits(seed, data):
    fleet, edges, hosts = scene(seed)
    before = plan(TRAFFIC, inventory(fleet, edges, hosts))
    again = plan(TRAFFIC, inventory(fleet, edges, hosts), previous=before)
    assert (again.placements, again.drone) == (before.placements, before.drone)
    newcomers = [edge(f"new{i}", (140 + 40 * i, 1)) for i in range(4)]
    more = [drone("better", battery=1.0, minutes=60)]
    assert set(
        map(where, plan(TRAFFIC, inventory(fleet + more, edges + newcomers, hosts), previous=before).placements)
    ) >= set(map(where, before.placements))
    lost = data.draw(st.sampled_from(sorted({p.node for p in before.placements if p.node and p.role != "drone"})))
    left = [e for e in edges if e.name != lost]
    after = plan(TRAFFIC, inventory(fleet, left + newcomers, hosts), previous=before)
    stay = {where(p) for p in before.placements if p.node != lost and (p.serves is None or p.serves.node != lost)}
    assert stay <= {where(p) for p in after.placements}
    assert lost not in {p.node for p in after.placements}


def where(placed):
    return (placed.component, placed.node)


def test_a_cheaper_cover_does_not_move_what_covers():
    narrow = [edge("n1", (100, 0)), edge("n2", (200, 0)), edge("n3", (290, 0))]
    app = application(navigator(PATH), VIEWER, CHECKER)
    before = plan(app, inventory([drone("d")], narrow))
    better = [edge("middle", (150, 0)), edge("right", (260, 0))]
    after = plan(app, inventory([drone("d")], narrow + better), previous=before)
    assert nodes_of(after, "ImageChecker") == nodes_of(before, "ImageChecker")
    assert nodes_of(plan(app, inventory([drone("d")], narrow + better)), "ImageChecker") != nodes_of(
        before, "ImageChecker"
    )


@given(st.integers(0, 10_000))
@settings(max_examples=examples(15), deadline=None)
def test_locations_that_followed_every_change_plan_the_same(seed):
    fleet, edges, hosts = scene(seed)
    stock = inventory(fleet, edges, hosts)
    rng = random.Random(seed)
    followed = NodeLocations()
    for thing in rng.sample([*fleet, *edges], k=len(fleet) + len(edges)):
        away = {"home": at(9000, 9000)} if isinstance(thing, Drone) else {"location": at(9000, 9000)}
        moved = type(thing).from_body(manifest(thing.KIND, thing.name, thing.spec.to_dict() | away))
        for version in (moved, thing):
            (followed.upsert_drone if isinstance(thing, Drone) else followed.upsert_edge_node)(version)
    followed.upsert_edge_node(edge("gone", (150, 0)))
    followed.remove_edge_node("gone")
    followed.upsert_drone(drone("gone"))
    followed.remove_drone("gone")
    for depot in stock.depots.values():
        followed.upsert_depot(depot)
    for one in stock.hosts.values():
        followed.upsert_host(one.name, one.is_cloud)
    assert plan(TRAFFIC, dataclasses.replace(stock, locations=followed)) == plan(TRAFFIC, stock)


def test_drones_without_a_home_stand_in_their_depot_once_there_is_one():
    kept = Drone.from_body(
        manifest("Drone", "d", drone("d").spec.to_dict() | {"home": None}, status=drone("d").status.to_dict())
    )
    known = NodeLocations()
    known.upsert_drone(kept)
    assert known.homeless == {"d"}
    known.upsert_depot(inventory().depots["base"])
    assert known.homeless == set()
    assert [n for n, _ in known.stands.within(inventory().depots["base"].spec.location, 1)] == ["d"]
    known.remove_depot("base")
    assert known.homeless == {"d"}
    assert len(known.stands) == 0
    assert plan(application(navigator(PATH)), inventory([kept])).drone.node == "d"


# -- what fits together --


def asking(name, placement, milli, **more):
    made = component(name, placement, **more)
    return made | {"container": made["container"] | {"resources": {"requests": {"cpu": f"{milli}m"}}}}


millis = st.integers(1, 12).map(lambda tenths: 100 * tenths)


@given(millis, st.lists(millis, max_size=3), millis)
@settings(max_examples=examples(60), deadline=None)
def test_a_drone_flies_what_fits_on_it_together(driver, passengers, free):
    aboard = [navigator(PATH) | {"container": asking("Navigator", "drone", driver)["container"]}]
    aboard += [
        asking(f"P{i}", "drone", milli, services=VIEWER["services"], **{"class": "passenger"})
        for i, milli in enumerate(passengers)
    ]
    stock = inventory([drone("d")], hosts=[host("d", "drone", cpu=free / 1000)])
    try:
        flown = plan(application(*aboard), stock).drone.node
    except Infeasible as error:
        flown = None
        assert [r.reason for r in error.rejected] == ["InsufficientResources"]
    assert flown == ("d" if driver + sum(passengers) <= free else None)


def test_two_components_that_fit_one_by_one_but_not_together_are_named():
    aboard = [navigator(PATH) | {"container": asking("x", "drone", 600)["container"]}]
    aboard.append(asking("P", "drone", 600, services=VIEWER["services"], **{"class": "passenger"}))
    stock = inventory([drone("d")], hosts=[host("d", "drone", cpu=1.0)])
    with pytest.raises(Infeasible, match=r"Navigator, P do not fit together \(cpu: 1\.2 asked, 1 free\)"):
        plan(application(*aboard), stock)


@given(st.lists(st.tuples(millis, st.booleans()), min_size=1, max_size=4), st.lists(millis, min_size=1, max_size=4))
@settings(max_examples=examples(60), deadline=None)
def test_no_edge_node_gets_more_than_it_has_and_none_is_refused_that_has_room(wanted, rooms):
    statics = [(f"S{i}", milli) for i, (milli, _) in enumerate(wanted)]
    hybrids = [(f"H{i}", 200, f"S{i}") for i, (_, beside) in enumerate(wanted) if beside]
    where_to = {"locations": [{"center": at(0, 0), "radius": 50, "instances": "*"}]}
    spec = [asking(name, "edge", milli, **where_to) for name, milli in statics]
    spec += [asking(name, "hybrid", milli, hybridTo=[other]) for name, milli, other in hybrids]
    edges = [edge(f"e{i}", (i, 0)) for i in range(len(rooms))]
    hosts = [host(f"e{i}", "edge", cpu=milli / 1000) for i, milli in enumerate(rooms)]
    result = plan(application(*spec), inventory(edges=edges, hosts=hosts))
    asked = dict(statics) | {name: milli for name, milli, _ in hybrids}
    left = {f"e{i}": milli for i, milli in enumerate(rooms)}
    for placed in result.placements:
        if placed.node is not None:
            left[placed.node] -= asked[placed.component]
    assert min(left.values()) >= 0
    for r in result.rejected:
        assert r.reason == "InsufficientResources"
        assert asked[r.component] > left[r.node]
    # Each component is asked for on every node: what has room at the end had room then.
    placed = {(p.component, p.node) for p in result.placements}
    for name, milli in statics:
        assert all((name, node) in placed or milli > room for node, room in left.items())


# -- locations that compete for nodes --


def wanting(name, *locations, milli=100):
    """A static component with locations: middle, radius, and the number of instances."""
    spots = [
        {"center": at(*middle), "radius": radius, "instances": instances} for middle, radius, instances in locations
    ]
    return asking(name, "edge", milli, locations=spots)


def hosted(app, stock):
    """The nodes of each location of each component, or the component that has none at some location."""
    try:
        result = plan(app, stock)
    except Infeasible as error:
        return error.component
    found = {(c.name, i): [] for c in app.spec.components for i in range(len(c.locations))}
    for placed in result.placements:
        found[placed.component, placed.location].append(placed.node)
    return found


def most_that_can_be_hosted(app, stock, rooms):
    """By trying all: the most instances that all locations can have, each at least one; None if some gets none.

    Instances ask for a share of the rooms that is the same for all.
    """
    slots = [(c.name, spot) for c in app.spec.components for spot in c.locations]
    inside = [
        [n.name for n in stock.edge_nodes.values() if geodesic_m(spot.center, n.spec.location) <= spot.radius]
        for _, spot in slots
    ]

    def best(i, used):
        if i == len(slots):
            return 0
        name, spot = slots[i]
        free = [n for n in inside[i] if (name, n) not in used and sum(m == n for _, m in used) < rooms[n]]
        found = None
        for count in range(1, spot.instances + 1):
            for chosen in itertools.combinations(free, count):
                rest = best(i + 1, used | {(name, n) for n in chosen})
                if rest is not None:
                    found = max(found or 0, count + rest)
        return found

    return best(0, frozenset())


spots = st.tuples(st.tuples(st.integers(0, 4).map(lambda i: 10 * i), st.just(0)), st.sampled_from([4, 11, 21, 60]))


@given(
    st.lists(st.lists(st.tuples(spots, st.integers(1, 2)), min_size=1, max_size=3), min_size=1, max_size=2), st.data()
)
@settings(max_examples=examples(600), deadline=None)
def test_no_location_starves_another(wanted, data):
    edges = [edge(f"e{i}", (10 * i, 0)) for i in range(5)]
    rooms = {e.name: data.draw(st.integers(0, 2)) for e in edges}
    stock = inventory(edges=edges, hosts=[host(n, "edge", cpu=room / 10) for n, room in rooms.items()])
    app = application(*(wanting(f"S{i}", *[(*spot, k) for spot, k in some]) for i, some in enumerate(wanted)))
    found = hosted(app, stock)
    most = most_that_can_be_hosted(app, stock, rooms)
    if most is None:
        assert isinstance(found, str)
        return
    assert sum(map(len, found.values())) == most
    for name, room in rooms.items():
        used = [owner for (owner, _), nodes in found.items() for node in nodes if node == name]
        assert len(used) == len(set(used)) <= room
    for (owner, i), nodes in found.items():
        spot = app.spec.component(owner).locations[i]
        assert 1 <= len(nodes) <= spot.instances
        assert all(geodesic_m(spot.center, stock.edge_nodes[n].spec.location) <= spot.radius for n in nodes)


def test_a_location_yields_the_node_that_another_one_needs():
    edges = [edge("a", (0, 0)), edge("b", (30, 0))]
    both, only = ((0, 0), 50, 1), ((0, 0), 10, 1)
    found = hosted(application(wanting("S", both, only)), inventory(edges=edges))
    assert found == {("S", 0): ["b"], ("S", 1): ["a"]}
    assert hosted(application(wanting("S", both), wanting("T", only)), inventory(edges=edges))["S", 0] == ["a"]
    small = [host(e.name, "edge", cpu=0.1) for e in edges]
    found = hosted(application(wanting("S", both), wanting("T", only)), inventory(edges=edges, hosts=small))
    assert found == {("S", 0): ["b"], ("T", 0): ["a"]}


def test_a_location_of_all_nodes_leaves_others_their_node():
    edges = [edge("a", (0, 0)), edge("b", (30, 0))]
    found = hosted(application(wanting("S", ((0, 0), 50, "*"), ((0, 0), 10, 1))), inventory(edges=edges))
    assert found == {("S", 0): ["b"], ("S", 1): ["a"]}


def test_a_further_instance_moves_nothing_that_runs():
    app = application(wanting("S", ((0, 0), 50, 1), ((0, 0), 10, 2)))
    few = [edge("a", (0, 0)), edge("c", (1, 0))]
    before = plan(app, inventory(edges=few))
    assert {(p.location, p.node) for p in before.placements} == {(0, "a"), (1, "c")}
    stock = inventory(edges=[*few, edge("b", (30, 0))])
    assert plan(app, stock, previous=before).placements == before.placements
    assert hosted(app, stock) == {("S", 0): ["b"], ("S", 1): ["a", "c"]}


def test_a_location_that_cannot_have_a_node_says_who_needs_them():
    only = ((0, 0), 10, 1)
    with pytest.raises(Infeasible) as caught:
        plan(application(wanting("S", only, only)), inventory(edges=[edge("a", (0, 0))]))
    assert caught.value.message == (
        "no node can host S at locations[1]: a hosts S for locations[0], which has no other node"
    )


# -- sharing a flying drone --

OTHER = ("default", "other")


def passenger(points, ordered=True):
    return application(VIEWER | {"egress": [], "pointsOfInterest": {"points": points, "ordered": ordered}})


def shared(fleet, flights, **more):
    return inventory(fleet, claimed={n: f.holder for n, f in flights.items()}, flights=flights, **more)


def flown_by_other():
    app = application(navigator(PATH)).model_copy(deep=True)
    return dataclasses.replace(flight_of(app, inventory().depots), holder=OTHER)


def test_passengers_come_along_with_a_drone_that_flies_by():
    stock = shared([drone("busy", battery=0.5), drone("idle")], {"busy": flown_by_other()})
    result = plan(passenger([at(120, 0), at(250, 3)]), stock)
    assert (result.drone.node, result.drone.shared_with) == ("busy", "default/other")
    assert result.drone.mission is None
    assert [a.node for a in result.drone.alternatives] == ["idle"]
    assert result.drone.transit == ()


def test_passengers_do_not_come_along_against_the_order():
    stock = shared([drone("busy"), drone("idle")], {"busy": flown_by_other()})
    result = plan(passenger([at(250, 3), at(120, 0)]), stock)
    assert (result.drone.node, result.drone.shared_with) == ("idle", None)
    assert len(result.drone.transit) == 3
    busy = next(r for r in result.rejected if r.node == "busy")
    assert busy.reason == "Claimed"
    assert "does not visit pointsOfInterest.points[1] in this order" in busy.message
    elsewhere = shared([drone("busy", home=(9000, 0), depot=None), drone("idle")], {"busy": flown_by_other()})
    result = plan(passenger([at(250, 3), at(120, 0)]), elsewhere)
    assert reasons(result)["AerialViewer", "busy"] == "PathMissesPoint"
    assert plan(passenger([at(250, 3), at(120, 0)], ordered=False), stock).drone.node == "busy"


def test_a_driver_never_shares():
    with pytest.raises(Infeasible) as caught:
        plan(application(navigator(PATH)), shared([drone("busy")], {"busy": flown_by_other()}))
    assert caught.value.reason == "DroneBusy"


def test_a_passenger_that_came_along_stays_aboard():
    app = passenger([at(120, 0), at(250, 3)])
    stock = shared([drone("b"), drone("c")], {"b": flown_by_other(), "c": flown_by_other()})
    first = plan(app, stock)
    assert first.drone.node == "b"
    tired = shared([drone("b", battery=0.3), drone("c")], {"b": flown_by_other(), "c": flown_by_other()})
    assert plan(app, tired, previous=first).drone.node == "b"
    assert plan(app, tired).drone.node == "c"


# -- which drones are there --


def test_partial_control_takes_drones_of_depots_nearby():
    start = {"position": at(900, 0)}
    fleet = [drone("near", home=(0, 0)), drone("far", home=(9000, 0))]
    partial = application(navigator([at(950, 0, 10)], point=start, control="partial"))
    result = plan(partial, inventory(fleet))
    assert result.drone.node == "near"
    assert [round(FRAME.xy(leg.end.lat, leg.end.lon)[0]) for leg in result.drone.transit] == [900, 0]
    assert reasons(result) == {("Navigator", "far"): "TooFar"}
    with pytest.raises(Infeasible):
        plan(application(navigator([at(950, 0, 10)], point=start)), inventory(fleet))


def test_partial_control_from_a_named_depot_takes_its_drones_and_those_near_it():
    fleet = [
        drone("away", home=(2500, 0), minutes=60),
        drone("far", home=(2500, 10), depot="other", minutes=60),
        drone("near", home=(1900, 0), depot="other", minutes=60),
    ]
    app = application(navigator(PATH, control="partial"))
    result = plan(app, inventory(fleet))
    assert {result.drone.node, *(a.node for a in result.drone.alternatives)} == {"away", "near"}
    assert reasons(result) == {("Navigator", "far"): "TooFar"}
    with pytest.raises(Infeasible, match="near is 1900 m from the start, more than 1000 m"):
        plan(app, inventory(fleet[1:]), Settings(depot_radius_m=1000))
    assert reasons(plan(application(navigator(PATH)), inventory(fleet)))["Navigator", "near"] == "OtherDepot"


def test_full_control_at_a_position_takes_the_drones_of_the_depot_there():
    start = {"position": at(15, 0)}
    fleet = [drone("kept", home=(400, 0)), drone("stray", home=(60, 0), depot=None)]
    result = plan(application(navigator(PATH, point=start)), inventory(fleet))
    assert result.drone.node == "kept"
    assert reasons(result) == {("Navigator", "stray"): "TooFar"}


def test_a_drone_that_cannot_climb_so_high_is_rejected_with_the_figures():
    with pytest.raises(Infeasible) as caught:
        plan(application(navigator([at(100, 0, 95)])), inventory([drone("d")]))
    assert [r.reason for r in caught.value.rejected] == ["TooHigh"]
    assert "climbs to 80 m; the path goes up to 95 m" in caught.value.message


def test_a_drone_that_could_never_fly_it_does_not_make_the_application_wait():
    with pytest.raises(Infeasible) as caught:
        plan(application(navigator(PATH)), inventory([drone("d", minutes=2)], claimed={"d": OTHER}))
    assert caught.value.reason == "NoDrone"
    assert "even with a full battery" in caught.value.message


def test_flight_time_message_has_its_figures():
    with pytest.raises(
        Infeasible,
        match=r"can fly 0\.8 min with its reserve kept, with its battery at 25%; the mission takes 2\.\d min for \d+ m",
    ):
        plan(application(navigator(PATH)), inventory([drone("d", battery=0.25)]))


# -- plug-ins and bounds --


def test_plug_ins_replace_ranking_and_coverage():
    fleet = [drone("a"), drone("b"), drone("c", battery=0.9)]
    chosen = plan(
        application(navigator(PATH)), inventory(fleet), Settings(score_drone=lambda facts: -facts.remaining_min)
    )
    assert chosen.drone.node == "c"
    assert [a.node for a in chosen.drone.alternatives] == ["a", "b"]

    def nothing(found, fits):
        return []

    app = application(navigator(PATH), VIEWER, CHECKER)
    stock = inventory([drone("d")], [edge("e1", (150, 0))])
    assert nodes_of(plan(app, stock, Settings(cover=nothing)), "ImageChecker") == [None]
    assert nodes_of(plan(app, stock), "ImageChecker") == [None, "e1"]


def test_far_nodes_are_listed_up_to_a_number_and_the_rest_is_counted():
    edges = [edge("here", (0, 0))] + [edge(f"e{i:02d}", (500 + i, 0)) for i in range(40)]
    edges += [edge(f"blind{i:02d}", (i, 1), camera=False) for i in range(30)]
    viewer = VIEWERS | {"egress": [], "locations": [{"center": at(0, 0), "radius": 100}]}
    result = plan(application(viewer), inventory(edges=edges))
    assert sum(r.reason == "OutsideLocation" for r in result.rejected) == 20
    assert result.rejected_omitted == 20
    viewer["locations"][0]["instances"] = "*"
    few = plan(application(viewer), inventory(edges=edges), Settings(rejections_listed=35))
    assert [r.reason for r in few.rejected].count("ServiceMissing") == 30
    assert (len(few.rejected), few.rejected_omitted) == (35, 15 + 20)


def test_every_node_is_listed_hosts_something_is_not_needed_or_is_counted():
    fleet = [drone("d", minutes=30), *(drone(f"f{i:02d}", home=(9000 + i, 0), depot=None) for i in range(30))]
    edges = [edge("short", (200, 60), wifi=40), edge("near", (200, 0))]
    edges += [edge(f"e{i:02d}", (150, 600 + i)) for i in range(50)]
    result = plan(application(navigator(PATH), VIEWER, CHECKER), inventory(fleet, edges))
    listed = reasons(result)
    assert listed["ImageChecker", "short"] == "NoCoverage"
    assert sum(component == "ImageChecker" for component, _ in listed) == 1 + 20
    assert sum(component == "Navigator" for component, _ in listed) == 20
    assert result.rejected_omitted == (50 - 20) + (30 - 20)
    with pytest.raises(Infeasible) as caught:
        plan(application(navigator(PATH)), inventory(fleet[1:]))
    assert (len(caught.value.rejected), caught.value.omitted) == (20, 10)


def test_plan_at_80_degrees_across_the_antimeridian():
    from fractus_core.geo import LocalFrame

    frame = LocalFrame(80.0, 179.9995)

    def there(x, y):
        lat, lon = frame.latlon(x, y)
        return {"lat": lat, "lon": lon}

    flying = Drone.from_body(
        manifest(
            "Drone",
            "d",
            drone("d").spec.to_dict() | {"home": there(0, 0), "depot": None},
            status=drone("d").status.to_dict(),
        )
    )
    nodes = [
        type(edge("x", (0, 0))).from_body(
            manifest("EdgeNode", name, edge(name, (0, 0)).spec.to_dict() | {"location": there(x, 0)})
        )
        for name, x in (("west", 0), ("east", 130), ("far", 400))
    ]
    route = navigator([there(0, 0), there(150, 0)], point={"position": there(0, 0)})
    viewer = VIEWERS | {"egress": [], "locations": [{"center": there(60, 0), "radius": 80, "instances": "*"}]}
    result = plan(application(route, VIEWER, CHECKER, viewer), inventory([flying], nodes))
    assert nodes_of(result, "GroundViewer") == ["west", "east"]
    assert sorted(nodes_of(result, "ImageChecker")[1:]) == ["east", "west"]
    assert len(result.operation_area["coordinates"]) == 2
    assert reasons(result)["ImageChecker", "far"] == "NoCoverage"


def anywhere(rng, lat, lon):
    """A place around one, that may be a pole or on the antimeridian; near a pole at any longitude."""
    spread = rng.choice([0, 1e-6, 1e-4, 1e-2, 0.1, 1])
    there = rng.choice([lon + rng.uniform(-spread, spread), rng.uniform(-180, 180) if abs(lat) > 80 else lon])
    return {
        "lat": min(max(lat + rng.uniform(-spread, spread), -90), 90),
        "lon": (there + 180) % 360 - 180,
    }


def asked_for(rng, place):
    """Components that use the drone in one of the ways that a manifest can."""
    path = [place() | {"alt": 10} for _ in range(rng.randint(1, 5))]
    way = rng.choice(["depot", "path", "circle", "polygon", "points"])
    if way == "points":
        points = {"points": path, "serviceAccess": rng.choice(["points", "path"]), "ordered": rng.random() < 0.5}
        return [VIEWER | {"pointsOfInterest": points}, CHECKER]
    driver = navigator(path, point={"depot": "base"} if way == "depot" else {"position": path[0]})
    if way in {"circle", "polygon"}:
        circle = {"circle": {"center": place(), "radius": rng.choice([1, 50, 5000])}}
        ring = {"polygon": {"exterior": [place() for _ in range(rng.randint(3, 5))]}}
        region = circle if way == "circle" else ring
        driver["controlPoints"] = [{"point": {"position": path[0]}, "navigation": "regionBased", "region": region}]
    return [driver, VIEWER, CHECKER]


@given(
    st.integers(0, 2**32),
    st.sampled_from([90, 89.99999, 89.999, 89.9, 89, 0]),
    st.sampled_from([1, -1]),
    st.sampled_from([180, -180, 179.9999, 0, 90]),
)
@example(7029, 90, 1, 180)
@settings(max_examples=examples(300, 60), deadline=None)
def test_any_place_gives_a_plan_or_a_reason(seed, lat, side, lon):
    rng = random.Random(seed)

    def place():
        return anywhere(rng, side * lat, lon)

    flying = Drone.from_body(
        manifest("Drone", "d", drone("d").spec.to_dict() | {"home": place()}, status=drone("d").status.to_dict())
    )
    nodes = [
        type(edge("x", (0, 0))).from_body(
            manifest("EdgeNode", f"e{i}", edge("x", (0, 0)).spec.to_dict() | {"location": place()})
        )
        for i in range(3)
    ]
    base = Depot.from_body(manifest("Depot", "base", {"location": place(), "radius": rng.choice([20, 10_000])}))
    stock = dataclasses.replace(inventory([flying], nodes), depots={"base": base})
    try:
        result = plan(application(*asked_for(rng, place)), stock, Settings(depot_radius_m=1e9, battery_reserve=0))
    except Infeasible as error:
        assert error.reason in {"NoDrone", "NoCloudNode"}
    except InvalidObject as error:
        assert re.fullmatch(r"(spec\.)?components\[0\]\.[^ ]+: .+", str(error))
    else:
        assert result.operation_area["coordinates"]
