"""The chart fractus-demo: the example's surroundings on a cluster whose nodes have other names."""

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


def test_the_nodes_are_those_of_the_example_under_their_own_names() -> None:
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


def test_a_vehicle_of_ones_own_takes_the_place_of_the_simulated_one() -> None:
    made = objects("drone=d", "vehicle.enabled=false")
    assert "DaemonSet" not in {kind for kind, _ in made}
    assert ("Drone", "d") in made


def applications(*values: str) -> dict[str, dict[str, Any]]:
    """The applications that the chart keeps, by their names."""
    kept = objects("drone=d", *values)["ConfigMap", "demo-applications"]["data"]
    return {name: yaml.safe_load(text) for name, text in kept.items()}


def containers(application: dict[str, Any]) -> list[dict[str, Any]]:
    return [component["container"] for component in application["spec"]["components"]]


def test_it_keeps_the_applications_of_the_example() -> None:
    made = applications()
    for name in ("application.yaml", "passenger-only.yaml"):
        (body,) = example(name)
        assert made.pop(body["metadata"]["name"]) == body
    assert not made
    assert not {"Application"} & {kind for kind, _ in objects("drone=d")}


def test_the_example_comes_from_the_registry_of_the_chart() -> None:
    image = "registry.example:5000/f/example-traffic-monitoring:1.2.3"
    for body in applications("image.registry=registry.example:5000/f", "image.tag=1.2.3").values():
        assert {container["image"] for container in containers(body)} == {image}
        Application.model_validate(body)


def test_the_example_takes_resources_that_are_said() -> None:
    for body in applications("example.resources.requests.cpu=1m").values():
        assert all(container["resources"] == {"requests": {"cpu": "1m"}} for container in containers(body))
    assert applications("example=null") == applications(), "`helm upgrade --reuse-values` from a chart without it"


def test_what_helm_prints_applies_an_application_that_is_kept() -> None:
    notes = (CHARTS / "fractus-demo" / "templates" / "NOTES.txt").read_text()
    found = re.search(r"get configmap \{\{ \.Release\.Name \}\}-applications -o jsonpath='\{\.data\.([\w-]+)\}'", notes)
    assert found is not None
    assert found[1] in applications()


def test_without_a_drone_node_it_says_what_to_label() -> None:
    done = template()
    assert done.returncode != 0
    assert "no node has the label fractus.dev/class=drone; label one" in done.stderr


def test_values_that_mean_nothing_are_refused() -> None:
    for value, named in (
        ("vehicle.home=Leuven", "vehicle/home"),
        ("edgeNodes={a,b,c,d}", "edgeNodes"),
        ("dron=x", "dron"),
    ):
        done = template("drone=d", value)
        assert done.returncode != 0
        assert named in done.stderr
