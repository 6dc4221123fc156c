"""Output, exit codes and input errors of `fractus plan`."""

import importlib.metadata
import json
import pathlib
import re

import pytest
import yaml
from click.testing import CliRunner
from fractus_cli import plan as command
from fractus_cli.manifests import read_manifests
from fractus_core.api import DeploymentPlan
from fractus_core.documents import dump_documents
from fractus_core.planning import Settings
from fractus_core.planning import plan as decide
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
    manifest,
    navigator,
    nodes_of,
)

EXAMPLE = pathlib.Path(__file__).parents[2] / "examples" / "traffic-monitoring"
DEPOT = manifest("Depot", "base", {"location": at(0, 0), "radius": 20})
VISITS = [at(120, 0), at(250, 3)]


def spec_only(resource):
    body = resource.to_dict()
    return {k: body[k] for k in ("apiVersion", "kind", "spec")} | {"metadata": {"name": resource.name}}


def named(app, name):
    body = spec_only(app)
    return body | {"metadata": {"name": name}}


TRAFFIC = named(application(navigator(PATH), VIEWER, CHECKER, STORE), "traffic")
SCENE = [DEPOT, spec_only(drone("d1")), spec_only(drone("d2")), spec_only(edge("e1", (150, 0)))]


def node(name, node_class, cpu="4", **more):
    status = {"allocatable": {"cpu": cpu}, "conditions": [{"type": "Ready", "status": "True"}]}
    return {
        "apiVersion": "v1",
        "kind": "Node",
        "metadata": {"name": name, "labels": {"fractus.dev/class": node_class}},
        "status": status,
        **more,
    }


def write(path, objects):
    path.write_text(dump_documents(objects))
    return path


@pytest.fixture
def run(tmp_path):
    def invoke(objects, *options):
        file = write(tmp_path / "all.yaml", objects)
        return CliRunner().invoke(command.plan, ["-f", str(file), *options])

    return invoke


def test_plan_table_lists_placements(run):
    result = run([*SCENE, TRAFFIC])
    assert result.exit_code == 0, result.output
    lines = result.output.splitlines()
    assert lines[0] == "default/traffic: feasible"
    assert lines[1].startswith("drone d1 flies ")
    assert any(line.split()[:4] == ["ImageChecker", "traffic-image-checker-e1", "e1", "hybrid-drone"] for line in lines)
    assert any("any cloud node, 3 replicas" in line for line in lines)


def test_plan_table_lists_possible_direct_links(run):
    lines = run([*SCENE, TRAFFIC]).output.splitlines()
    title = next(i for i, line in enumerate(lines) if line.startswith("DIRECT LINK TO"))
    assert lines[title + 1].split() == ["e1", "WiFi", "e1", "80", "m", "12", "Mbit/s", "ImageChecker"]


@pytest.mark.parametrize(("output", "parse"), [("yaml", yaml.safe_load), ("json", json.loads)])
def test_printed_plan_equals_the_plan_of_the_operator(run, tmp_path, output, parse):
    result = run([*SCENE, TRAFFIC], "-o", output)
    assert result.exit_code == 0
    printed = DeploymentPlan.from_body(parse(result.stdout))
    manifests = read_manifests([tmp_path / "all.yaml"])
    assert printed.spec == decide(manifests.applications()[0], manifests.inventory())
    assert (printed.name, printed.metadata.namespace) == ("traffic", "default")


def test_plan_geojson_has_area_route_and_nodes(run):
    result = run([*SCENE, TRAFFIC], "-o", "geojson")
    collection = json.loads(result.stdout)
    assert collection["type"] == "FeatureCollection"
    kinds = {f["properties"]["title"]: f["geometry"]["type"] for f in collection["features"]}
    assert kinds["operationArea"] == "MultiPolygon"
    assert kinds["route"] == "MultiLineString"
    points = {f["properties"]["node"]: f for f in collection["features"] if f["geometry"]["type"] == "Point"}
    assert set(points) == {"d1", "e1"}
    assert points["e1"]["geometry"]["coordinates"] == pytest.approx([at(150, 0)["lon"], at(150, 0)["lat"]])


def test_infeasible_plan_exits_with_2_and_reasons(run):
    result = run([DEPOT, spec_only(edge("e1", (150, 0))), TRAFFIC])
    assert result.exit_code == 2
    assert "default/traffic: infeasible (NoDrone)" in result.output
    result = run([DEPOT, spec_only(drone("d", minutes=2)), TRAFFIC], "-o", "yaml")
    assert result.exit_code == 2
    body = yaml.safe_load(result.stdout)
    assert "the mission takes" in body["metadata"]["annotations"]["fractus.dev/infeasible"]
    plan = DeploymentPlan.from_body(body).spec
    assert (plan.placements, plan.drone) == ((), None)
    assert [r.node for r in plan.rejected] == ["d"]
    assert "the mission takes" in plan.rejected[0].message
    assert "the mission takes" in result.stderr


def test_infeasible_plan_limits_listed_nodes(run, monkeypatch):
    monkeypatch.setattr(command, "_DEFAULTS", Settings(rejections_listed=1))
    drones = [spec_only(drone(f"d{i}", minutes=2)) for i in range(3)]
    spec = json.loads(run([DEPOT, *drones, TRAFFIC], "-o", "json").stdout)["spec"]
    assert (len(spec["rejected"]), spec["rejectedOmitted"]) == (1, 2)


def test_applications_never_get_the_same_drone(run):
    result = run(
        [
            DEPOT,
            spec_only(drone("d1")),
            named(application(navigator(PATH)), "a"),
            named(application(navigator(PATH)), "b"),
        ]
    )
    assert result.exit_code == 2
    assert "default/a: feasible" in result.output
    assert "default/b: infeasible (DroneBusy)" in result.output


def test_passenger_shares_drone_of_driver_in_the_same_manifests(run):
    guest = named(application(VIEWER | {"egress": [], "pointsOfInterest": {"points": VISITS}}), "a-guest")
    result = run([DEPOT, spec_only(drone("d1")), guest, named(application(navigator(PATH)), "host")], "-o", "json")
    assert result.exit_code == 0, result.output
    plans = {p["metadata"]["name"]: p["spec"] for p in json.loads(result.stdout)["items"]}
    assert plans["a-guest"]["drone"]["sharedWith"] == "default/host"
    reversed_guest = named(
        application(VIEWER | {"egress": [], "pointsOfInterest": {"points": VISITS[::-1]}}), "a-guest"
    )
    result = run([DEPOT, spec_only(drone("d1")), reversed_guest, named(application(navigator(PATH)), "host")])
    assert "default/a-guest: infeasible (DroneBusy)" in result.output


def test_node_objects_determine_resources_and_readiness(run):
    cloud = node("c", "cloud")
    flying = node("d1", "drone")
    result = run([*SCENE, TRAFFIC, cloud, flying, node("e1", "edge", cpu="50m")], "-o", "yaml")
    plan = DeploymentPlan.from_body(yaml.safe_load(result.stdout)).spec
    assert nodes_of(plan, "ImageChecker") == [None]
    assert {(r.node, r.reason) for r in plan.rejected} == {("e1", "InsufficientResources"), ("d2", "NodeMissing")}
    result = run([*SCENE, TRAFFIC, flying])
    assert "infeasible (NoCloudNode)" in result.output
    result = run([*SCENE, TRAFFIC, cloud, flying | {"spec": {"unschedulable": True}}])
    assert "d1: its Kubernetes Node is cordoned" in result.output


def test_bookings_of_one_application_reduce_capacity_for_the_next_application(run):
    big = component("Big", "edge", locations=[{"center": at(150, 0), "radius": 10}])
    big["container"]["resources"] = {"requests": {"cpu": "3"}}
    result = run([SCENE[3], node("e1", "edge"), *(named(application(big), n) for n in ("one", "two"))])
    assert "default/one: feasible" in result.output
    assert "default/two: infeasible (NoEdgeNode)" in result.output
    assert "cpu: 3 requested, 1 free" in result.output


def test_active_plan_is_kept(run, tmp_path):
    first = run([*SCENE[:2], TRAFFIC], "-o", "yaml").stdout.replace("d1", "d2")
    result = run([*SCENE, TRAFFIC, yaml.safe_load(first)], "-o", "yaml")
    assert DeploymentPlan.from_body(yaml.safe_load(result.stdout)).spec.drone.node == "d2"


def test_active_plan_claims_its_drone(run):
    active_plan = yaml.safe_load(
        run([DEPOT, spec_only(drone("d1")), named(application(navigator(PATH)), "z")], "-o", "yaml").stdout
    )
    apps = [named(application(navigator(PATH)), name) for name in "az"]
    result = run([DEPOT, spec_only(drone("d1")), spec_only(drone("d2", battery=0.5)), *apps, active_plan], "-o", "json")
    plans = {p["metadata"]["name"]: p["spec"] for p in json.loads(result.stdout)["items"]}
    assert {name: spec["drone"]["node"] for name, spec in plans.items()} == {"a": "d2", "z": "d1"}


def test_plan_of_the_example_is_feasible():
    result = CliRunner().invoke(
        command.plan,
        [
            "-f",
            str(EXAMPLE / "application.yaml"),
            *map(
                str,
                (EXAMPLE / f for f in ("depot.yaml", "drone.yaml", "edge-nodes.yaml", "policies.yaml", "zones.yaml")),
            ),
        ],
    )
    assert result.exit_code == 0, result.output
    assert "drone drone-1 flies" in result.output


def test_other_kinds_and_files_of_a_directory_are_ignored(tmp_path):
    (tmp_path / "deep").mkdir()
    write(
        tmp_path / "deep" / "scene.yml", [*SCENE, {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "x"}}]
    )
    write(tmp_path / "values.yaml", [{"replicas": 1}])
    (tmp_path / "list.json").write_text(json.dumps({"apiVersion": "v1", "kind": "List", "items": [TRAFFIC]}))
    result = CliRunner().invoke(command.plan, ["-f", str(tmp_path)])
    assert result.exit_code == 0, result.output


SELECTS = {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["nowhere"]}}
BOW_TIE = [{"lat": 0, "lon": 0}, {"lat": 1e-3, "lon": 1e-3}, {"lat": 0, "lon": 1e-3}, {"lat": 1e-3, "lon": 0}]


@pytest.mark.parametrize(
    ("objects", "sentence"),
    [
        ([DEPOT], "the manifests contain no Application"),
        ([{"replicas": 1}], "the document has no kind"),
        ([{"kind": "Drone", "metadata": {}}], "Drone: apiVersion: is missing; write fractus.dev/v1alpha1"),
        (
            [{"apiVersion": "fractus.dev/v1alpha1", "kind": "Drone"}],
            "Drone: metadata.name: must be a string; specify the name of the object",
        ),
        (
            [TRAFFIC | {"kind": "Aplication"}],
            "Aplication traffic: kind: fractus.dev has no kind Aplication; did you mean Application?",
        ),
        (
            [TRAFFIC | {"metadata": {"name": "t", "lables": {}}}],
            "Application t: metadata.lables: there is no such field",
        ),
        (
            [manifest("Drone", "d", {"depo": "base"})],
            "Drone d: spec.depo: there is no such field; did you mean depot?",
        ),
        ([TRAFFIC | {"spec": {"components": []}}], "Application traffic: spec.components: "),
        ([TRAFFIC], "Application traffic: spec.components[0].controlPoints[0].point.depot: there is no Depot base"),
        ([DEPOT, DEPOT], "Depot base: metadata.name: "),
        ([node("n", "edge", cpu="lots")], "Node n: status.allocatable.cpu: 'lots' is not a quantity"),
        ([node("n", "edge") | {"spec": "x"}], "Node n: spec: must be an object, not 'x'"),
        ([node("n", "edge") | {"status": {"allocatable": [1]}}], "Node n: status.allocatable: must be an object"),
        ([node("n", "edge") | {"status": {"conditions": ["Ready"]}}], "Node n: status.conditions: must be a list"),
        ([manifest("Policy", "p", SELECTS)], "p: spec.selector.zones[0]: Zone nowhere does not exist"),
        (
            [manifest("Zone", "z", {"area": {"polygon": {"exterior": BOW_TIE}}})],
            "z: spec.area.polygon.exterior: the ring crosses itself",
        ),
    ],
)
def test_invalid_manifest_exits_with_1_and_names_file_object_and_field(run, objects, sentence):
    result = run(objects)
    assert result.exit_code == 1
    assert result.stdout == ""
    assert sentence in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert sentence.startswith("the manifests contain no App") or re.search(r"all\.yaml:[0-9]+: ", result.stderr)


def test_kind_of_another_api_group_is_ignored(run):
    foreign = {"apiVersion": "argoproj.io/v1alpha1", "kind": "Application", "metadata": {"name": "a"}, "spec": {}}
    assert "the manifests contain no Application" in run([foreign]).stderr


def test_syntax_error_names_the_line(tmp_path):
    bad_yaml = tmp_path / "bad.yaml"
    bad_json = tmp_path / "bad.json"
    bad_yaml.write_text("kind: Drone\n  metadata: [")
    bad_json.write_text('{\n"kind": }')
    for file, line in ((bad_yaml, 2), (bad_json, 2)):
        result = CliRunner().invoke(command.plan, ["-f", str(file)])
        assert result.exit_code == 1
        assert f"{file}:{line}: " in result.stderr
    result = CliRunner().invoke(command.plan, ["-f", str(tmp_path / "bad.yaml"), "--ranking", "best"])
    assert result.exit_code == 1


def test_unknown_plugin_is_named(run):
    result = run([*SCENE, TRAFFIC], "--ranking", "best")
    assert result.exit_code == 1
    assert "--ranking: plug-in best is not installed" in result.stderr


def test_plugins_are_found_by_entry_point(run, monkeypatch):
    class Entry:
        name = "last"
        value = "module:last"

        def load(self):
            return lambda facts: facts.drone.name == "d2"

    monkeypatch.setattr(
        importlib.metadata, "entry_points", lambda group: [Entry()] if group == "fractus.planning" else []
    )
    result = run([*SCENE, TRAFFIC], "--ranking", "last")
    assert "drone d2 flies" in result.output


FENCE = manifest(
    "Policy", "keep-out", {"type": "GeofenceControl", "kind": "exclusion", "selector": {"zones": ["square"]}}
)
SQUARE = manifest("Zone", "square", {"area": {"circle": {"center": at(200, 0), "radius": 20}}})


def test_policy_conflict_is_reported_or_forbidden(run):
    reported = run([TRAFFIC, *SCENE, FENCE, SQUARE])
    assert reported.exit_code == 0
    end = at(300, 0)
    assert f"policy conflict: policies do not allow the leg to {end['lat']:.6f}, {end['lon']:.6f}" in reported.stdout
    assert re.search(
        r"driver +Denied +LegThroughExclusionZone +the leg crosses zone square for 40.0 m", reported.stdout
    )
    written = yaml.safe_load(run([TRAFFIC, *SCENE, FENCE, SQUARE], "-o", "yaml").stdout)
    assert written["spec"]["drone"]["legality"][0]["policies"] == ["keep-out"]
    assert DeploymentPlan.from_body(written).spec.drone.policy_conflict is not None
    forbidden = run([TRAFFIC, *SCENE, FENCE, SQUARE], "--policy-conflicts", "forbid")
    assert forbidden.exit_code == 2
    assert "infeasible (PolicyConflict)" in forbidden.stdout


def test_policies_are_judged_at_the_specified_time(run):
    past = FENCE | {"spec": FENCE["spec"] | {"validUntil": "2026-01-01T00:00:00Z"}}
    for time, conflict in (("2025-06-01T12:00:00Z", True), ("2026-06-01T12:00:00Z", False)):
        result = run([TRAFFIC, *SCENE, past, SQUARE], "--time", time)
        assert ("policy conflict" in result.stdout) == conflict
