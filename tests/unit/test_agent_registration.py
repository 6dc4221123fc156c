"""Registration: created once, the owner's edits stay, a changed description is taken over."""

import copy
from pathlib import Path
from typing import Any

import pytest
import yaml
from fractus_agent.cluster.store import Invalid
from fractus_agent.registration.handover import Handover
from fractus_agent.registration.registration import (
    HASH_ANNOTATION,
    Registration,
    description_hash,
    own_description,
)
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
    """One node's object and labels, with the API server's bookkeeping."""

    def __init__(self) -> None:
        self.object: dict[str, Any] | None = None
        self.labels: dict[str, str] | None = {"fractus.dev/class": "drone", "other": "x"}
        self.writes = 0
        self.refuse = False

    async def node_labels(self) -> dict[str, str] | None:
        return None if self.labels is None else dict(self.labels)

    async def described(self, kind: str) -> dict[str, Any] | None:
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
    return Registration(store, path, "drone-1", Handover(path.with_name("node.json")))  # type: ignore[arg-type]


async def test_registers_once(path: Path) -> None:
    store = FakeStore()
    for _ in range(3):
        await registration_of(store, path).step()
    assert store.writes == 1
    assert store.object is not None
    assert store.object["metadata"]["labels"] == {"fleet": "north"}
    assert store.object["spec"]["depot"] == "campus"


async def test_the_owners_edits_stay(path: Path) -> None:
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


async def test_a_changed_description_is_taken_over_once(path: Path) -> None:
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


async def test_an_owners_object_is_adopted_unchanged(path: Path) -> None:
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


async def test_without_a_description_the_owners_object_is_awaited(tmp_path: Path) -> None:
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
    assert registration.described is None


async def test_a_deleted_object_is_registered_again(path: Path) -> None:
    store = FakeStore()
    registration = registration_of(store, path)
    await registration.step()
    store.object = None
    registration.seen(None)
    assert registration.body is None
    await registration.step()
    assert store.object is not None


async def test_a_bad_description_is_reported_and_the_object_kept(path: Path) -> None:
    store = FakeStore()
    registration = registration_of(store, path)
    await registration.step()
    before = copy.deepcopy(store.object)
    write(path, edited(depot="No Such Name!"))
    await registration.step()
    assert store.object == before
    assert registration.described is not None
    assert "spec.depot" in registration.described.message
    write(path, edited())
    await registration.step()
    assert registration.described is None


async def test_a_refused_object_is_said(path: Path) -> None:
    store = FakeStore()
    store.refuse = True
    registration = registration_of(store, path)
    with pytest.raises(Invalid):
        await registration.step()
    assert registration.described is not None
    assert "spec.depot: no" in registration.described.message
    assert registration.body is None


async def test_a_description_of_the_other_class_is_refused(path: Path) -> None:
    store = FakeStore()
    store.labels = {"fractus.dev/class": "edge"}
    registration = registration_of(store, path)
    await registration.step()
    assert store.object is None
    assert registration.described is not None
    assert "EdgeNode" in registration.described.message


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: [", "is not YAML"),
        ("- 1", "kind"),
        ("kind: Depot", "kind"),
        (yaml.safe_dump(MANIFEST).replace("drone-1", "drone-2"), "metadata.name: is drone-2"),
        (yaml.safe_dump(MANIFEST).replace("maxSpeed: 15", "maxSpeed: -1"), "maxSpeed"),
    ],
)
def test_bad_descriptions(text: str, says: str) -> None:
    with pytest.raises(InvalidDescription, match=says):
        own_description(text, "drone-1")


def test_hash_is_of_what_is_said() -> None:
    first = own_description(yaml.safe_dump(MANIFEST), "drone-1")
    again = own_description("# x\n" + yaml.safe_dump(MANIFEST, sort_keys=False, default_flow_style=True), "drone-1")
    other = own_description(edited(depot="x"), "drone-1")
    assert description_hash(first) == description_hash(again) != description_hash(other)


CAMERA = {"methods": ["CaptureImage"], "horizontalFieldOfView": 62.2, "mount": {"pitch": -60}}


def described_camera(camera: dict[str, Any]) -> str:
    return edited(services={**MANIFEST["spec"]["services"], "camera": camera})


async def test_hands_the_object_over_as_its_owner_has_it_now(path: Path) -> None:
    store, handed = FakeStore(), path.with_name("node.json")
    write(path, described_camera(CAMERA))
    registration = registration_of(store, path)
    await registration.step()
    first = parse_description(handed.read_text(), Drone)
    assert first is not None
    assert first.spec.services.camera is not None
    assert (first.spec.services.camera.mount, first.status) == (CameraMount(pitch=-60), None)
    assert store.object is not None
    store.object["spec"]["services"]["camera"]["mount"]["pitch"] = -30
    store.object["metadata"]["generation"] += 1
    registration.seen(copy.deepcopy(store.object) | {"status": {"flightState": "flying"}})
    second = parse_description(handed.read_text(), Drone)
    assert registration.resource is not None
    assert second is not None
    assert second.spec == registration.resource.spec
    assert "depot" in handed.read_text()
    written = handed.stat()
    await registration.step()
    assert handed.stat().st_ino == written.st_ino, "nothing changed"


@pytest.mark.parametrize(
    ("camera", "missing"),
    [
        ({"methods": ["CaptureImage"]}, "has no horizontalFieldOfView, mount: "),
        ({**CAMERA, "horizontalFieldOfView": None}, "has no horizontalFieldOfView: "),
        ({**CAMERA, "mount": None}, "has no mount: "),
    ],
)
async def test_a_camera_whose_view_is_unknown_is_told_of(path: Path, camera: dict[str, Any], missing: str) -> None:
    write(path, described_camera({key: value for key, value in camera.items() if value is not None}))
    handover = Handover(path.with_name("node.json"))
    registration = Registration(FakeStore(), path, "drone-1", handover)  # type: ignore[arg-type]
    await registration.step()
    assert handover.condition is not None
    assert (handover.condition.type, handover.condition.status) == ("CameraDescribed", "False")
    assert missing in handover.condition.message
    write(path, described_camera(CAMERA))
    await registration.step()
    assert handover.condition is None


async def test_what_cannot_be_read_or_stored_is_not_handed_over(
    path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    handed = tmp_path / "handed" / "node.json"
    handover, store = Handover(handed), FakeStore()
    registration = Registration(store, path, "drone-1", handover)  # type: ignore[arg-type]
    await registration.step()
    assert handed.exists()

    def seen(generation: int, **changes: Any) -> None:
        assert store.object is not None
        body = copy.deepcopy(store.object)
        body["metadata"]["generation"] = generation
        body["spec"] |= changes
        registration.seen(body)

    seen(2, services={"camera": {"mount": "above"}})
    assert handed.read_bytes() == b"", "services would go on with what held before, and without a file by the owner's"
    assert handover.condition is not None
    assert "cannot read the object" in handover.condition.message
    seen(3)
    assert (handed.read_bytes() != b"", handover.condition) == (True, None)

    def full(*_args: object, **_named: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("fractus_agent.registration.handover.write_file", full)
    seen(4, depot="other")
    assert handed.read_bytes() == b""
    assert handover.condition is not None
    assert "cannot store its description" in handover.condition.message
