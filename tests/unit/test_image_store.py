"""Image store: records, quotas, permissions and damaged files."""

from __future__ import annotations

import errno
import json
import os
import stat
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from camera_world import World, active_grant, private, refusal
from fractus_services.camera.handlers import storage_failed
from fractus_services.camera.image_store import ImageStore, ImageStoreFull, NoSuchImage, owner_of
from fractus_services.errors import ResourceExhausted


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    world = World(tmp_path)
    yield world
    world.shutter.close()


async def test_image_store_deletes_partial_files_and_pictures_of_deleted_owners(tmp_path: Path) -> None:
    world = World(tmp_path)
    record = await world.capture(active_grant())
    folder = next(path for path in world.directory.iterdir() if path.is_dir())
    (folder / "20260101000000000-0001.jpg").write_bytes(b"half")
    (folder / ".20260101000000000-0002.jpg.7.tmp").write_bytes(b"half")
    (folder / "20260101000000000-0003.json").write_text('{"name": "old"}')
    store = ImageStore(world.directory, 50, 10**9)
    assert [s.name for s in store.list(owner_of(active_grant()))] == [record.name]
    assert len(list(folder.glob("*.jpg*"))) == 1
    assert store.list(owner_of(active_grant())) == (record,), "the picture is kept with its record"

    living = [owner_of(active_grant(instance="other"))]
    small = ImageStore(world.directory, 50, 10**9, 1000, lambda: living)
    assert small.quota_problem(living[0]) == "", "pictures of deleted owners are removed to make room"
    assert not folder.exists()
    small.add(living[0], replace(record, name="20260101000000000-0009.jpg"), b"x" * 2000)
    assert "--keep-total-mb" in small.quota_problem(living[0])
    world.shutter.close()


async def test_image_store_deletes_picture_with_damaged_record(tmp_path: Path) -> None:
    world = World(tmp_path)
    owner = owner_of(active_grant())
    records = [await world.capture(active_grant()) for _ in range(5)]
    files = [world.store.path(owner, record.name).with_suffix(".json") for record in records]
    body = json.loads(files[0].read_text())
    poses = body.pop("poses")
    files[0].write_text(json.dumps({**body, "poses": poses, "colour": "red"}))
    files[1].write_text("{")
    files[2].write_text(json.dumps({**body, "poses": []}))
    files[3].write_text(json.dumps({**body, "poses": [{**poses[0], "lat": float("nan")}]}))
    for record in records[:4]:
        with pytest.raises(NoSuchImage, match=r"damaged.*DeleteImage"):
            await world.stored_images.retrieve(active_grant(), record.name)
    assert world.store.list(owner) == (records[4],)
    await world.stored_images.delete(active_grant(), records[0].name)
    assert not files[0].with_suffix(".jpg").exists()
    with pytest.raises(NoSuchImage, match="has no image"):
        await world.stored_images.delete(active_grant(), records[0].name)
    assert ImageStore(world.directory, 50, 10**9).list(owner) == (records[4],)
    assert [path.name for path in world.directory.glob("*/*.jpg")] == [records[4].name]
    world.shutter.close()


async def test_picture_of_earlier_release_has_unknown_position(tmp_path: Path) -> None:
    world = World(tmp_path)
    record = await world.capture(active_grant())
    record_path = world.store.path(owner_of(active_grant()), record.name).with_suffix(".json")
    body = json.loads(record_path.read_text())
    poses = body.pop("poses")
    record_path.write_text(json.dumps({**body, "face_px": 900.0, "before": poses[0], "after": poses[-1]}))
    world.shutter.close()
    world = World(tmp_path)
    (stored,) = (await world.stored_images.list(active_grant()))[1]
    assert (stored.name, stored.poses[0].lat, stored.face_px) == (record.name, None, 0.0)
    assert await refusal(world.stored_images.retrieve(active_grant(), record.name)) == "PrivacyZone", (
        "every active policy applies"
    )
    verdict, _, _ = await world.stored_images.retrieve(active_grant(private("black")), record.name)
    assert verdict.policies == ("p",)
    world.shutter.close()


async def test_faces_are_not_detected_in_picture_that_may_be_cropped(tmp_path: Path) -> None:
    """Earlier releases cropped pictures before face detection, and did not record this."""
    world = World(tmp_path)
    record = await world.capture(active_grant())
    record_path = world.store.path(owner_of(active_grant()), record.name).with_suffix(".json")
    body = json.loads(record_path.read_text())
    assert body.pop("whole")
    record_path.write_text(json.dumps({**body, "face_px": 900.0}))
    world.shutter.close()
    world = World(tmp_path)
    (stored,) = (await world.stored_images.list(active_grant()))[1]
    assert stored == replace(record, face_px=0.0, whole=False)
    world.shutter.close()


def modes(directory: Path) -> dict[str, set[int]]:
    """Return the permissions of the folders and files of an image store."""
    entries = [(path.is_dir(), stat.S_IMODE(path.stat().st_mode)) for path in directory.rglob("*")]
    return {
        "folders": {mode for is_dir, mode in entries if is_dir},
        "files": {mode for is_dir, mode in entries if not is_dir},
    }


async def test_image_store_files_are_readable_by_owner_only(world: World) -> None:
    before = os.umask(0)
    try:
        plain = await world.capture(active_grant(private("black")))
        world.drone.y = 0.0
        filtered = await world.capture(active_grant(private("black")))
    finally:
        os.umask(before)
    assert (bool(plain.filters), bool(filtered.filters)) == (False, True)
    assert modes(world.directory) == {"folders": {0o700}, "files": {0o600}}


async def test_image_store_restricts_permissions_of_earlier_release(world: World) -> None:
    record = await world.capture(active_grant())
    for path in world.directory.rglob("*"):
        path.chmod(0o755 if path.is_dir() else 0o644)
    foreign = world.directory.parent / "foreign"
    foreign.write_bytes(b"not a picture")
    foreign.chmod(0o644)
    (folder,) = (path for path in world.directory.iterdir() if path.is_dir())
    (folder / "20260101000000000-0001.json").symlink_to(foreign)
    store = ImageStore(world.directory, 50, 10**9)
    (folder / "20260101000000000-0001.json").unlink(missing_ok=True)
    assert modes(world.directory) == {"folders": {0o700}, "files": {0o600}}
    assert stat.S_IMODE(foreign.stat().st_mode) == 0o644, "the target of a link must stay unchanged"
    assert store.find(owner_of(active_grant()), record.name) == record


async def test_full_disk_is_reported_and_leaves_no_partial_picture(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_file: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr("fractus_runtime.files.os.fsync", full)
        with pytest.raises(OSError, match="No space left") as caught:
            await world.capture(active_grant())
    refused = storage_failed(caught.value)
    assert refused.verdict.code == "StorageFailed"
    assert "free disk space on the node" in refused.verdict.reason
    assert [path for path in world.directory.rglob("*") if path.is_file()] == []
    await world.capture(active_grant())


async def test_full_image_store_error_names_remedy(tmp_path: Path) -> None:
    world = World(tmp_path, keep=1)
    await world.capture(active_grant())
    with pytest.raises(ImageStoreFull, match="DeleteImage") as caught:
        await world.capture(active_grant())
    assert isinstance(caught.value, ResourceExhausted)
    await world.capture(active_grant(instance="other"))
    world.shutter.close()
