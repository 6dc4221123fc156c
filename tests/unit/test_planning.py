"""Plans: chosen and rejected nodes with reasons, and independence of the inventory order."""

import math
import random

import pytest
import shapely
from fractus_core.api import Application, Depot, Drone, EdgeNode, InvalidObject
from fractus_core.geo import LocalFrame
from fractus_core.planning import Host, Infeasible, Inventory, Settings, instance_name, plan

LAT = 39.3606
LON = 22.9307
FRAME = LocalFrame(LAT, LON)
ALL = ["Arm", "Disarm", "Takeoff", "Land", "SetSpeed", "GetSpeed", "Goto", "Hover", "GetPosition", "ReturnToLaunch"]
CAMERA = ["CaptureImage", "RetrieveImage", "ListImages"]


def at(x, y, alt=None):
    lat, lon = FRAME.latlon(x, y)
    return {"lat": lat, "lon": lon} | ({"alt": alt} if alt is not None else {})


def manifest(kind, name, spec, **extra):
    return {"apiVersion": "fractus.dev/v1alpha1", "kind": kind, "metadata": {"name": name}, "spec": spec, **extra}


def drone(name, home=(0, 0), battery=1.0, ready="True", minutes=15, methods=ALL, depot="base"):
    return Drone.from_body(
        manifest(
            "Drone",
            name,
            {
                "depot": depot,
                "home": at(*home),
                "interfaces": [
                    {"technology": "WiFi", "device": "wlan0", "range": 80, "pairing": {"networkId": "a"}},
                    {"technology": "4G"},
                ],
                "services": {
                    "mobility": {"maxAltitude": 80, "maxFlightTime": minutes, "maxSpeed": 15, "methods": methods},
                    "camera": {"methods": CAMERA},
                },
            },
            status={
                "battery": {"remaining": battery},
                "conditions": [
                    {
                        "type": "Ready",
                        "status": ready,
                        "reason": "Because",
                        "message": "autopilot not connected",
                        "lastTransitionTime": "2026-01-01T00:00:00Z",
                    }
                ],
            },
        )
    )


def edge(name, location, wifi=80, camera=True):
    interfaces = [{"technology": "Ethernet"}]
    if wifi:
        interfaces.append({"technology": "WiFi", "device": "wlan0", "range": wifi, "pairing": {"networkId": name}})
    services = {"camera": {"methods": CAMERA}} if camera else {}
    return EdgeNode.from_body(
        manifest("EdgeNode", name, {"location": at(*location), "interfaces": interfaces, "services": services})
    )


def host(name, node_class, cpu=4.0, gpu=1.0, **more):
    return Host(name, {"fractus.dev/class": node_class}, {"cpu": cpu, "fractus.dev/gpu": gpu}, {}, **more)


def component(name, placement, **more):
    container = {"image": "app", "ports": [{"port": 8080}], "resources": {"requests": {"cpu": "100m"}}}
    return {"name": name, "placement": placement, "container": container, **more}


def navigator(path, point=None, **more):
    return component(
        "Navigator",
        "drone",
        services=[{"service": "mobility", "methods": ["Arm", "Takeoff", "Goto"]}],
        controlPoints=[{"point": point or {"depot": "base"}, "navigation": "pathBased", "path": path}],
        **{"class": "driver", **more},
    )


VIEWER = component(
    "AerialViewer",
    "drone",
    egress=["ImageChecker"],
    services=[{"service": "camera", "methods": ["CaptureImage"]}],
    **{"class": "passenger"},
)
CHECKER = component("ImageChecker", "hybrid", hybridTo=["AerialViewer"], heuristic={"kind": "preferDirect"})
STORE = component("DataStore", "cloud", replicas=3)


def application(*components):
    return Application.from_body(
        {
            **manifest("Application", "traffic", {"components": list(components)}),
            "metadata": {"name": "traffic", "namespace": "default"},
        }
    )


def inventory(drones=(), edges=(), hosts=(), **more):
    hosts_by_name = {d.name: host(d.name, "drone") for d in drones} | {e.name: host(e.name, "edge") for e in edges}
    hosts_by_name |= {"cloud-1": host("cloud-1", "cloud")} | {h.name: h for h in hosts}
    depot = Depot.from_body(manifest("Depot", "base", {"location": at(0, 0), "radius": 20}))
    return Inventory(
        hosts=hosts_by_name,
        drones={d.name: d for d in drones},
        edge_nodes={e.name: e for e in edges},
        depots={"base": depot},
        **more,
    )


PATH = [at(100, 0, 10), at(300, 0, 10)]


def nodes_of(result, name):
    return [p.node for p in result.placements if p.component == name]


def reasons(result):
    return {(r.component, r.node): r.reason for r in result.rejected}


def test_plan_chooses_drone_of_depot_with_fullest_battery():
    fleet = [drone("d1", battery=0.8), drone("d2", battery=0.9), drone("d3", home=(5000, 0), depot="far")]
    result = plan(application(navigator(PATH)), inventory(fleet))
    assert result.drone.node == "d2"
    assert [a.node for a in result.drone.alternatives] == ["d1"]
    assert reasons(result) == {("Navigator", "d3"): "OtherDepot"}


@pytest.mark.parametrize(
    ("fleet", "reason"),
    [
        ([drone("d", ready="False")], "DroneNotReady"),
        ([drone("d", methods=["Arm", "Takeoff"])], "MethodMissing"),
        ([drone("d", minutes=2)], "FlightTooLong"),
        ([drone("d", battery=0.25)], "FlightTooLong"),
    ],
)
def test_unsuitable_drone_is_rejected_with_reason(fleet, reason):
    with pytest.raises(Infeasible) as caught:
        plan(application(navigator(PATH)), inventory(fleet))
    assert [(r.node, r.reason) for r in caught.value.rejected] == [("d", reason)]
    assert caught.value.component == "Navigator"


def test_drone_without_mobility_service_is_rejected_for_missing_service():
    spec = drone("d").spec.to_dict()
    camera_only = Drone.from_body(manifest("Drone", "d", spec | {"services": {"camera": {"methods": CAMERA}}}))
    camera_only = camera_only.model_copy(update={"status": drone("d").status})
    tour = VIEWER | {"egress": [], "pointsOfInterest": {"points": [at(100, 0)]}}
    with pytest.raises(Infeasible, match="it has no mobility service, which every flight requires") as caught:
        plan(application(tour), inventory([camera_only]))
    assert [r.reason for r in caught.value.rejected] == ["ServiceMissing"]


def unready(node, status="False", message="no certificate"):
    condition = {"type": "Ready", "status": status, "reason": "NoCertificate", "message": message}
    condition["lastTransitionTime"] = "2026-01-01T00:00:00Z"
    return EdgeNode.from_body(manifest("EdgeNode", node.name, node.spec.to_dict(), status={"conditions": [condition]}))


def test_unready_edge_node_keeps_instances_but_gets_no_new_ones():
    ground_viewer = component("GroundViewer", "edge", locations=[{"center": at(0, 0), "radius": 100, "instances": "*"}])
    app = application(ground_viewer)
    good = edge("e1", (0, 0))
    bad = edge("e2", (10, 0))
    result = plan(app, inventory(edges=[good, unready(bad)]))
    assert nodes_of(result, "GroundViewer") == ["e1"]
    assert [(r.node, r.reason, r.message) for r in result.rejected] == [("e2", "EdgeNodeNotReady", "no certificate")]
    assert nodes_of(plan(app, inventory(edges=[good, unready(bad, "True")])), "GroundViewer") == ["e1", "e2"]
    before = plan(app, inventory(edges=[good, bad]))
    after = plan(app, inventory(edges=[good, unready(bad)]), previous=before)
    assert nodes_of(after, "GroundViewer") == ["e1", "e2"]


def test_plan_without_drones_is_infeasible():
    with pytest.raises(Infeasible, match="no Drone exists"):
        plan(application(navigator(PATH)), inventory())


def test_plan_reports_known_drones_far_from_start():
    path = [{"lat": -33.0, "lon": 151.0, "alt": 20}]
    with pytest.raises(Infeasible, match="none of the 1 known drones is near the start"):
        plan(application(navigator(path, point={"position": path[0]})), inventory([drone("d")]))


@pytest.mark.parametrize(
    ("setting", "value"),
    [(name, math.nan) for name in ("safety_radius_m", "depot_radius_m", "coverage_share", "climb_speed_mps")]
    + [("safety_radius_m", math.inf), ("safety_radius_m", 0), ("cruise_speed_mps", 0), ("battery_reserve", 1.1)],
)
def test_invalid_planning_settings_are_refused(setting, value):
    spelled = setting.removesuffix("_m").removesuffix("_mps").removesuffix("_share").replace("_", " ")
    with pytest.raises(InvalidObject, match=rf"^{spelled}: must be .* to .*, not {value:g}$"):
        Settings(**{setting: value})


def test_claimed_drone_is_not_chosen():
    with pytest.raises(Infeasible) as caught:
        plan(application(navigator(PATH)), inventory([drone("d")], claimed={"d": ("other", "app")}))
    assert caught.value.reason == "DroneBusy"
    assert plan(application(navigator(PATH)), inventory([drone("d")], claimed={"d": ("default", "traffic")}))


def test_drone_is_rejected_when_its_host_is_unready_cordoned_or_full():
    for bad, reason in (
        (host("d", "drone", ready=False), "NodeNotReady"),
        (host("d", "drone", schedulable=False), "NodeUnschedulable"),
        (host("d", "drone", cpu=0.05), "InsufficientResources"),
    ):
        with pytest.raises(Infeasible) as caught:
            plan(application(navigator(PATH)), inventory([drone("d")], hosts=[bad]))
        assert [r.reason for r in caught.value.rejected] == [reason]


def test_plan_keeps_drone_that_is_temporarily_unsuitable():
    app = application(navigator(PATH))
    before = plan(app, inventory([drone("d2")]))
    tired = drone("d2", battery=0.3, ready="False")
    now = inventory([drone("d1"), tired], hosts=[host("d2", "drone", ready=False)])
    assert plan(app, now, previous=before).drone.node == "d2"
    assert plan(app, now).drone.node == "d1"


def test_static_instances_are_placed_by_distance_and_count():
    edges = [edge("e1", (50, 0)), edge("e2", (10, 0)), edge("e3", (500, 0)), edge("e4", (20, 0), camera=False)]
    viewer = component(
        "GroundViewer",
        "edge",
        locations=[{"center": at(0, 0), "radius": 100, "instances": 1}],
        services=[{"service": "camera", "methods": ["CaptureImage"]}],
    )
    result = plan(application(viewer), inventory(edges=edges))
    assert nodes_of(result, "GroundViewer") == ["e2"]
    viewer["locations"][0]["instances"] = "*"
    result = plan(application(viewer), inventory(edges=edges))
    assert nodes_of(result, "GroundViewer") == ["e2", "e1"]
    assert reasons(result) == {("GroundViewer", "e3"): "OutsideLocation", ("GroundViewer", "e4"): "ServiceMissing"}


def test_static_location_without_nodes_is_infeasible():
    viewer = component("GroundViewer", "edge", locations=[{"center": at(9000, 0), "radius": 10, "instances": 2}])
    with pytest.raises(Infeasible, match=r"locations\[0\]"):
        plan(application(viewer), inventory(edges=[edge("e1", (0, 0))]))


def test_hybrid_instance_is_placed_on_node_of_static_instance_or_linked_node():
    viewer = component("GroundViewer", "edge", locations=[{"center": at(0, 0), "radius": 5}], egress=["ImageChecker"])
    checker = component("ImageChecker", "hybrid", hybridTo=["GroundViewer"])
    edges = [edge("e1", (0, 0)), edge("e2", (60, 0)), edge("e3", (40, 0), wifi=30), edge("e4", (70, 0))]
    result = plan(application(viewer, checker), inventory(edges=edges))
    assert nodes_of(result, "ImageChecker") == [None, "e1"]
    checker["container"]["resources"] = {"limits": {"fractus.dev/gpu": 1}}
    result = plan(application(viewer, checker), inventory(edges=edges, hosts=[host("e1", "edge", gpu=0)]))
    assert nodes_of(result, "ImageChecker") == [None, "e2"]
    assert reasons(result)["ImageChecker", "e1"] == "InsufficientResources"


def test_hybrid_component_has_only_cloud_base_without_linked_node():
    viewer = component("GroundViewer", "edge", locations=[{"center": at(0, 0), "radius": 5}], egress=["ImageChecker"])
    checker = component("ImageChecker", "hybrid", hybridTo=["GroundViewer"])
    checker["container"]["resources"] = {"limits": {"fractus.dev/gpu": 1}}
    result = plan(
        application(viewer, checker), inventory(edges=[edge("e1", (0, 0))], hosts=[host("e1", "edge", gpu=0)])
    )
    assert nodes_of(result, "ImageChecker") == [None]


def test_coverage_equals_plain_greedy_on_random_scenes():
    """The oracle uses sets of sample points instead of polygons."""
    rng = random.Random(7)
    for _ in range(5):
        edges = [
            edge(f"e{i}", (rng.uniform(-50, 400), rng.uniform(-60, 60)), wifi=rng.uniform(40, 80)) for i in range(8)
        ]
        app = application(navigator(PATH), VIEWER, CHECKER)
        result = plan(app, inventory([drone("d", minutes=30)], edges))
        chosen = [p.node for p in result.placements if p.role == "hybrid-drone"]
        shape = shapely.union_all(
            [
                shapely.Polygon([FRAME.xy(lat, lon) for lon, lat in part[0]])
                for part in result.operation_area["coordinates"]
            ]
        )
        west, south, east, north = shape.bounds
        grid = [
            (west + (east - west) * i / 160, south + (north - south) * j / 60) for i in range(161) for j in range(61)
        ]
        inside = {p for p in grid if shape.covers(shapely.Point(p))}
        reach = {
            e.name: {
                p
                for p in inside
                if math.dist(p, FRAME.xy(e.spec.location.lat, e.spec.location.lon))
                <= min(80, e.spec.interfaces[1].range)
            }
            for e in edges
        }
        covered: set = set()
        for name in chosen:
            best = max(len(points - covered) for points in reach.values())
            assert len(reach[name] - covered) >= best - 0.02 * len(inside)
            covered |= reach[name]
        if len(covered) < 0.93 * len(inside):
            assert max(len(points - covered) for points in reach.values()) <= 0.02 * len(inside)


def test_node_without_coverage_or_direct_interface_is_rejected():
    edges = [edge("near", (200, 0)), edge("far", (200, 500)), edge("wired", (150, 0), wifi=None)]
    result = plan(application(navigator(PATH), VIEWER, CHECKER), inventory([drone("d")], edges))
    assert nodes_of(result, "ImageChecker") == [None, "near"]
    dropped = reasons(result)
    assert dropped["ImageChecker", "far"] == "NoCoverage"
    assert dropped["ImageChecker", "wired"] == "NoDirectInterface"
    near = next(p for p in result.placements if p.node == "near")
    assert 0.2 < near.coverage < 1
    assert (near.serves.component, near.serves.node) == ("AerialViewer", "d")


def test_cloud_component_requires_cloud_node():
    empty = Inventory(hosts={"w": host("w", "edge")})
    with pytest.raises(Infeasible) as caught:
        plan(application(STORE), empty)
    assert caught.value.reason == "NoCloudNode"
    assert plan(application(STORE), inventory()).placements[0].replicas == 3


@pytest.mark.parametrize(("value", "takes"), [("true", True), ("false", False), ("", False)])
def test_node_of_another_class_hosts_cloud_components_if_labelled(value, takes):
    both = host("w", "drone")
    both.labels["fractus.dev/cloud"] = value
    if takes:
        assert plan(application(STORE), Inventory(hosts={"w": both})).placements[0].replicas == 3
    else:
        with pytest.raises(Infeasible, match="no cloud node can host"):
            plan(application(STORE), Inventory(hosts={"w": both}))


def test_plan_books_resources_of_placed_components():
    greedy = component("GroundViewer", "edge", locations=[{"center": at(0, 0), "radius": 5}])
    greedy["container"]["resources"] = {"requests": {"cpu": "3"}}
    other = component("Other", "edge", locations=[{"center": at(0, 0), "radius": 5}])
    other["container"]["resources"] = {"requests": {"cpu": "2"}}
    with pytest.raises(Infeasible, match=r"cpu: 2 requested, 1 free"):
        plan(application(greedy, other), inventory(edges=[edge("e1", (0, 0))]))


def test_plan_does_not_depend_on_inventory_order():
    edges = [edge(f"e{i}", (i * 40, (i % 3) * 20)) for i in range(9)]
    fleet = [drone(f"d{i}") for i in range(4)]
    app = application(navigator(PATH), VIEWER, CHECKER, STORE)
    first = plan(app, inventory(fleet, edges))
    for seed in range(5):
        shuffled = random.Random(seed)
        f = fleet[:]
        e = edges[:]
        shuffled.shuffle(f)
        shuffled.shuffle(e)
        assert plan(app, inventory(f, e)) == first


def test_replanning_keeps_placements_that_still_fit():
    edges = [edge("e5", (20, 0)), edge("e6", (30, 0))]
    viewer = component("GroundViewer", "edge", locations=[{"center": at(0, 0), "radius": 100}])
    app = application(viewer)
    before = plan(app, inventory(edges=[edges[1]]))
    assert nodes_of(plan(app, inventory(edges=edges), previous=before), "GroundViewer") == ["e6"]
    assert nodes_of(plan(app, inventory(edges=edges)), "GroundViewer") == ["e5"]


def test_operation_area_contains_whole_depot():
    result = plan(application(navigator(PATH)), inventory([drone("d")]), Settings(safety_radius_m=7))
    shape = shapely.union_all(
        [shapely.Polygon([FRAME.xy(lat, lon) for lon, lat in part[0]]) for part in result.operation_area["coordinates"]]
    )
    for x, y in ((-26, 0), (0, 26), (100, 6.9), (306, 0)):
        assert shape.covers(shapely.Point(x, y))
    for x, y in ((-28, 0), (200, 7.2), (310, 0)):
        assert not shape.covers(shapely.Point(x, y))


def test_instance_name_is_label_of_bounded_length():
    data_store = application(STORE).spec.component("DataStore")
    assert instance_name("traffic", data_store) == "traffic-data-store"
    shortened = instance_name("a" * 63, data_store, "node-1")
    assert len(shortened) <= 57
    assert shortened != instance_name("a" * 63, data_store, "node-2")
