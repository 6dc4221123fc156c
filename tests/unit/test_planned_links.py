"""Direct links derived from a plan."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import yaml
from fractus_core.api import Application, Drone, EdgeNode
from fractus_core.api.components import Heuristic
from fractus_core.planning.link_planning import DEFAULT_HEURISTIC, flown_path, plan_links
from test_link_builders import APPLICATION, DEPOTS, DRONE, EDGES, INPUT, PATH, PLAN, PLANNED

Body = dict[str, Any]


def application(change: str = "{}", component: str = "ImageChecker") -> Application:
    """Return the application with changed fields of one component. `change` is YAML, and null removes a field."""
    body = copy.deepcopy(INPUT["application"])
    for part in body["spec"]["components"]:
        if part["name"] == component:
            part.update(yaml.safe_load(change))
            for field in [name for name, value in part.items() if value is None]:
                del part[field]
    return Application.from_body(body)


def drone(*interfaces: Body) -> Drone:
    return Drone.from_body({**INPUT["drone"], "spec": {"interfaces": list(interfaces)}})


def edge(*interfaces: Body) -> dict[str, EdgeNode]:
    body = copy.deepcopy(INPUT["edgeNodes"][0])
    body["spec"]["interfaces"] = list(interfaces)
    return {"edge-1": EdgeNode.from_body(body)}


def wifi(range_m: float | None, mode: str = "adhoc", **more: Any) -> Body:
    reach = {} if range_m is None else {"range": range_m}
    return {
        "technology": "WiFi",
        "device": "wlan0",
        "pairing": {"mode": mode, "networkId": more.pop("network", "n")},
        **reach,
        **more,
    }


def test_link_range_is_limited_by_both_ends() -> None:
    first, second = PLANNED
    assert (first.node, first.range_m, first.bandwidth_mbps, first.pairing.network_id) == ("edge-1", 80, 12, "edge-1")
    assert (second.node, second.range_m, second.bandwidth_mbps, second.pairing.network_id) == (
        "edge-2",
        120,
        12,
        "edge-2",
    )
    assert first.heuristic == Heuristic(kind="max", metric="ingress-bandwidth")
    assert [p.instance for p in first.instances] == ["traffic-image-checker-edge-1"]


def test_link_uses_first_interface_with_device() -> None:
    two = edge(wifi(500, network="no device", device=None), wifi(50, network="first"), wifi(90, network="second"))
    (link,) = plan_links(APPLICATION, PLAN, DRONE, two)
    assert (link.range_m, link.pairing.network_id) == (50, "first")


@pytest.mark.parametrize("aboard", [
    (), ({"technology": "4G"},), (wifi(None),), (wifi(100, "infrastructure"),), (wifi(100, device=None),),
    (wifi(100) | {"pairing": None},), (wifi(100) | {"technology": "BLE"},),
])  # fmt: skip
def test_link_is_not_planned_for_incompatible_interfaces(aboard: tuple[Body, ...]) -> None:
    assert plan_links(APPLICATION, PLAN, drone(*aboard), edge(wifi(100))) == ()
    assert plan_links(APPLICATION, PLAN, drone(wifi(100)), edge(*aboard)) == ()


def test_link_is_not_planned_for_deleted_nodes() -> None:
    assert plan_links(APPLICATION, PLAN, None, EDGES) == ()
    assert [link.node for link in plan_links(APPLICATION, PLAN, DRONE, {"edge-2": EDGES["edge-2"]})] == ["edge-2"]


@pytest.mark.parametrize(("change", "linked"), [
    ("{heuristic: null}", True),
    ("{placement: cloud, hybridTo: null, heuristic: null}", False),
])  # fmt: skip
def test_link_is_planned_only_for_hybrid_components_with_ports(change: str, linked: bool) -> None:
    links = plan_links(application(change), PLAN, DRONE, EDGES)
    assert [link.node for link in links] == (["edge-1", "edge-2"] if linked else [])
    assert all(link.heuristic == DEFAULT_HEURISTIC for link in links)


GROUND = {"name": "GroundViewer", "placement": "edge", "locations": [{"center": {"lat": 39.36, "lon": 22.93}, "radius": 9}],
          "container": {"image": "a"}}  # fmt: skip


@pytest.mark.parametrize(("checker", "viewer", "linked"), [
    ("{hybridTo: [GroundViewer]}", "{egress: null}", False),
    ("{hybridTo: [GroundViewer], ingress: [AerialViewer]}", "{egress: null}", True),
    ("{hybridTo: [GroundViewer]}", "{egress: [ImageChecker]}", True),
    ("{hybridTo: [AerialViewer]}", "{egress: null}", True),
    ("{hybridTo: [AerialViewer], container: {image: a}}", "{egress: null}", False),
])  # fmt: skip
def test_link_is_planned_only_for_components_called_from_drone(checker: str, viewer: str, linked: bool) -> None:
    body = copy.deepcopy(INPUT["application"])
    parts = {part["name"]: part for part in body["spec"]["components"]}
    parts["ImageChecker"].update(yaml.safe_load(checker))
    parts["AerialViewer"].update(yaml.safe_load(viewer))
    if parts["AerialViewer"]["egress"] is None:
        del parts["AerialViewer"]["egress"]
    body["spec"]["components"].append(GROUND)
    assert bool(plan_links(Application.from_body(body), PLAN, DRONE, EDGES)) is linked


# -- the path --


def test_link_path_is_waypoints_of_driver() -> None:
    assert [(p.lat, p.lon, p.alt) for p in PATH] == [(39.3595, 22.9295, None), (39.36, 22.93, 20), (39.361, 22.931, 30)]


def test_link_path_is_unknown_for_region_navigation() -> None:
    region = "{navigation: regionBased, region: {circle: {center: {lat: 39.36, lon: 22.93}, radius: 50}}, duration: 1}"
    path = "{navigation: pathBased, path: [{lat: 39.36, lon: 22.93}]}"
    roaming = application(f"{{control: partial, controlPoints: [{path}, {region}]}}", "Navigator")
    assert flown_path(roaming.spec, DEPOTS) == ()


@pytest.mark.parametrize(("points", "listed"), [(1000, 1000), (1001, 0)])
def test_link_path_is_omitted_when_too_long(points: int, listed: int) -> None:
    places = [{"lat": 39 + i * 1e-5, "lon": 22.93} for i in range(points)]
    body = copy.deepcopy(INPUT["application"])
    driver = body["spec"]["components"][0]
    driver["control"] = "partial"
    driver["controlPoints"] = [{"navigation": "pathBased", "path": half} for half in (places[:500], places[500:])]
    assert len(flown_path(Application.from_body(body).spec, DEPOTS)) == listed


def test_link_path_has_points_of_interest_in_tour_order() -> None:
    east = [22.9300, 22.9340, 22.9310, 22.9330]
    points = [{"lat": 39.36, "lon": lon} for lon in east]
    component = {
        "name": "Viewer", "placement": "drone", "class": "passenger", "container": {"image": "a"},
        "pointsOfInterest": {"points": points, "ordered": False},
    }  # fmt: skip
    body = {**INPUT["application"], "spec": {"components": [component]}}
    assert [p.lon for p in flown_path(Application.from_body(body).spec, DEPOTS)] == [22.9300, 22.9310, 22.9330, 22.9340]
