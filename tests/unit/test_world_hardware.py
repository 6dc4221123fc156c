"""Command lines of the simulated cameras and vehicles of a cluster file."""

from __future__ import annotations

import copy
import sys
from pathlib import Path
from typing import Any

import pytest
from fractus_cluster import hardware
from fractus_cluster.errors import ClusterError
from fractus_cluster.hardware import hardware_commands
from fractus_cluster.spec import ClusterSpec, parse_spec

CAMERA = {
    "connection": "http://127.0.0.1:8090/snapshot.jpg",
    "resolution": "1280x720",
    "horizontalFieldOfView": 70,
    "methods": ["CaptureImage"],
}
DRONE: dict[str, Any] = {
    "name": "drone-1",
    "class": "drone",
    "hardware": {"vehicle": {"home": {"lat": 50.0, "lon": 4.0, "alt": 25}}, "camera": {}},
    "description": {
        "depot": "depot-1",
        "services": {
            "mobility": {
                "connection": "tcp:127.0.0.1:5760",
                "maxAltitude": 80,
                "maxFlightTime": 15,
                "maxSpeed": 15,
                "methods": ["Goto"],
            },
            "camera": CAMERA | {"mount": {"pitch": -60, "stabilised": True}},
        },
    },
}
EDGE: dict[str, Any] = {
    "name": "edge-1",
    "class": "edge",
    "hardware": {"camera": {}},
    "description": {
        "location": {"lat": 50.001, "lon": 4.001},
        "services": {"camera": CAMERA | {"mount": {"pitch": -20, "yaw": 90, "height": 6}}},
    },
}


def cluster(*nodes: dict[str, Any]) -> ClusterSpec:
    return parse_spec({"name": "test", "nodes": list(nodes)}, source="x")


@pytest.fixture(autouse=True)
def programs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("fractus-vehicle", "fractus-camera-world"):
        (tmp_path / name).touch(0o755)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))


def option(command: list[str], name: str) -> str:
    return command[command.index(name) + 1]


def test_drone_camera_command_follows_its_description() -> None:
    spec = cluster(DRONE)
    commands = hardware_commands(spec.nodes[0], spec.world_origin)
    camera = commands["camera"]
    assert option(camera, "--listen") == "127.0.0.1:8090"
    assert option(camera, "--resolution") == "1280x720"
    assert float(option(camera, "--fov")) == 70
    assert float(option(camera, "--mount-pitch")) == -60
    assert "--stabilised" in camera
    assert option(camera, "--vehicle") in commands["vehicle"], (
        "the vehicle must listen at the address that the camera connects to"
    )
    assert "tcp:127.0.0.1:5760" in commands["vehicle"]


def test_edge_node_camera_is_fixed_and_shares_the_world_origin() -> None:
    spec = cluster(DRONE, EDGE)
    camera = hardware_commands(spec.nodes[1], spec.world_origin)["camera"]
    assert option(camera, "--pose") == "50.001,4.001,6.0"
    assert option(camera, "--origin") == "50.0,4.0", "the home of the drone is the world origin"
    assert "--vehicle" not in camera
    assert float(option(camera, "--mount-yaw")) == 90


def test_node_without_camera_has_no_camera_command() -> None:
    spec = cluster(DRONE | {"hardware": {"vehicle": DRONE["hardware"]["vehicle"]}})
    commands = hardware_commands(spec.nodes[0], spec.world_origin)
    assert set(commands) == {"vehicle"}
    assert spec.world_origin is None
    assert commands["vehicle"].count("--listen") == 1


def test_specified_origin_and_seed_are_used() -> None:
    drone = copy.deepcopy(DRONE)
    drone["hardware"]["camera"] = {"origin": {"lat": 49.5, "lon": 3.5}, "seed": 3}
    spec = cluster(drone)
    assert option(hardware_commands(spec.nodes[0], spec.world_origin)["camera"], "--origin") == "49.5,3.5"
    assert option(hardware_commands(spec.nodes[0], spec.world_origin)["camera"], "--seed") == "3"


@pytest.mark.parametrize(
    ("node", "path", "value", "message"),
    [
        (DRONE, ("description", "services", "camera", "connection"), "test:", r"services\.camera\.connection"),
        (DRONE, ("description", "services", "camera", "connection"), "http://10.0.0.1/snapshot.jpg", "127.0.0.1:8090"),
        (DRONE, ("hardware", "camera"), {"sead": 1}, "sead"),
        (DRONE, ("hardware", "camera"), {"origin": {"lat": 89, "lon": 0}}, r"origin\.lat"),
        (EDGE, ("description", "services", "camera", "mount"), {}, r"mount\.height"),
        (EDGE, ("class",), "cloud", "hardware.camera is for drones and edge nodes"),
    ],
)
def test_invalid_camera_configuration_error_names_field(
    node: dict[str, Any], path: tuple[str, ...], value: object, message: str
) -> None:
    changed = copy.deepcopy(node)
    parent = changed
    for key in path[:-1]:
        parent = parent[key]
    parent[path[-1]] = value
    with pytest.raises(ClusterError, match=message):
        cluster(changed)


def test_missing_camera_program_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "fractus-camera-world").unlink()
    monkeypatch.setattr(hardware.shutil, "which", lambda _: None)
    spec = cluster(DRONE)
    with pytest.raises(ClusterError, match="fractus-camera-world is not installed"):
        hardware_commands(spec.nodes[0], spec.world_origin)
