"""Registration of a node: creation of its object, changes by the owner, and changed description files."""

import copy
from pathlib import Path
from typing import Any

import pytest
import yaml
from fractus_agent.registration.node_object_file import NodeObjectFile
from fractus_agent.registration.registration import (
    HASH_ANNOTATION,
    Registration,
    description_hash,
    parse_node_description,
)
from fractus_agent.store import Invalid
from fractus_core.api.nodes import CameraMount, Drone, InvalidDescription, parse_description

MANIFEST: dict[str, Any] = {
    "apiVersion": "fractus.dev/v1alpha1",
    "kind": "Drone",
    "metadata": {"name": "drone-1", "labels": {"fleet": "north"}},
    "spec": {
        "interfaces": [{"technology": "WiFi"}, {"technology": "4G"}],
        "services": {
            "mobility": {"maxAltitude": 120, "maxFlightTime": 25, "maxSpeed": 15, "methods": ["Goto", "GetPosition"]}
        },
        "depot": "campus",
    },
}


class FakeStore:
    """Fake store with the object and labels of one node. It sets metadata like an API server."""

    def __init__(self) -> None:
        self.object: dict[str, Any] | None = None
        self.labels: dict[str, str] | None = {"fractus.dev/class": "drone", "other": "x"}
        self.writes = 0
        self.refuse = False

    async def node_labels(self) -> dict[str, str] | None:
        return None if self.labels is None else dict(self.labels)

    async def node_object(self, kind: str) -> dict[str, Any] | None:
        return copy.deepcopy(self.object) if self.object and self.object["kind"] == kind else None

    async def create(self, body: dict[str, Any]) -> dict[str, Any]:
        assert self.object is None
        if self.refuse:
            raise Invalid(422, "Invalid", "spec.depot: no")
        return self._store(body, 1)

    async def replace(self, body: dict[str, Any]) -> dict[str, Any]:
        assert self.object is not None
        assert body["metadata"]["resourceVersion"] == self.object["metadata"]["resourceVersion"]
        return self._store(body, self.object["metadata"]["generation"] + (body["spec"] != self.object["spec"]))

    def _store(self, body: dict[str, Any], generation: int) -> dict[str, Any]:
        self.writes += 1
        body = copy.deepcopy(body)
        body["metadata"] |= {"resourceVersion": str(self.writes), "generation": generation, "uid": "u"}
        self.object = body
        return copy.deepcopy(body)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "node.yaml"
    file.write_text(yaml.safe_dump(MANIFEST))
    return file


def write(path: Path, text: str) -> None:
    path.write_text(text)


def edited(**spec: Any) -> str:
    return yaml.safe_dump(MANIFEST | {"spec": MANIFEST["spec"] | spec})


def registration_of(store: FakeStore, path: Path) -> Registration:
    return Registration(store, path, "drone-1", NodeObjectFile(path.with_name("node.json")))  # type: ignore[arg-type]


async def test_registration_creates_the_object_once(path: Path) -> None:
    store = FakeStore()
    for _ in range(3):
        await registration_of(store, path).step()
    assert store.writes == 1
    assert store.object is not None
    assert store.object["metadata"]["labels"] == {"fleet": "north"}
    assert store.object["spec"]["depot"] == "campus"


async def test_registration_keeps_the_owners_edits(path: Path) -> None:
    store = FakeStore()
    registration = registration_of(store, path)
    await registration.step()
    assert store.object is not None
    store.object["spec"]["depot"] = "harbour"
    store.object["metadata"]["generation"] += 1
    write(path, "# a comment\n" + yaml.safe_dump(MANIFEST, default_flow_style=True))
    await registration.step()
    await registration_of(store, path).step()
    assert store.writes == 1
    assert store.object["spec"]["depot"] == "harbour"


async def test_changed_description_is_applied_once(path: Path) -> None:
    store = FakeStore()
    registration = registration_of(store, path)
    await registration.step()
    write(path, edited(depot="airfield", interfaces=[]))
    await registration.step()
    await registration.step()
    assert store.writes == 2
    assert store.object is not None
    assert store.object["spec"]["depot"] == "airfield"
    assert store.object["metadata"]["labels"] == {"fleet": "north"}


async def test_existing_object_of_the_owner_is_adopted_unchanged(path: Path) -> None:
    store = FakeStore()
    store.object = {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "Drone",
        "metadata": {"name": "drone-1", "generation": 4, "resourceVersion": "9"},
        "spec": {"depot": "mine"},
    }
    await registration_of(store, path).step()
    assert store.object["spec"] == {"depot": "mine"}
    assert HASH_ANNOTATION in store.object["metadata"]["annotations"]


async def test_registration_without_description_waits_for_the_owners_object(tmp_path: Path) -> None:
    store = FakeStore()
    registration = registration_of(store, tmp_path / "node.yaml")
    await registration.step()
    assert registration.body is None
    assert store.writes == 0
    store.object = {
        "apiVersion": "fractus.dev/v1alpha1",
        "kind": "Drone",
        "metadata": {"name": "drone-1", "generation": 1, "resourceVersion": "1"},
        "spec": {},
    }
    await registration.step()
    assert registration.body is not None
    assert registration.description_problem is None


async def test_deleted_object_is_registered_again(path: Path) -> None:
    store = FakeStore()
    registration = registration_of(store, path)
    await registration.step()
    store.object = None
    registration.on_status_written(None)
    assert registration.body is None
    await registration.step()
    assert store.object is not None


async def test_invalid_description_is_reported_and_the_object_is_kept(path: Path) -> None:
    store = FakeStore()
    registration = registration_of(store, path)
    await registration.step()
    before = copy.deepcopy(store.object)
    write(path, edited(depot="No Such Name!"))
    await registration.step()
    assert store.object == before
    assert registration.description_problem is not None
    assert "spec.depot" in registration.description_problem.message
    write(path, edited())
    await registration.step()
    assert registration.description_problem is None


async def test_object_refused_by_the_api_server_is_reported(path: Path) -> None:
    store = FakeStore()
    store.refuse = True
    registration = registration_of(store, path)
    with pytest.raises(Invalid):
        await registration.step()
    assert registration.description_problem is not None
    assert "spec.depot: no" in registration.description_problem.message
    assert registration.body is None


async def test_description_of_another_node_class_is_refused(path: Path) -> None:
    store = FakeStore()
    store.labels = {"fractus.dev/class": "edge"}
    registration = registration_of(store, path)
    await registration.step()
    assert store.object is None
    assert registration.description_problem is not None
    assert "EdgeNode" in registration.description_problem.message


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [", "invalid YAML"),
        ("- 1", "kind"),
        ("kind: Depot", "kind"),
        (yaml.safe_dump(MANIFEST).replace("drone-1", "drone-2"), "metadata.name: is drone-2"),
        (yaml.safe_dump(MANIFEST).replace("maxSpeed: 15", "maxSpeed: -1"), "maxSpeed"),
    ],
)
def test_invalid_description_is_rejected(text: str, message: str) -> None:
    with pytest.raises(InvalidDescription, match=message):
        parse_node_description(text, "drone-1")


def test_description_hash_ignores_comments_and_layout() -> None:
    first = parse_node_description(yaml.safe_dump(MANIFEST), "drone-1")
    same_content = parse_node_description(
        "# x\n" + yaml.safe_dump(MANIFEST, sort_keys=False, default_flow_style=True), "drone-1"
    )
    other = parse_node_description(edited(depot="x"), "drone-1")
    assert description_hash(first) == description_hash(same_content) != description_hash(other)


CAMERA = {"methods": ["CaptureImage"], "horizontalFieldOfView": 62.2, "mount": {"pitch": -60}}


def described_camera(camera: dict[str, Any]) -> str:
    return edited(services={**MANIFEST["spec"]["services"], "camera": camera})


async def test_node_object_file_follows_the_owners_edits(path: Path) -> None:
    store = FakeStore()
    file = path.with_name("node.json")
    write(path, described_camera(CAMERA))
    registration = registration_of(store, path)
    await registration.step()
    first = parse_description(file.read_text(), Drone)
    assert first is not None
    assert first.spec.services.camera is not None
    assert (first.spec.services.camera.mount, first.status) == (CameraMount(pitch=-60), None)
    assert store.object is not None
    store.object["spec"]["services"]["camera"]["mount"]["pitch"] = -30
    store.object["metadata"]["generation"] += 1
    registration.on_status_written(copy.deepcopy(store.object) | {"status": {"flightState": "flying"}})
    second = parse_description(file.read_text(), Drone)
    assert registration.resource is not None
    assert second is not None
    assert second.spec == registration.resource.spec
    assert "depot" in file.read_text()
    written = file.stat()
    await registration.step()
    assert file.stat().st_ino == written.st_ino, "the file is not rewritten without a change"


@pytest.mark.parametrize(
    ("camera", "missing"),
    [
        ({"methods": ["CaptureImage"]}, "has no horizontalFieldOfView, mount: "),
        ({**CAMERA, "horizontalFieldOfView": None}, "has no horizontalFieldOfView: "),
        ({**CAMERA, "mount": None}, "has no mount: "),
    ],
)
async def test_incomplete_camera_description_is_reported(path: Path, camera: dict[str, Any], missing: str) -> None:
    write(path, described_camera({key: value for key, value in camera.items() if value is not None}))
    object_file = NodeObjectFile(path.with_name("node.json"))
    registration = Registration(FakeStore(), path, "drone-1", object_file)  # type: ignore[arg-type]
    await registration.step()
    assert object_file.condition is not None
    assert (object_file.condition.type, object_file.condition.status) == ("CameraDescribed", "False")
    assert missing in object_file.condition.message
    write(path, described_camera(CAMERA))
    await registration.step()
    assert object_file.condition is None


async def test_node_object_file_is_emptied_if_the_object_cannot_be_parsed_or_stored(
    path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    file = tmp_path / "state" / "node.json"
    object_file = NodeObjectFile(file)
    store = FakeStore()
    registration = Registration(store, path, "drone-1", object_file)  # type: ignore[arg-type]
    await registration.step()
    assert file.exists()

    def write_status(generation: int, **changes: Any) -> None:
        assert store.object is not None
        body = copy.deepcopy(store.object)
        body["metadata"]["generation"] = generation
        body["spec"] |= changes
        registration.on_status_written(body)

    write_status(2, services={"camera": {"mount": "above"}})
    assert file.read_bytes() == b"", (
        "the file is empty, because services would use an outdated description, or their own if it were missing"
    )
    assert object_file.condition is not None
    assert "cannot parse the object" in object_file.condition.message
    write_status(3)
    assert (file.read_bytes() != b"", object_file.condition) == (True, None)

    def full(*_args: object, **_named: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("fractus_agent.registration.node_object_file.write_file", full)
    write_status(4, depot="other")
    assert file.read_bytes() == b""
    assert object_file.condition is not None
    assert "cannot store its description" in object_file.condition.message
