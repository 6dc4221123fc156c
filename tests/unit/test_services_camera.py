"""The camera between judging and keeping: the drone moves, callers wait, policies change, cameras break."""

from __future__ import annotations

import asyncio
import errno
import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fractus_core.policy.values import Attitude, CaptureArgs, Lens, Situation
from fractus_services.audit import AuditLog
from fractus_services.camera import service as camera
from fractus_services.camera.album import Album, AlbumFull, NoSuchImage
from fractus_services.camera.drivers import CameraFailed, Wanted
from fractus_services.camera.faces import Box
from fractus_services.camera.imaging import Pixels, decoded
from fractus_services.camera.service import MAX_OF_ONE, Body, CameraService
from fractus_services.camera.shots import Shot
from fractus_services.camera.shutter import Shutter
from fractus_services.grants import Held
from fractus_services.replies import Refused
from policy_world import FRAME, NOW, at, box, compiled, policy, spec, zone

SEEING = Lens(60.0, 60.0, stabilised=True, error_deg=0.0)


def private(action: str = "refuse", name: str = "p", **fields: Any) -> dict[str, Any]:
    return policy(name, "PrivacyControl", "camera", [zone("z", box(-20, -20, 20, 20))], action=action, **fields)


class Drone:
    """Whereabouts that a test moves; they remember what they told."""

    def __init__(self) -> None:
        self.x, self.y, self.alt, self.yaw = 0.0, 80.0, 10.0, 0.0
        self.lens: Lens | None = SEEING
        self.told: list[tuple[float, Situation]] = []

    def situation(self, time_s: float) -> Situation:
        now = at(
            self.x, self.y, alt=self.alt, time_s=time_s, lens=self.lens, attitude=Attitude(0, 0, self.yaw, 0, 0)
        )  # fmt: skip
        self.told.append((time.monotonic(), now))
        return now

    def way(self, begun_s: float, time_s: float) -> tuple[Situation, ...]:
        self.situation(time_s)
        return tuple(one for told_at, one in self.told if told_at >= begun_s)

    async def run(self) -> None:
        """Nothing to follow."""


class Scene:
    """A camera that shows noise, and lets a test act during the exposure."""

    def __init__(self) -> None:
        self.latency_s = 0.0
        self.taken: list[Wanted] = []
        self.during: Callable[[], None] = lambda: None
        self._begun = threading.Event()

    async def begun(self) -> None:
        assert await asyncio.to_thread(self._begun.wait, 10)

    def capture(self, wanted: Wanted) -> Pixels:
        self.taken.append(wanted)
        self._begun.set()
        self.during()
        noise = np.random.default_rng(1).integers(0, 256, (wanted.height, wanted.width, 3))
        return noise.astype(np.uint8)

    def close(self) -> None:
        """Nothing to let go of."""


class Finder:
    """A detector that finds what a test says."""

    name = "test"
    least_px = 40.0

    def __init__(self) -> None:
        self.boxes: list[Box] = []

    def find(self, picture: Pixels, smallest_px: float, *, upright: bool) -> list[Box]:
        assert smallest_px >= self.least_px
        assert not upright
        return self.boxes


def held(*policies: dict[str, Any], uid: str = "u1", instance: str = "app-navigator") -> Held:
    fields: dict[str, Any] = {
        "application": {"namespace": "default", "name": "app", "uid": uid},
        "instance": instance,
        "services": [{"service": "camera", "methods": ["CaptureImage", "RetrieveImage", "ListImages", "DeleteImage"]}],
    }
    chosen = policies or (private(),)
    return Held(uid, "g", spec(*chosen, **fields), compiled(*chosen, **fields))


class World:
    """A service with all that it stands on."""

    def __init__(self, directory: Path, resolution: tuple[int, int] = (64, 64)) -> None:
        self.directory = directory / "album"
        self.drone, self.scene, self.finder = Drone(), Scene(), Finder()
        self.shutter = Shutter(self.scene, timeout_s=5.0)
        self.audit = AuditLog(directory / "audit.jsonl", lambda: NOW)
        self.album = Album(self.directory, 50, 10**9)
        self.service = CameraService(
            self.drone, self.shutter, Body(resolution), detector=self.finder, album=self.album, audit=self.audit,
            clock=lambda: NOW,
        )  # fmt: skip

    async def capture(self, grant: Held, **size: int) -> Shot:
        return (await self.service.capture(grant, CaptureArgs(**size)))[1]

    async def pixels(self, grant: Held, shot: Shot) -> Pixels:
        source = (await self.service.retrieve(grant, shot.name))[2]
        return decoded(source if isinstance(source, bytes) else source.read_bytes())

    def stored(self, grant: Held, shot: Shot) -> Pixels:
        return decoded(self.album.path(camera.owner_of(grant), shot.name).read_bytes())


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    world = World(tmp_path)
    yield world
    world.shutter.close()


async def refusal(work: Any) -> str:
    with pytest.raises(Refused) as caught:
        await work
    return caught.value.verdict.code


def grain(picture: Pixels) -> float:
    """How much neighbouring pixels differ."""
    return float(np.abs(np.diff(picture.astype(float), axis=1)).mean())


async def test_a_drone_that_flies_over_private_ground_during_the_exposure_keeps_no_picture(world: World) -> None:
    world.scene.during = lambda: setattr(world.drone, "y", 0.0)
    assert await refusal(world.service.capture(held(), CaptureArgs())) == "PrivacyZone"
    world.drone.y = 80.0
    assert len(world.scene.taken) == 1
    assert (await world.service.list(held()))[1] == ()


async def test_a_drone_that_crosses_private_ground_during_the_exposure_keeps_no_picture(world: World) -> None:
    world.scene.during = lambda: setattr(world.drone, "y", -80.0)
    assert await refusal(world.service.capture(held(), CaptureArgs())) == "PrivacyZone"


async def test_a_camera_that_looks_aside_and_back_during_the_exposure_keeps_no_picture(world: World) -> None:
    """Narrow and oblique, 10 m up: the zone 60 m to the south is behind it at both ends of the exposure."""
    world.drone.lens = Lens(20.0, 20.0, pitch_deg=-15.0, stabilised=True, error_deg=0.0)

    def looked(**changes: float) -> None:
        before = {name: getattr(world.drone, name) for name in changes}
        for now in (changes, before):
            for name, value in now.items():
                setattr(world.drone, name, value)
            world.drone.situation(NOW)

    world.scene.during = lambda: looked(yaw=45.0)
    shot = await world.capture(held())
    assert {round(pose.attitude.yaw_deg) for pose in shot.poses if pose.attitude} == {0, 45}
    world.scene.during = lambda: looked(yaw=180.0)
    assert await refusal(world.service.capture(held(), CaptureArgs())) == "PrivacyZone"
    world.scene.during = lambda: looked(y=0.0)
    assert await refusal(world.service.capture(held(), CaptureArgs())) == "PrivacyZone"
    blind = policy("a", "AccessControl", "denial", [zone("z", box(-20, -20, 20, 20))], methods=["CaptureImage"])
    assert await refusal(world.service.capture(held(blind), CaptureArgs())) == "MethodDenied"
    elsewhere = policy("q", "PrivacyControl", "camera", [zone("z", box(500, 500, 510, 510))], action="refuse")
    world.scene.during = lambda: looked(yaw=180.0)
    shot = await world.capture(held(elsewhere))
    assert await refusal(world.service.retrieve(held(), shot.name)) == "PrivacyZone"


async def test_a_camera_that_shows_what_was_is_judged_by_where_it_was(world: World) -> None:
    def came_from_private_ground() -> None:
        for y in (0.0, 80.0):
            world.drone.y = y
            world.drone.situation(NOW)

    came_from_private_ground()
    await world.capture(held())
    world.scene.latency_s = 600.0
    came_from_private_ground()
    assert await refusal(world.service.capture(held(), CaptureArgs())) == "PrivacyZone"


async def test_a_zone_counts_that_was_active_when_the_camera_may_have_seen_it(world: World) -> None:
    world.drone.y = 0.0
    past = {**zone("z", box(-20, -20, 20, 20)), "schedule": [{"start": "08:00", "end": "11:50"}]}
    grant = held(policy("p", "PrivacyControl", "camera", [past], action="refuse"))
    world.scene.latency_s = 300.0
    await world.capture(grant)
    world.scene.latency_s = 900.0
    assert await refusal(world.service.capture(grant, CaptureArgs())) == "PrivacyZone"


async def test_those_who_wait_are_judged_and_placed_when_it_is_their_turn(world: World) -> None:
    held_up = threading.Event()
    world.scene.during = lambda: held_up.wait(10) and None
    waiting = [asyncio.create_task(world.capture(held())) for _ in range(MAX_OF_ONE)]
    await world.scene.begun()
    assert await refusal_of_queue(world.capture(held()))
    other = asyncio.create_task(world.capture(held(instance="other")))
    await asyncio.sleep(0)
    world.drone.y = 60.0
    held_up.set()
    shots = await asyncio.gather(*waiting)
    assert (await other).name == sorted(s.name for s in [*shots, await other])[1], "callers take turns"
    for shot in shots:
        last = shot.poses[-1]
        assert FRAME.xy(last.lat or 0, last.lon or 0)[1] == pytest.approx(60.0, abs=0.01)


async def refusal_of_queue(work: Any) -> bool:
    with pytest.raises(Exception, match="under way") as caught:
        await work
    translated = camera.known(caught.value)
    return translated is not None and translated.verdict.code == "ShutterBusy"


async def test_a_caller_that_hangs_up_does_not_free_the_shutter(world: World) -> None:
    held_up = threading.Event()
    world.scene.during = lambda: held_up.wait(10) and None
    task = asyncio.create_task(world.service.capture(held(), CaptureArgs()))
    await world.scene.begun()
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert world.service._exposing.busy
    held_up.set()
    await asyncio.gather(world.capture(held()), *world.service._tasks)
    assert len((await world.service.list(held()))[1]) == 2


async def test_a_grant_that_ends_while_its_caller_waits_takes_no_picture(world: World) -> None:
    def gone() -> Held:
        raise camera.refused(camera.Verdict("deny", None, "NoGrant", "gone"))

    assert await refusal(world.service.capture(held(), CaptureArgs(), gone)) == "NoGrant"
    assert not world.scene.taken


async def test_an_application_of_the_same_name_does_not_inherit_pictures(world: World) -> None:
    await world.capture(held())
    assert len((await world.service.list(held()))[1]) == 1
    assert (await world.service.list(held(uid="u2")))[1] == ()


# Filters


@pytest.mark.parametrize("action", ["black", "blurAverage", "blurMedian", "removeBackground"])
async def test_a_filtered_picture_is_never_on_disk_without_its_filter(world: World, action: str) -> None:
    world.drone.y = 0.0
    grant = held(private(action))
    verdict, shot = await world.service.capture(grant, CaptureArgs())
    assert (verdict.action, verdict.code, verdict.policies) == ("correct", "PrivacyFilter", ("p",))
    assert len(world.scene.taken) == (3 if action == "removeBackground" else 1)
    kept = world.stored(grant, shot)
    assert grain(kept) < 12
    assert np.array_equal(await world.pixels(grant, shot), kept), "it is not filtered twice"
    data = world.album.path(camera.owner_of(grant), shot.name).read_bytes()
    assert b"Exif" not in data
    assert b"Camera:" not in data


async def test_a_picture_is_judged_again_by_where_it_was_taken(world: World) -> None:
    free, bound = held(policy("q", "PrivacyControl", "camera", [zone("far", box(500, 500, 510, 510))],
                              action="refuse")), held(private("blurAverage"))  # fmt: skip
    world.drone.y = 0.0
    shot = await world.capture(free)
    assert grain(world.stored(free, shot)) > 30
    world.drone.y = 150.0
    verdict, shown, _ = await world.service.retrieve(bound, shot.name)
    assert (verdict.action, verdict.policies) == ("correct", ("p",))
    assert shown.filters
    assert grain(await world.pixels(bound, shot)) < 12
    assert await refusal(world.service.retrieve(held(), shot.name)) == "PrivacyZone"
    assert grain(await world.pixels(free, shot)) > 30


async def test_a_picture_is_judged_again_once_its_filters_are_applied(world: World) -> None:
    far = [zone("far", box(500, 500, 510, 510))]
    free, bound = held(policy("q", "PrivacyControl", "camera", far, action="refuse")), held(private("blurAverage"))
    world.drone.y = 0.0
    shot = await world.capture(free)
    _, shown, _ = await world.service.retrieve(bound, shot.name, lambda: bound)
    assert [one.action for one in shown.filters] == ["blurAverage"]
    assert await refusal(world.service.retrieve(bound, shot.name, held)) == "PrivacyZone"
    stricter = held(private("black"))
    with pytest.raises(Refused, match="ask again") as caught:
        await world.service.retrieve(bound, shot.name, lambda: stricter)
    assert (caught.value.verdict.code, caught.value.verdict.policies) == ("PrivacyZone", ("p",))


async def test_a_picture_from_elsewhere_is_judged_by_where_the_camera_is_now(world: World) -> None:
    shot = await world.capture(held(private("black")))
    world.drone.y = 0.0
    assert (await world.pixels(held(private("black")), shot)).max() == 0


async def test_faces_are_hidden_where_they_are_large_enough_to_be_found(tmp_path: Path) -> None:
    world = World(tmp_path, (1600, 1600))
    world.drone.y, world.drone.alt = 0.0, 2.0
    world.finder.boxes = [(700, 700, 100, 100)]
    grant = held(private("blurFaces"))
    kept = world.stored(grant, await world.capture(grant))
    assert grain(kept[700:800, 700:800]) < 12
    assert grain(kept[:600]) > 30
    world.drone.alt = 40.0
    verdict, shot = await world.service.capture(grant, CaptureArgs())
    assert "blurAverage instead" in verdict.reason
    assert grain(world.stored(grant, shot)) < 12
    strict = held(private("blurFaces", fallback="refuse"))
    assert await refusal(world.service.capture(strict, CaptureArgs())) == "FacesNotFound"
    assert grain(await world.pixels(held(private("black")), shot)) == 0
    world.shutter.close()


async def test_faces_that_were_hidden_too_softly_are_not_looked_for_again(tmp_path: Path) -> None:
    world = World(tmp_path, (1600, 1600))
    world.drone.y, world.drone.alt = 0.0, 2.0
    world.finder.boxes = [(700, 700, 100, 100)]
    soft = held(private("blurFaces", faces="gaussian"))
    shot = await world.capture(soft)
    assert shot.filters[0].faces == "gaussian"
    assert grain(await world.pixels(soft, shot)) > 30
    world.finder.boxes = []
    for fallback, most in (("blurAverage", 12), ("black", 0)):
        hard = held(private("blurFaces", faces="pixelate", fallback=fallback))
        assert grain(await world.pixels(hard, shot)) <= most
    strict = held(private("blurFaces", faces="pixelate", fallback="refuse"))
    assert await refusal(world.service.retrieve(strict, shot.name)) == "FacesNotFound"
    world.shutter.close()


@pytest.mark.parametrize(("size", "shown"), [((120, 160), (120, 68)), ((400, 90), (160, 90)), ((160, 90), (160, 90))])
async def test_no_more_is_kept_than_the_view_that_was_judged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: tuple[int, int], shown: tuple[int, int]
) -> None:
    """Whatever proportions the camera gives: the footprint was that of 16:9."""
    world = World(tmp_path, (160, 90))
    picture = np.zeros((size[1], size[0], 3), np.uint8)
    left, top = (size[0] - shown[0]) // 2, (size[1] - shown[1]) // 2
    picture[top : top + shown[1], left : left + shown[0]] = 200
    monkeypatch.setattr(world.scene, "capture", lambda _wanted: picture)
    for asked in ({"width": 64, "height": 64}, {"width": 64, "height": 36}, {"width": 90, "height": 160}):
        kept = world.stored(held(), await world.capture(held(), **asked))
        assert kept.min() > 150, asked
    world.drone.lens = None
    elsewhere = held(private("black"), uid="u9")
    assert (await world.capture(elsewhere, width=64, height=64)).filters, "without a lens it sees everything"
    world.shutter.close()


async def test_without_a_lens_nobody_knows_how_small_faces_are(world: World) -> None:
    world.drone.lens = None
    verdict, _ = await world.service.capture(held(private("blurFaces")), CaptureArgs())
    assert "nobody knows how small" in verdict.reason
    assert verdict.policies == ("p",), "80 m away, but who knows what the camera sees"


async def test_a_picture_that_was_enlarged_has_no_larger_faces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(tmp_path, (1600, 1600))
    world.drone.y, world.drone.alt = 0.0, 2.0
    small = np.zeros((100, 100, 3), np.uint8)
    monkeypatch.setattr(world.scene, "capture", lambda _wanted: small)
    verdict, shot = await world.service.capture(held(private("blurFaces")), CaptureArgs())
    assert (shot.width, shot.height) == (1600, 1600)
    assert "faces may be as small as 3 pixels" in verdict.reason
    world.shutter.close()


@pytest.mark.parametrize(("width", "height"), [(15, 64), (64, 9000), (8192, 8192), (8000, 16)])
async def test_sizes_beyond_measure_are_refused(world: World, width: int, height: int) -> None:
    assert await refusal(world.service.capture(held(), CaptureArgs(width, height))) == "InvalidArgument"
    assert not world.scene.taken


# Cameras that break


async def test_a_camera_that_hangs_is_reported_and_comes_back(tmp_path: Path) -> None:
    scene, stuck = Scene(), threading.Event()
    scene.during = lambda: stuck.wait(20) and None
    shutter = Shutter(scene, timeout_s=0.2)
    wanted = Wanted(8, 8, (8, 8), "RGB", at())
    with pytest.raises(CameraFailed, match="gave no picture in"):
        await shutter.expose(wanted)
    begun = time.monotonic()
    with pytest.raises(CameraFailed, match="has not answered for"):
        await shutter.expose(wanted)
    assert time.monotonic() - begun < 5, "at once, not after another wait"
    stuck.set()
    for _ in range(500):
        try:
            assert len(await shutter.expose(wanted)) == 1
            break
        except CameraFailed:
            await asyncio.sleep(0.01)
    else:
        raise AssertionError("the camera does not come back")
    shutter.close()


async def test_a_driver_that_breaks_does_not_take_the_service_along(world: World) -> None:
    def broken() -> None:
        raise CameraFailed("no light")

    world.scene.during = broken
    with pytest.raises(CameraFailed):
        await world.capture(held())
    world.scene.during = lambda: None
    await world.capture(held())


# The album


async def test_the_album_forgets_what_a_crash_left_and_makes_room(tmp_path: Path) -> None:
    world = World(tmp_path)
    shot = await world.capture(held())
    folder = next(path for path in world.directory.iterdir() if path.is_dir())
    (folder / "20260101000000000-0001.jpg").write_bytes(b"half")
    (folder / "20260101000000000-0002.jpg.new").write_bytes(b"half")
    (folder / "20260101000000000-0003.json").write_text('{"name": "old"}')
    album = Album(world.directory, 50, 10**9)
    assert [s.name for s in album.list(camera.owner_of(held()))] == [shot.name]
    assert len(list(folder.glob("*.jpg*"))) == 1
    assert album.list(camera.owner_of(held())) == (shot,), "a shot survives its record"

    living = [camera.owner_of(held(instance="other"))]
    small = Album(world.directory, 50, 10**9, 1000, lambda: living)
    assert small.room(living[0]) == "", "pictures of those who are gone make room"
    assert not folder.exists()
    small.add(living[0], replace(shot, name="20260101000000000-0009.jpg"), b"x" * 2000)
    assert "--keep-total-mb" in small.room(living[0])
    world.shutter.close()


async def test_a_picture_whose_record_is_damaged_is_removed_and_never_handed_out(tmp_path: Path) -> None:
    world = World(tmp_path)
    owner, shots = camera.owner_of(held()), [await world.capture(held()) for _ in range(5)]
    records = [world.album.path(owner, shot.name).with_suffix(".json") for shot in shots]
    body = json.loads(records[0].read_text())
    poses = body.pop("poses")
    records[0].write_text(json.dumps({**body, "poses": poses, "colour": "red"}))
    records[1].write_text("{")
    records[2].write_text(json.dumps({**body, "poses": []}))
    records[3].write_text(json.dumps({**body, "poses": [{**poses[0], "lat": float("nan")}]}))
    for shot in shots[:4]:
        with pytest.raises(NoSuchImage, match=r"damaged.*DeleteImage"):
            await world.service.retrieve(held(), shot.name)
    assert world.album.list(owner) == (shots[4],)
    await world.service.delete(held(), shots[0].name)
    assert not records[0].with_suffix(".jpg").exists()
    with pytest.raises(NoSuchImage, match="there is no picture"):
        await world.service.delete(held(), shots[0].name)
    assert Album(world.directory, 50, 10**9).list(owner) == (shots[4],)
    assert [path.name for path in world.directory.glob("*/*.jpg")] == [shots[4].name]
    world.shutter.close()


async def test_a_picture_of_an_earlier_release_was_taken_nobody_knows_where(tmp_path: Path) -> None:
    world = World(tmp_path)
    shot = await world.capture(held())
    record = world.album.path(camera.owner_of(held()), shot.name).with_suffix(".json")
    body = json.loads(record.read_text())
    poses = body.pop("poses")
    record.write_text(json.dumps({**body, "face_px": 900.0, "before": poses[0], "after": poses[-1]}))
    world.service._album = Album(world.directory, 50, 10**9)
    (kept,) = (await world.service.list(held()))[1]
    assert (kept.name, kept.poses[0].lat, kept.face_px) == (shot.name, None, 0.0)
    assert await refusal(world.service.retrieve(held(), shot.name)) == "PrivacyZone", "every policy in force holds"
    verdict, _, _ = await world.service.retrieve(held(private("black")), shot.name)
    assert verdict.policies == ("p",)
    world.shutter.close()


async def test_a_full_disk_is_said_and_leaves_nothing_behind(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_file: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr("fractus_services.camera.album.os.fsync", full)
        with pytest.raises(OSError, match="No space left") as caught:
            await world.capture(held())
    refused = camera.known(caught.value)
    assert refused is not None
    assert (refused.status.name, refused.verdict.code) == ("RESOURCE_EXHAUSTED", "StorageFailed")
    assert "make room on the node" in refused.verdict.reason
    assert [path for path in world.directory.rglob("*") if path.is_file()] == []
    await world.capture(held())


async def test_a_full_album_says_what_to_do(tmp_path: Path) -> None:
    world = World(tmp_path)
    world.album._keep = 1
    await world.capture(held())
    with pytest.raises(AlbumFull, match="DeleteImage") as caught:
        await world.capture(held())
    refused = camera.known(caught.value)
    assert refused is not None
    assert refused.status.name == "RESOURCE_EXHAUSTED"
    await world.capture(held(instance="other"))
    world.shutter.close()
