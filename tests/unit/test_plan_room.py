"""Capacity of nodes: components that must fit together, and locations that compete for nodes."""

import itertools

import pytest
from depth import examples
from fractus_core.geo import geodesic_m
from fractus_core.planning import Infeasible, plan
from hypothesis import given, settings
from hypothesis import strategies as st
from test_planning import (
    PATH,
    VIEWER,
    application,
    at,
    component,
    drone,
    edge,
    host,
    inventory,
    navigator,
)

# -- components on one node --


def component_requesting(name, placement, milli, **more):
    base = component(name, placement, **more)
    return base | {"container": base["container"] | {"resources": {"requests": {"cpu": f"{milli}m"}}}}


millis = st.integers(1, 12).map(lambda tenths: 100 * tenths)


@given(millis, st.lists(millis, max_size=3), millis)
@settings(max_examples=examples(60), deadline=None)
def test_drone_is_chosen_only_if_all_its_components_fit(driver, passengers, free):
    aboard = [navigator(PATH) | {"container": component_requesting("Navigator", "drone", driver)["container"]}]
    aboard += [
        component_requesting(f"P{i}", "drone", milli, services=VIEWER["services"], **{"class": "passenger"})
        for i, milli in enumerate(passengers)
    ]
    stock = inventory([drone("d")], hosts=[host("d", "drone", cpu=free / 1000)])
    try:
        flown = plan(application(*aboard), stock).drone.node
    except Infeasible as error:
        flown = None
        assert [r.reason for r in error.rejected] == ["InsufficientResources"]
    assert flown == ("d" if driver + sum(passengers) <= free else None)


def test_error_names_components_that_do_not_fit_together():
    aboard = [navigator(PATH) | {"container": component_requesting("x", "drone", 600)["container"]}]
    aboard.append(component_requesting("P", "drone", 600, services=VIEWER["services"], **{"class": "passenger"}))
    stock = inventory([drone("d")], hosts=[host("d", "drone", cpu=1.0)])
    with pytest.raises(Infeasible, match=r"Navigator, P do not fit together \(cpu: 1\.2 requested, 1 free\)"):
        plan(application(*aboard), stock)


@given(st.lists(st.tuples(millis, st.booleans()), min_size=1, max_size=4), st.lists(millis, min_size=1, max_size=4))
@settings(max_examples=examples(60), deadline=None)
def test_edge_nodes_are_filled_but_never_overbooked(demands, rooms):
    statics = [(f"S{i}", milli) for i, (milli, _) in enumerate(demands)]
    hybrids = [(f"H{i}", 200, f"S{i}") for i, (_, beside) in enumerate(demands) if beside]
    locations = {"locations": [{"center": at(0, 0), "radius": 50, "instances": "*"}]}
    spec = [component_requesting(name, "edge", milli, **locations) for name, milli in statics]
    spec += [component_requesting(name, "hybrid", milli, hybridTo=[other]) for name, milli, other in hybrids]
    edges = [edge(f"e{i}", (i, 0)) for i in range(len(rooms))]
    hosts = [host(f"e{i}", "edge", cpu=milli / 1000) for i, milli in enumerate(rooms)]
    result = plan(application(*spec), inventory(edges=edges, hosts=hosts))
    requested = dict(statics) | {name: milli for name, milli, _ in hybrids}
    free = {f"e{i}": milli for i, milli in enumerate(rooms)}
    for placed in result.placements:
        if placed.node is not None:
            free[placed.node] -= requested[placed.component]
    assert min(free.values()) >= 0
    for r in result.rejected:
        assert r.reason == "InsufficientResources"
        assert requested[r.component] > free[r.node]
    # The planner tries to place each component on every node. If a node has room at the end, it had room before, too.
    placed = {(p.component, p.node) for p in result.placements}
    for name, milli in statics:
        assert all((name, node) in placed or milli > room for node, room in free.items())


# -- locations that compete for nodes --


def component_at(name, *locations, milli=100):
    """Return a static component with locations, each given as (centre, radius, number of instances)."""
    spots = [
        {"center": at(*middle), "radius": radius, "instances": instances} for middle, radius, instances in locations
    ]
    return component_requesting(name, "edge", milli, locations=spots)


def hosted(app, stock):
    """Return the nodes of each location. If a location has no node, return the name of its component instead."""
    try:
        result = plan(app, stock)
    except Infeasible as error:
        return error.component
    placed_nodes = {(c.name, i): [] for c in app.spec.components for i in range(len(c.locations))}
    for placed in result.placements:
        placed_nodes[placed.component, placed.location].append(placed.node)
    return placed_nodes


def most_that_can_be_hosted(app, stock, rooms):
    """Return the largest number of instances if each location has at least one. Return None if this is impossible.

    This oracle tries all combinations. All instances request the same resources.
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
        placed_nodes = None
        for count in range(1, spot.instances + 1):
            for chosen in itertools.combinations(free, count):
                rest = best(i + 1, used | {(name, n) for n in chosen})
                if rest is not None:
                    placed_nodes = max(placed_nodes or 0, count + rest)
        return placed_nodes

    return best(0, frozenset())


spots = st.tuples(st.tuples(st.integers(0, 4).map(lambda i: 10 * i), st.just(0)), st.sampled_from([4, 11, 21, 60]))


@given(
    st.lists(st.lists(st.tuples(spots, st.integers(1, 2)), min_size=1, max_size=3), min_size=1, max_size=2), st.data()
)
@settings(max_examples=examples(600), deadline=None)
def test_locations_share_nodes_for_most_instances(demands, data):
    edges = [edge(f"e{i}", (10 * i, 0)) for i in range(5)]
    rooms = {e.name: data.draw(st.integers(0, 2)) for e in edges}
    stock = inventory(edges=edges, hosts=[host(n, "edge", cpu=room / 10) for n, room in rooms.items()])
    app = application(
        *(
            component_at(f"S{i}", *[(*spot, k) for spot, k in component_locations])
            for i, component_locations in enumerate(demands)
        )
    )
    placed_nodes = hosted(app, stock)
    most = most_that_can_be_hosted(app, stock, rooms)
    if most is None:
        assert isinstance(placed_nodes, str)
        return
    assert sum(map(len, placed_nodes.values())) == most
    for name, room in rooms.items():
        used = [owner for (owner, _), nodes in placed_nodes.items() for node in nodes if node == name]
        assert len(used) == len(set(used)) <= room
    for (owner, i), nodes in placed_nodes.items():
        spot = app.spec.component(owner).locations[i]
        assert 1 <= len(nodes) <= spot.instances
        assert all(geodesic_m(spot.center, stock.edge_nodes[n].spec.location) <= spot.radius for n in nodes)


def test_location_yields_node_that_another_location_needs():
    edges = [edge("a", (0, 0)), edge("b", (30, 0))]
    both = ((0, 0), 50, 1)
    only = ((0, 0), 10, 1)
    placed_nodes = hosted(application(component_at("S", both, only)), inventory(edges=edges))
    assert placed_nodes == {("S", 0): ["b"], ("S", 1): ["a"]}
    assert hosted(application(component_at("S", both), component_at("T", only)), inventory(edges=edges))["S", 0] == [
        "a"
    ]
    small = [host(e.name, "edge", cpu=0.1) for e in edges]
    placed_nodes = hosted(
        application(component_at("S", both), component_at("T", only)), inventory(edges=edges, hosts=small)
    )
    assert placed_nodes == {("S", 0): ["b"], ("T", 0): ["a"]}


def test_location_with_all_nodes_yields_node_that_another_location_needs():
    edges = [edge("a", (0, 0)), edge("b", (30, 0))]
    placed_nodes = hosted(application(component_at("S", ((0, 0), 50, "*"), ((0, 0), 10, 1))), inventory(edges=edges))
    assert placed_nodes == {("S", 0): ["b"], ("S", 1): ["a"]}


def test_additional_instance_moves_no_running_instance():
    app = application(component_at("S", ((0, 0), 50, 1), ((0, 0), 10, 2)))
    few = [edge("a", (0, 0)), edge("c", (1, 0))]
    before = plan(app, inventory(edges=few))
    assert {(p.location, p.node) for p in before.placements} == {(0, "a"), (1, "c")}
    stock = inventory(edges=[*few, edge("b", (30, 0))])
    assert plan(app, stock, previous=before).placements == before.placements
    assert hosted(app, stock) == {("S", 0): ["b"], ("S", 1): ["a", "c"]}


def test_infeasible_location_error_names_locations_that_need_its_nodes():
    only = ((0, 0), 10, 1)
    with pytest.raises(Infeasible) as caught:
        plan(application(component_at("S", only, only)), inventory(edges=[edge("a", (0, 0))]))
    assert caught.value.message == (
        "no node can host S at locations[1]: a: it hosts S for locations[0], which has no other node"
    )
