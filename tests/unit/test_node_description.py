"""Sources of a node description: the object stored by the agent, or the file of the owner."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from fractus_agent.registration.node_object_file import NodeObjectFile
from fractus_core.api.model import API_VERSION
from fractus_core.api.nodes import Drone, EdgeNode
from fractus_services import node_description as module
from fractus_services.node_description import NodeDescription
from fractus_services.options import CannotServe


def drone(pitch: float, name: str = "drone-1") -> dict[str, Any]:
    camera = {"methods": ["CaptureImage"], "horizontalFieldOfView": 60, "mount": {"pitch": pitch}}
    spec = {"services": {"camera": camera}}
    return {"apiVersion": API_VERSION, "kind": "Drone", "metadata": {"name": name}, "spec": spec}


class Node:
    """Files with the description of a node."""

    def __init__(self, directory: Path) -> None:
        self.object_path = directory / "node.json"
        self.file = directory / "node.yaml"

    def store_object(self, pitch: float, name: str = "drone-1") -> None:
        NodeObjectFile(self.object_path).write(Drone.from_body(drone(pitch, name)))

    def write(self, text: str) -> None:
        self.file.write_text(text)

    def describe(self, *kinds: type[Drone | EdgeNode], node: str | None = "drone-1") -> NodeDescription:
        return NodeDescription(node, self.object_path, self.file, *(kinds or (Drone, EdgeNode)))


@pytest.fixture
def node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Node:
    monkeypatch.setattr(module, "POLL_INTERVAL_S", 0.01)
    return Node(tmp_path)


def pitch(description: NodeDescription) -> float | None:
    if description.value is None:
        return None
    camera = description.value.spec.services.camera
    assert camera is not None
    assert camera.mount is not None
    return camera.mount.pitch


def test_node_description_prefers_object_of_agent_to_file(node: Node) -> None:
    assert pitch(node.describe()) is None
    node.write(str(drone(-10)))
    assert pitch(node.describe()) == -10
    node.store_object(-20)
    assert pitch(node.describe()) == -20


@pytest.mark.parametrize(
    "content", ["", "{", "[]", "\0", '{"kind": "Zone"}', str(drone(-20)).replace("mount", "mound")]
)
def test_node_description_is_empty_when_object_is_unreadable(node: Node, content: str) -> None:
    node.write(str(drone(-10)))
    node.object_path.write_text(content)
    assert pitch(node.describe()) is None


def test_node_description_is_empty_when_object_is_emptied(node: Node) -> None:
    node.write(str(drone(-10)))
    node.store_object(-20)
    NodeObjectFile(node.object_path).clear("The agent cannot read the object.")
    assert pitch(node.describe()) is None


def test_node_object_file_accepts_any_text(node: Node) -> None:
    body = drone(-20)
    body["spec"]["services"]["camera"]["model"] = 'Kamera \U0001f681 é\x7f\u2028"\\'
    NodeObjectFile(node.object_path).write(Drone.from_body(body))
    description = node.describe().value
    assert description is not None
    assert description.spec == Drone.from_body(body).spec


def test_node_description_ignores_object_of_another_node(node: Node) -> None:
    node.store_object(-20, "drone-2")
    assert pitch(node.describe()) is None
    assert pitch(node.describe(node=None)) == -20
    assert pitch(node.describe(EdgeNode)) is None, "an object of another kind is ignored too"


def test_node_description_raises_at_start_when_file_is_unreadable(node: Node) -> None:
    node.write("kind: [")
    with pytest.raises(CannotServe, match="--description"):
        node.describe()


async def test_node_description_reports_each_change_once(node: Node) -> None:
    description = node.describe()

    async def changed() -> float | None:
        await asyncio.wait_for(description.changed(), 5)
        return pitch(description)

    node.write(str(drone(-10)))
    assert await changed() == -10
    node.store_object(-20)
    assert await changed() == -20
    node.object_path.touch()
    node.write(str(drone(-30)))
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(description.changed(), 0.1)
    node.object_path.write_text("{")
    assert await changed() is None
    node.object_path.unlink()
    assert await changed() == -30
    node.write("kind: [")
    assert await changed() is None, "an unreadable file reports an unknown description"
