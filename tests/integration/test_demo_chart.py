"""The chart fractus-demo: nodes, zones, policies and Applications of the example, with the node names of a cluster."""

from __future__ import annotations

import re
import subprocess
from typing import Any

import yaml
from chart import CHARTS, KUBERNETES, helm
from fractus_core.api import Application

EXAMPLE = CHARTS.parent / "examples" / "traffic-monitoring"


def template(*values: str) -> subprocess.CompletedProcess[str]:
    argv = [helm(), "template", "demo", str(CHARTS / "fractus-demo"), KUBERNETES]
    argv += [f"--set={value}" for value in values]
    return subprocess.run(argv, capture_output=True, text=True, timeout=60, check=False)


def objects(*values: str) -> dict[tuple[str, str], dict[str, Any]]:
    bodies = [body for body in yaml.safe_load_all(template(*values).stdout) if body]
    return {(body["kind"], body["metadata"]["name"]): body for body in bodies}


def example(name: str) -> list[dict[str, Any]]:
    return [body for body in yaml.safe_load_all((EXAMPLE / name).read_text()) if body]


def test_demo_chart_describes_example_nodes_by_cluster_names() -> None:
    made = objects("drone=kind-worker", "edgeNodes={kind-worker2,kind-worker3}")
    assert made["Drone", "kind-worker"]["spec"] == example("drone.yaml")[0]["spec"]
    places = example("edge-nodes.yaml")
    assert made["EdgeNode", "kind-worker2"]["spec"] == places[0]["spec"]
    assert made["EdgeNode", "kind-worker3"]["spec"] == places[1]["spec"]
    assert sum(kind == "EdgeNode" for kind, _ in made) == 2
    for name in ("depot.yaml", "zones.yaml", "policies.yaml"):
        for body in example(name):
            assert made[body["kind"], body["metadata"]["name"]] == body
    pod = made["DaemonSet", "demo-vehicle"]["spec"]["template"]["spec"]
    assert "kind-worker" in str(pod["affinity"])


def test_demo_chart_omits_vehicle_if_disabled() -> None:
    made = objects("drone=d", "vehicle.enabled=false")
    assert "DaemonSet" not in {kind for kind, _ in made}
    assert ("Drone", "d") in made


def applications(*values: str) -> dict[str, dict[str, Any]]:
    """Return the Applications in the chart's ConfigMap, by name."""
    data = objects("drone=d", *values)["ConfigMap", "demo-applications"]["data"]
    return {name: yaml.safe_load(text) for name, text in data.items()}


def containers(application: dict[str, Any]) -> list[dict[str, Any]]:
    return [component["container"] for component in application["spec"]["components"]]


def test_demo_chart_contains_applications_of_example() -> None:
    made = applications()
    for name in ("application.yaml", "passenger-only.yaml"):
        (body,) = example(name)
        assert made.pop(body["metadata"]["name"]) == body
    assert not made
    assert not {"Application"} & {kind for kind, _ in objects("drone=d")}


def test_demo_chart_applications_use_its_registry_and_tag() -> None:
    image = "registry.example:5000/f/example-traffic-monitoring:1.2.3"
    for body in applications("image.registry=registry.example:5000/f", "image.tag=1.2.3").values():
        assert {container["image"] for container in containers(body)} == {image}
        Application.model_validate(body)


def test_demo_chart_applications_have_configured_resources() -> None:
    for body in applications("example.resources.requests.cpu=1m").values():
        assert all(container["resources"] == {"requests": {"cpu": "1m"}} for container in containers(body))
    assert applications("example=null") == applications(), (
        "values without `example`, which `helm upgrade --reuse-values` keeps, change the result"
    )


def test_demo_chart_notes_name_existing_application() -> None:
    notes = (CHARTS / "fractus-demo" / "templates" / "NOTES.txt").read_text()
    match = re.search(r"get configmap \{\{ \.Release\.Name \}\}-applications -o jsonpath='\{\.data\.([\w-]+)\}'", notes)
    assert match is not None
    assert match[1] in applications()


def test_demo_chart_without_drone_node_fails_with_remedy() -> None:
    result = template()
    assert result.returncode != 0
    assert "no node has the label fractus.dev/class=drone; label a node" in result.stderr


def test_demo_chart_refuses_invalid_values() -> None:
    for value, named in (
        ("vehicle.home=Leuven", "vehicle/home"),
        ("edgeNodes={a,b,c,d}", "edgeNodes"),
        ("dron=x", "dron"),
    ):
        result = template("drone=d", value)
        assert result.returncode != 0
        assert named in result.stderr


def test_demo_chart_checks_its_drone_before_it_is_deleted() -> None:
    """Otherwise helm would delete zones, policies and the vehicle in flight before the API server refuses the Drone."""
    made = objects("drone=d")
    job = made["Job", "demo-uninstall"]
    annotations = job["metadata"]["annotations"]
    assert annotations["helm.sh/hook"] == "pre-delete"
    assert "hook-failed" not in annotations["helm.sh/hook-delete-policy"], "the log of a failed check must remain"
    pod = job["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    assert [*container["command"], *container["args"]][-3:] == ["fractus_operator.uninstall_check", "--drone", "d"]
    account = made["ServiceAccount", pod["serviceAccountName"]]
    assert "annotations" not in account["metadata"], "the account must exist before the hook runs"
    (rule,) = made["ClusterRole", "demo-uninstall"]["rules"]
    assert rule == {"apiGroups": ["fractus.dev"], "resources": ["drones"], "verbs": ["list"]}
    notes = (CHARTS / "fractus-demo" / "templates" / "NOTES.txt").read_text()
    assert "logs job/{{ .Release.Name }}-uninstall" in notes
