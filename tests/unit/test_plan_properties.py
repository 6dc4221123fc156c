"""Properties of plans of random scenes: rejected nodes, stable placements, and independence of the input order."""

import dataclasses
import itertools
import random
import re

import pytest
from depth import examples
from fractus_core.api import Depot, Drone, InvalidObject
from fractus_core.api.nodes import Interface
from fractus_core.geo import geodesic_m
from fractus_core.planning import Infeasible, NodeLocations, Settings, plan
from fractus_core.planning.candidates import direct_range_m, direct_reach_m
from hypothesis import example, given, settings
from hypothesis import strategies as st
from test_planning import (
    CHECKER,
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
def test_direct_reach_is_smaller_range_of_matching_interfaces(first, second):
    """An agent uses only its first interface that has a device, a range and a pairing."""
    firsts = [
        [i for i in node_interfaces if i.device and i.range and i.pairing][:1] for node_interfaces in (first, second)
    ]
    reaches = [
        min(a.range, b.range)
        for a, b in itertools.product(*firsts)
        if (a.technology, a.pairing.mode) == (b.technology, b.pairing.mode)
    ]
    reach = direct_reach_m(first, second)
    assert reach == (reaches[0] if reaches else None)
    assert reach == direct_reach_m(second, first)
    assert reach is None or reach <= direct_range_m(first)


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
    """Return a random fleet and random edge nodes around the path. The first two edge nodes are always suitable."""
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
def test_plan_of_random_scene_does_not_depend_on_order(seed, shuffler):
    fleet, edges, hosts = scene(seed)
    first = plan(TRAFFIC, inventory(fleet, edges, hosts))
    for objects in (fleet, edges, hosts):
        shuffler.shuffle(objects)
    assert plan(TRAFFIC, inventory(fleet, edges, hosts)) == first


@given(st.integers(0, 10_000))
@settings(max_examples=examples(25), deadline=None)
def test_static_instances_are_placed_on_nearest_suitable_nodes(seed):
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
        expected = [name for _, name in suitable][: location.instances if location.instances != "*" else None]
        chosen = [p.node for p in result.placements if p.component == "GroundViewer" and p.location == i]
        assert chosen == expected
        taken += expected


@given(st.integers(0, 10_000))
@settings(max_examples=examples(25), deadline=None)
def test_rejected_candidates_have_correct_reasons(seed):
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
def test_replanning_random_scene_keeps_placements_that_still_fit(seed, data):
    fleet, edges, hosts = scene(seed)
    before = plan(TRAFFIC, inventory(fleet, edges, hosts))
    repeated = plan(TRAFFIC, inventory(fleet, edges, hosts), previous=before)
    assert (repeated.placements, repeated.drone) == (before.placements, before.drone)
    newcomers = [edge(f"new{i}", (140 + 40 * i, 1)) for i in range(4)]
    more = [drone("better", battery=1.0, minutes=60)]
    assert set(
        map(
            component_and_node,
            plan(TRAFFIC, inventory(fleet + more, edges + newcomers, hosts), previous=before).placements,
        )
    ) >= set(map(component_and_node, before.placements))
    removed = data.draw(st.sampled_from(sorted({p.node for p in before.placements if p.node and p.role != "drone"})))
    remaining = [e for e in edges if e.name != removed]
    after = plan(TRAFFIC, inventory(fleet, remaining + newcomers, hosts), previous=before)
    stay = {
        component_and_node(p)
        for p in before.placements
        if p.node != removed and (p.serves is None or p.serves.node != removed)
    }
    assert stay <= {component_and_node(p) for p in after.placements}
    assert removed not in {p.node for p in after.placements}


def component_and_node(placed):
    return (placed.component, placed.node)


def test_replanning_keeps_coverage_when_cheaper_coverage_exists():
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
def test_plan_with_incremental_node_locations_equals_new_plan(seed):
    fleet, edges, hosts = scene(seed)
    stock = inventory(fleet, edges, hosts)
    rng = random.Random(seed)
    followed = NodeLocations()
    for node in rng.sample([*fleet, *edges], k=len(fleet) + len(edges)):
        distant = {"home": at(9000, 9000)} if isinstance(node, Drone) else {"location": at(9000, 9000)}
        relocated = type(node).from_body(manifest(node.KIND, node.name, node.spec.to_dict() | distant))
        for version in (relocated, node):
            (followed.upsert_drone if isinstance(node, Drone) else followed.upsert_edge_node)(version)
    followed.upsert_edge_node(edge("gone", (150, 0)))
    followed.remove_edge_node("gone")
    followed.upsert_drone(drone("gone"))
    followed.remove_drone("gone")
    for depot in stock.depots.values():
        followed.upsert_depot(depot)
    for host_ in stock.hosts.values():
        followed.upsert_host(host_.name, host_.is_cloud)
    assert plan(TRAFFIC, dataclasses.replace(stock, locations=followed)) == plan(TRAFFIC, stock)


def test_drone_without_home_is_located_at_its_depot():
    known_drone = Drone.from_body(
        manifest("Drone", "d", drone("d").spec.to_dict() | {"home": None}, status=drone("d").status.to_dict())
    )
    known = NodeLocations()
    known.upsert_drone(known_drone)
    assert known.homeless == {"d"}
    known.upsert_depot(inventory().depots["base"])
    assert known.homeless == set()
    assert [n for n, _ in known.stands.within(inventory().depots["base"].spec.location, 1)] == ["d"]
    known.remove_depot("base")
    assert known.homeless == {"d"}
    assert len(known.stands) == 0
    assert plan(application(navigator(PATH)), inventory([known_drone])).drone.node == "d"


# -- plug-ins and bounds --


def test_plugins_replace_drone_score_and_coverage():
    fleet = [drone("a"), drone("b"), drone("c", battery=0.9)]
    chosen = plan(
        application(navigator(PATH)), inventory(fleet), Settings(score_drone=lambda facts: -facts.remaining_min)
    )
    assert chosen.drone.node == "c"
    assert [a.node for a in chosen.drone.alternatives] == ["a", "b"]

    def no_coverage(scene, fits):
        return []

    app = application(navigator(PATH), VIEWER, CHECKER)
    stock = inventory([drone("d")], [edge("e1", (150, 0))])
    assert nodes_of(plan(app, stock, Settings(cover=no_coverage)), "ImageChecker") == [None]
    assert nodes_of(plan(app, stock), "ImageChecker") == [None, "e1"]


def test_rejected_nodes_are_listed_up_to_limit_and_rest_is_counted():
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


def test_rejected_nodes_are_listed_or_counted_for_each_component():
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

    def position(x, y):
        lat, lon = frame.latlon(x, y)
        return {"lat": lat, "lon": lon}

    flying = Drone.from_body(
        manifest(
            "Drone",
            "d",
            drone("d").spec.to_dict() | {"home": position(0, 0), "depot": None},
            status=drone("d").status.to_dict(),
        )
    )
    nodes = [
        type(edge("x", (0, 0))).from_body(
            manifest("EdgeNode", name, edge(name, (0, 0)).spec.to_dict() | {"location": position(x, 0)})
        )
        for name, x in (("west", 0), ("east", 130), ("far", 400))
    ]
    route = navigator([position(0, 0), position(150, 0)], point={"position": position(0, 0)})
    viewer = VIEWERS | {"egress": [], "locations": [{"center": position(60, 0), "radius": 80, "instances": "*"}]}
    result = plan(application(route, VIEWER, CHECKER, viewer), inventory([flying], nodes))
    assert nodes_of(result, "GroundViewer") == ["west", "east"]
    assert sorted(nodes_of(result, "ImageChecker")[1:]) == ["east", "west"]
    assert len(result.operation_area["coordinates"]) == 2
    assert reasons(result)["ImageChecker", "far"] == "NoCoverage"


def anywhere(rng, lat, lon):
    """Return a random position near (lat, lon).

    The given position may be a pole or on the antimeridian. Near a pole, the longitude of the result is arbitrary.
    """
    spread = rng.choice([0, 1e-6, 1e-4, 1e-2, 0.1, 1])
    position = rng.choice([lon + rng.uniform(-spread, spread), rng.uniform(-180, 180) if abs(lat) > 80 else lon])
    return {
        "lat": min(max(lat + rng.uniform(-spread, spread), -90), 90),
        "lon": (position + 180) % 360 - 180,
    }


def random_components(rng, place):
    """Return components that use the drone, with a random kind of control point or points of interest."""
    path = [place() | {"alt": 10} for _ in range(rng.randint(1, 5))]
    kind = rng.choice(["depot", "path", "circle", "polygon", "points"])
    if kind == "points":
        points = {"points": path, "serviceAccess": rng.choice(["points", "path"]), "ordered": rng.random() < 0.5}
        return [VIEWER | {"pointsOfInterest": points}, CHECKER]
    driver = navigator(path, point={"depot": "base"} if kind == "depot" else {"position": path[0]})
    if kind in {"circle", "polygon"}:
        circle = {"circle": {"center": place(), "radius": rng.choice([1, 50, 5000])}}
        ring = {"polygon": {"exterior": [place() for _ in range(rng.randint(3, 5))]}}
        region = circle if kind == "circle" else ring
        driver["controlPoints"] = [
            {"point": {"position": path[0]}, "navigation": "regionBased", "region": region, "duration": 1}
        ]
    return [driver, VIEWER, CHECKER]


@given(
    st.integers(0, 2**32),
    st.sampled_from([90, 89.99999, 89.999, 89.9, 89, 0]),
    st.sampled_from([1, -1]),
    st.sampled_from([180, -180, 179.9999, 0, 90]),
)
@example(7029, 90, 1, 180)
@settings(max_examples=examples(300, 60), deadline=None)
def test_any_location_on_earth_gives_plan_or_reason(seed, lat, side, lon):
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
        result = plan(
            application(*random_components(rng, place)), stock, Settings(depot_radius_m=1e9, battery_reserve=0)
        )
    except Infeasible as error:
        assert error.reason in {"NoDrone", "NoCloudNode"}
    except InvalidObject as error:
        assert re.fullmatch(r"(spec\.)?components\[0\]\.[^ ]+: .+", str(error))
    else:
        assert result.operation_area["coordinates"]
