"""Description of a node: the object from the agent, the owner's file, or neither."""

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
    """The files of a node."""

    def __init__(self, directory: Path) -> None:
        self.handed = directory / "node.json"
        self.file = directory / "node.yaml"

    def hand_over(self, pitch: float, name: str = "drone-1") -> None:
        NodeObjectFile(self.handed).write(Drone.from_body(drone(pitch, name)))

    def write(self, text: str) -> None:
        self.file.write_text(text)

    def describe(self, *kinds: type[Drone | EdgeNode], node: str | None = "drone-1") -> NodeDescription:
        return NodeDescription(node, self.handed, self.file, *(kinds or (Drone, EdgeNode)))


@pytest.fixture
def node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Node:
    monkeypatch.setattr(module, "POLL_INTERVAL_S", 0.01)
    return Node(tmp_path)


def pitch(found: NodeDescription) -> float | None:
    if found.value is None:
        return None
    camera = found.value.spec.services.camera
    assert camera is not None
    assert camera.mount is not None
    return camera.mount.pitch


def test_node_description_prefers_object_of_agent_to_file(node: Node) -> None:
    assert pitch(node.describe()) is None
    node.write(str(drone(-10)))
    assert pitch(node.describe()) == -10
    node.hand_over(-20)
    assert pitch(node.describe()) == -20


@pytest.mark.parametrize(
    "content", ["", "{", "[]", "\0", '{"kind": "Zone"}', str(drone(-20)).replace("mount", "mound")]
)
def test_node_description_is_empty_when_object_is_unreadable(node: Node, content: str) -> None:
    node.write(str(drone(-10)))
    node.handed.write_text(content)
    assert pitch(node.describe()) is None


def test_node_description_is_empty_when_object_is_emptied(node: Node) -> None:
    node.write(str(drone(-10)))
    node.hand_over(-20)
    NodeObjectFile(node.handed).clear("The agent cannot read the object.")
    assert pitch(node.describe()) is None


def test_node_object_file_accepts_any_text(node: Node) -> None:
    body = drone(-20)
    body["spec"]["services"]["camera"]["model"] = 'Kamera \U0001f681 é\x7f\u2028"\\'
    NodeObjectFile(node.handed).write(Drone.from_body(body))
    found = node.describe().value
    assert found is not None
    assert found.spec == Drone.from_body(body).spec


def test_node_description_ignores_object_of_another_node(node: Node) -> None:
    node.hand_over(-20, "drone-2")
    assert pitch(node.describe()) is None
    assert pitch(node.describe(node=None)) == -20
    assert pitch(node.describe(EdgeNode)) is None, "nor one of another kind"


def test_node_description_raises_at_start_when_file_is_unreadable(node: Node) -> None:
    node.write("kind: [")
    with pytest.raises(CannotServe, match="--description"):
        node.describe()


async def test_node_description_reports_each_change_once(node: Node) -> None:
    found = node.describe()

    async def changed() -> float | None:
        await asyncio.wait_for(found.changed(), 5)
        return pitch(found)

    node.write(str(drone(-10)))
    assert await changed() == -10
    node.hand_over(-20)
    assert await changed() == -20
    node.handed.touch()
    node.write(str(drone(-30)))
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(found.changed(), 0.1)
    node.handed.write_text("{")
    assert await changed() is None
    node.handed.unlink()
    assert await changed() == -30
    node.write("kind: [")
    assert await changed() is None, "whatever it was before"
