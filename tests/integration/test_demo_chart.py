"""The chart fractus-demo: the example's surroundings on a cluster whose nodes have other names."""

from __future__ import annotations

import subprocess
from typing import Any

import yaml
from chart import CHARTS, KUBERNETES, helm

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
