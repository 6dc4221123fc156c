"""Parsing and validation of cluster files, and their error messages."""

from __future__ import annotations

import copy
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest
import yaml
from fractus_cluster.errors import ClusterError
from fractus_cluster.spec import ClusterSpec, load_spec, parse_quantity, parse_spec

DEMO = Path(__file__).parents[2] / "examples" / "clusters" / "demo.yaml"

VALID: dict[str, Any] = {
    "name": "small",
    "nodes": [
        {
            "name": "drone-1",
            "class": "drone",
            "resources": {"cpu": 1, "memory": "2Gi", "fractus.dev/gpu": 2},
            "hardware": {"vehicle": {"home": {"lat": 50.0, "lon": 4.0, "alt": 25}}},
        },
        {"name": "cloud-1", "class": "cloud"},
    ],
}


def changed(path: str, value: object) -> dict[str, Any]:
    """Return the valid cluster with one field changed. The path consists of keys and indexes."""
    content = copy.deepcopy(VALID)
    *parents, last = path.split(".")
    parent: Any = content
    for part in parents:
        parent = parent[int(part)] if isinstance(parent, list) else parent[part]
    parent[last] = value
    return content


def test_demo_cluster_file_is_valid() -> None:
    spec = load_spec(DEMO)
    classes = [node.node_class for node in spec.nodes]
    assert classes.count("drone") == 1
    assert classes.count("edge") == 3
    assert classes.count("cloud") == 1
    assert spec.nodes[classes.index("drone")].vehicle() is not None


def test_cluster_spec_survives_yaml_round_trip() -> None:
    spec = load_spec(DEMO)
    assert parse_spec(yaml.safe_load(spec.to_yaml()), source="copy") == spec


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("name", "Demo", "name"),
        ("nodes.0.hardware.disk", {"size": "1Mi"}, "minimum size of a disk is 16Mi"),
        ("nodes.0.hardware.disk", {"size": "much"}, "not a quantity"),
        ("name", "x" * 31, "name"),
        ("nodes", [], "nodes"),
        ("nodes.0.class", "plane", "nodes[0].class"),
        ("nodes.0.name", "drone_1", "nodes[0].name"),
        ("nodes.1.name", "drone-1", "several nodes have the name drone-1"),
        ("nodes.0.resources", {"cpu": "two"}, "'two' is not a quantity"),
        ("nodes.0.resources", {"disk": "1Gi"}, "'disk'"),
        ("nodes.0.speed", 3, "nodes[0].speed"),
        ("nodes.0.hardware.vehicle.home", {"lat": 95, "lon": 4}, "nodes[0].hardware.vehicle.home.lat"),
        ("nodes.1.hardware", {"vehicle": {}}, "hardware.vehicle is for nodes of class drone"),
        ("nodes.1.description", {"depot": "d"}, "description is for drones and edge nodes"),
        ("nodes.0.description", {"colour": "red"}, "node drone-1: description"),
    ],
)
def test_invalid_cluster_file_error_names_field(path: str, value: object, message: str) -> None:
    with pytest.raises(ClusterError) as error:
        parse_spec(changed(path, value), source="cluster.yaml")
    assert message in str(error.value)
    assert str(error.value).startswith("cluster.yaml: ")
    assert "after validation, not 0" not in str(error.value) or value == []


def test_unreadable_cluster_file_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "cluster.yaml"
    file.write_text("name: [")
    with pytest.raises(ClusterError, match="invalid YAML"):
        load_spec(file)
    with pytest.raises(ClusterError, match="cannot read"):
        load_spec(tmp_path / "missing.yaml")


@pytest.mark.parametrize(
    ("text", "number"), [("2", 2), ("500m", Decimal("0.5")), ("4Gi", 4 * 2**30), ("1.5k", 1500), ("3M", 3_000_000)]
)
def test_quantity_is_parsed(text: str, number: Decimal | int) -> None:
    assert parse_quantity(text) == number


@pytest.mark.parametrize("text", ["", "Gi", "-1", "1 GB", "1..2", "1Xi"])
def test_invalid_quantity_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not a quantity"):
        parse_quantity(text)


def test_vehicle_has_home_of_the_hardware_section() -> None:
    home, listen, arguments = parse_spec(VALID, source="x").nodes[0].vehicle() or pytest.fail("no vehicle")
    assert (home.lat, home.lon, home.alt) == (50.0, 4.0, 25.0)
    assert listen == "tcp:127.0.0.1:5760"
    assert arguments == ()


def test_vehicle_without_home_is_refused() -> None:
    spec = parse_spec(changed("nodes.0.hardware", {"vehicle": {}}), source="x")
    with pytest.raises(ClusterError, match=r"hardware\.vehicle\.home"):
        spec.nodes[0].vehicle()


def test_drone_without_hardware_has_no_vehicle() -> None:
    assert parse_spec(changed("nodes.0.hardware", {}), source="x").nodes[0].vehicle() is None


def test_resources_with_a_domain_are_extended_resources() -> None:
    assert parse_spec(VALID, source="x").nodes[0].extended_resources == {"fractus.dev/gpu": "2"}


def test_node_manifest_contains_the_description() -> None:
    spec = load_spec(DEMO)
    edge = next(node for node in spec.nodes if node.node_class == "edge")
    assert edge.manifest is not None
    assert edge.manifest["kind"] == "EdgeNode"
    assert edge.manifest["metadata"] == {"name": edge.name}
    assert edge.manifest["spec"] == edge.description
    assert parse_spec(VALID, source="x").nodes[0].manifest is None


def test_placeholder_cluster_spec_is_valid() -> None:
    assert ClusterSpec.placeholder("gone").name == "gone"
