"""Manifests of the traffic example: they are valid and consistent, and result in the plan that the demo shows."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from fractus.environment import control_points
from fractus_cluster import hardware
from fractus_cluster.hardware import hardware_commands
from fractus_cluster.spec import load_spec
from fractus_core.api import KINDS, Application, Depot, Drone, EdgeNode, Policy, Resource, Zone
from fractus_core.geo import geodesic_m
from fractus_core.planning import Host, Inventory, plan
from fractus_core.planning.grant_compiler import compile_grants
from fractus_core.policy.compiled_grant import compile_grant
from fractus_core.policy.decision_types import Call, GotoArgs, Home, SetSpeedArgs, Situation
from fractus_core.policy.engine import judge
from fractus_core.validation import check_application, check_policy, check_zone

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "traffic-monitoring"
BY_KIND = {kind.KIND: kind for kind in KINDS}


def load(name: str) -> list[Resource]:
    documents = yaml.safe_load_all((EXAMPLE / name).read_text())
    return [BY_KIND[d["kind"]].from_body(d) for d in documents if d["kind"] in BY_KIND]


def named(name: str) -> dict[str, Any]:
    return {resource.name: resource for resource in load(name)}


@pytest.fixture(scope="module")
def inventory() -> Inventory:
    spec = load_spec(ROOT / "examples" / "clusters" / "demo.yaml")
    hosts = {
        node.name: Host(
            name=node.name,
            labels={"fractus.dev/class": node.node_class},
            allocatable={"cpu": 1.0, "memory": 2.0**31, "fractus.dev/gpu": 1.0, "pods": 50.0},
            ready=True,
            schedulable=True,
        )
        for node in spec.nodes
    }
    ready = {"type": "Ready", "status": "True", "reason": "Ok", "lastTransitionTime": "2026-01-01T00:00:00Z"}
    status = {"flightState": "inactive", "battery": {"remaining": 1.0}, "conditions": [ready]}
    drones = [Drone.from_body({**n.manifest, "status": status}) for n in spec.nodes if n.node_class == "drone"]
    edges = [EdgeNode.from_body(n.manifest) for n in spec.nodes if n.node_class == "edge"]
    return Inventory(
        hosts=hosts,
        drones={d.name: d for d in drones},
        edge_nodes={e.name: e for e in edges},
        depots=named("depot.yaml"),
        zones=named("zones.yaml"),
        policies=named("policies.yaml"),
        claimed={},
    )


@pytest.fixture(scope="module")
def application() -> Application:
    (submitted,) = load("application.yaml")
    assert isinstance(submitted, Application)
    return submitted


@pytest.mark.parametrize("path", sorted(EXAMPLE.glob("*.yaml")), ids=lambda path: path.name)
def test_example_manifest_is_valid(path: Path) -> None:
    assert load(path.name)


def test_example_objects_reference_existing_objects(inventory: Inventory, application: Application) -> None:
    (passenger,) = load("passenger-only.yaml")
    assert isinstance(passenger, Application)
    check_application(application, inventory.depots)
    check_application(passenger, inventory.depots)
    for zone in inventory.zones.values():
        check_zone(zone)
    for policy in inventory.policies.values():
        check_policy(policy, inventory.zones)


def test_demo_cluster_nodes_match_the_manifests() -> None:
    spec = load_spec(ROOT / "examples" / "clusters" / "demo.yaml")
    described = {n.name: BY_KIND[n.manifest["kind"]].from_body(n.manifest) for n in spec.nodes if n.manifest}
    drone = described["drone-1"].to_dict()["spec"]
    camera = drone["services"]["camera"]
    assert camera["connection"] == "http://127.0.0.1:8090/snapshot.jpg"
    camera["connection"] = "test:"  # the manifest must also work in clusters without a simulated camera
    assert {k: v.to_dict()["spec"] for k, v in described.items()} | {"drone-1": drone} == {
        k: v.to_dict()["spec"] for k, v in {**named("drone.yaml"), **named("edge-nodes.yaml")}.items()
    }


def test_demo_camera_command_matches_the_drone_manifest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hardware.shutil, "which", lambda name: f"/bin/{name}")
    spec = load_spec(ROOT / "examples" / "clusters" / "demo.yaml")
    commands = {node.name: hardware_commands(node, spec.world_origin) for node in spec.nodes}
    vehicle = commands["drone-1"]["vehicle"]
    camera = commands["drone-1"]["camera"]
    options = dict(itertools.pairwise(camera))
    assert options["--listen"] == "127.0.0.1:8090"
    assert options["--vehicle"] in vehicle
    described = named("drone.yaml")["drone-1"].spec.services.camera
    assert float(options["--fov"]) == described.horizontal_field_of_view
    assert (options["--resolution"], float(options["--mount-pitch"])) == (described.resolution, described.mount.pitch)
    assert not any(commands[name] for name in commands if name != "drone-1")


def test_demo_plan_uses_near_edge_nodes_and_rejects_edge_3(inventory: Inventory, application: Application) -> None:
    spec = plan(application, inventory)
    on = {name: {p.node for p in spec.placements if p.component == name} for name in ("GroundViewer", "ImageChecker")}
    assert spec.drone is not None
    assert spec.drone.node == "drone-1"
    assert on["GroundViewer"] == {"edge-1", "edge-2"}
    assert on["ImageChecker"] == {"edge-1", "edge-2", None}
    assert {(r.component, r.reason) for r in spec.rejected if r.node == "edge-3"} == {
        ("GroundViewer", "OutsideLocation"),
        ("ImageChecker", "NoCoverage"),
    }


def test_passenger_only_application_is_planned(inventory: Inventory) -> None:
    (passenger,) = load("passenger-only.yaml")
    assert isinstance(passenger, Application)
    spec = plan(passenger, inventory)
    assert spec.drone is not None


def test_demo_flight_is_legal_except_for_the_shown_violations(inventory: Inventory, application: Application) -> None:
    """The engine judges each leg for a drone that hovers at the previous waypoint."""
    grants = compile_grants(application, plan(application, inventory), inventory)
    grant = compile_grant(next(g for g in grants if g.component == "Navigator"))
    depot = inventory.depots["depot-1"].spec.location
    home = Home(depot.lat, depot.lon, 25.0)
    driver = application.spec.driver
    assert driver is not None
    path = driver.control_points[0].path or ()
    legs = itertools.pairwise([(depot.lat, depot.lon, path[0].alt), *((w.lat, w.lon, w.alt) for w in path)])
    verdicts = []
    altitude = path[0].alt or 0.0
    for start, target in legs:
        situation = Situation(
            time_s=1.8e9, lat=start[0], lon=start[1], altitude_m=altitude, home=home, armed=True, in_air=True,
            speed_setpoint_mps=10.0,
        )  # fmt: skip
        verdict = judge(Call("Goto", GotoArgs(*target)), situation, grant)
        assert isinstance(verdict.args, GotoArgs), verdict
        altitude = verdict.args.alt or 0.0
        verdicts.append((verdict.action, altitude))
    assert verdicts == [("allow", 20), ("allow", 20), ("correct", 49.8), ("allow", 40), ("allow", 25)]

    before = Situation(
        time_s=1.8e9, lat=path[1].lat, lon=path[1].lon, altitude_m=20, home=home, armed=True, in_air=True
    )
    env = {e.name: e.value for e in driver.container.env}
    detour = judge(Call("Goto", GotoArgs(*(float(p) for p in env["DETOUR"].split(",")))), before, grant)
    assert (detour.action, detour.code) == ("deny", "InsideExclusionZone")
    assert detour.policies[0] == "no-fly-hospital"
    speed = judge(Call("SetSpeed", SetSpeedArgs(12.0)), before, grant)
    assert (speed.action, speed.policies) == ("correct", ("town-speed",))


def test_navigator_path_is_read_from_the_environment(application: Application) -> None:
    driver = application.spec.driver
    assert driver is not None
    (point,) = control_points({"FRACTUS_CONTROL_POINTS": json.dumps([p.to_dict() for p in driver.control_points])})
    assert [p.alt for p in point.path] == [20, 20, 70, 40, 25]


def test_demo_flight_is_600_to_1000_m_long(inventory: Inventory, application: Application) -> None:
    driver = application.spec.driver
    assert driver is not None
    depot = inventory.depots["depot-1"].spec.location
    points = [depot, *(driver.control_points[0].path or ()), depot]
    length_m = sum(geodesic_m(a, b) for a, b in itertools.pairwise(points))
    assert 600 < length_m < 1000


def test_manifest_files_contain_only_their_kinds() -> None:
    assert all(isinstance(z, Zone) for z in load("zones.yaml"))
    assert {type(p) for p in load("policies.yaml")} == {Policy}
    assert {type(d) for d in load("depot.yaml")} == {Depot}
    assert {p.spec.type for p in load("policies.yaml") if isinstance(p, Policy)} == {
        "AccessControl", "LimitControl", "GeofenceControl", "PrivacyControl",
    }  # fmt: skip
