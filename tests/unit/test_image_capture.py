"""Capture and retrieval of pictures when the drone moves, callers wait, policies change or cameras fail."""

from __future__ import annotations

import asyncio
import io
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_world import MAX_PER_OWNER, Scene, World, active_grant, grain, private, refusal
from fractus_core.api.model import API_VERSION
from fractus_core.api.nodes import Drone
from fractus_core.policy.decision_types import CaptureArgs, Lens
from fractus_services.camera.camera_properties import CameraProperties
from fractus_services.camera.drivers.driver import CameraFailed, CaptureRequest
from fractus_services.camera.face_detection import CascadeDetector
from fractus_services.camera.fair_queue import QueueFull
from fractus_services.camera.image_store import owner_of
from fractus_services.camera.pixels import decode_image
from fractus_services.camera.shutter import Shutter
from fractus_services.errors import PolicyDenied, Refused
from fractus_services.grant_files import ActiveGrant
from fractus_world.billboards import photograph
from PIL import Image
from policy_world import FRAME, NOW, at, box, policy, zone


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    world = World(tmp_path)
    yield world
    world.shutter.close()


async def test_capture_is_refused_when_drone_enters_privacy_zone_during_exposure(world: World) -> None:
    world.scene.during = lambda: setattr(world.drone, "y", 0.0)
    assert await refusal(world.camera.capture(active_grant(), CaptureArgs())) == "PrivacyZone"
    world.drone.y = 80.0
    assert len(world.scene.taken) == 1
    assert (await world.stored_images.list(active_grant()))[1] == ()


async def test_capture_is_refused_when_drone_crosses_privacy_zone_during_exposure(world: World) -> None:
    world.scene.during = lambda: setattr(world.drone, "y", -80.0)
    assert await refusal(world.camera.capture(active_grant(), CaptureArgs())) == "PrivacyZone"


async def test_capture_is_refused_when_camera_turns_to_privacy_zone_and_back(world: World) -> None:
    """The zone is 60 m to the south, behind the narrow oblique view of the camera.

    The camera turns to the zone and back during the exposure.
    """
    world.drone.lens = Lens(20.0, 20.0, pitch_deg=-15.0, stabilised=True, error_deg=0.0)

    def turn_and_return(**changes: float) -> None:
        before = {name: getattr(world.drone, name) for name in changes}
        for now in (changes, before):
            for name, value in now.items():
                setattr(world.drone, name, value)
            world.drone.situation(NOW)

    world.scene.during = lambda: turn_and_return(yaw=45.0)
    record = await world.capture(active_grant())
    assert {round(pose.attitude.yaw_deg) for pose in record.poses if pose.attitude} == {0, 45}
    world.scene.during = lambda: turn_and_return(yaw=180.0)
    assert await refusal(world.camera.capture(active_grant(), CaptureArgs())) == "PrivacyZone"
    world.scene.during = lambda: turn_and_return(y=0.0)
    assert await refusal(world.camera.capture(active_grant(), CaptureArgs())) == "PrivacyZone"
    blind = policy("a", "AccessControl", "denial", [zone("z", box(-20, -20, 20, 20))], methods=["CaptureImage"])
    assert await refusal(world.camera.capture(active_grant(blind), CaptureArgs())) == "MethodDenied"
    elsewhere = policy("q", "PrivacyControl", "camera", [zone("z", box(500, 500, 510, 510))], action="refuse")
    world.scene.during = lambda: turn_and_return(yaw=180.0)
    record = await world.capture(active_grant(elsewhere))
    assert await refusal(world.stored_images.retrieve(active_grant(), record.name)) == "PrivacyZone"


@pytest.mark.parametrize("model", ["pinhole", "equidistant", None])
async def test_focal_length_is_in_metadata_only_of_pinhole_camera(tmp_path: Path, model: str | None) -> None:
    """For a fisheye lens, only an upper bound of the view is known, so there is no focal length."""
    described = {"methods": ["CaptureImage"], "horizontalFieldOfView": 60} | (
        {"lens": {"model": model}} if model else {}
    )
    body = {
        "apiVersion": API_VERSION,
        "kind": "Drone",
        "metadata": {"name": "d"},
        "spec": {"services": {"camera": described}},
    }
    world = World(tmp_path, pinhole=CameraProperties.from_description(Drone.from_body(body)).pinhole)
    elsewhere = policy("q", "PrivacyControl", "camera", [zone("z", box(500, 500, 510, 510))], action="refuse")
    record = await world.capture(active_grant(elsewhere))
    source = (await world.stored_images.retrieve(active_grant(elsewhere), record.name))[2]
    data = source if isinstance(source, bytes) else source.read_bytes()
    assert b"GPSXYAccuracy" in data
    with Image.open(io.BytesIO(data)) as picture:
        assert (0xA405 in picture.getexif().get_ifd(0x8769)) == (model == "pinhole")
    world.shutter.close()


FAR = policy("q", "PrivacyControl", "camera", [zone("z", box(500, 500, 510, 510))], action="refuse")


def deny_position(*zones: dict[str, Any], **spec: Any) -> dict[str, Any]:
    return policy("hidden", "AccessControl", "denial", list(zones), methods=["GetPosition"], **spec)


def tells_position(data: bytes) -> bool:
    with Image.open(io.BytesIO(data)) as picture:
        return bool(picture.getexif().get_ifd(0x8825)) or b"Camera:" in data


@pytest.mark.parametrize(
    "grant",
    [
        pytest.param(active_grant(FAR, locates=False), id="no-mobility-method"),
        pytest.param(active_grant(FAR, deny_position()), id="denied-everywhere"),
        pytest.param(active_grant(FAR, deny_position(zone("h", box(-9, 60, 9, 90)))), id="denied-there"),
    ],
)
async def test_picture_of_component_that_may_not_get_position_contains_no_position(
    world: World, grant: ActiveGrant
) -> None:
    record = await world.capture(grant)
    data = world.store.path(owner_of(grant), record.name).read_bytes()
    assert not tells_position(data)
    with Image.open(io.BytesIO(data)) as picture:
        assert picture.getexif().get_ifd(0x8769)[0x9003], "the time of the picture is not private"
    assert not world.stored_images.locates(grant, record)
    _, shown, source = await world.stored_images.retrieve(grant, record.name)
    assert isinstance(source, bytes)
    assert (shown.size_bytes, tells_position(source)) == (len(source), False)


@pytest.mark.parametrize(
    "denial",
    [deny_position(), deny_position(zone("h", box(-9, 60, 9, 90))), deny_position(zone("h", box(190, -9, 200, 9)))],
)
async def test_retrieved_picture_loses_position_that_component_may_no_longer_get(
    world: World, denial: dict[str, Any]
) -> None:
    """The denial applies to the place of the picture, and to the current position."""
    free = active_grant(FAR)
    record = await world.capture(free)
    _, _, source = await world.stored_images.retrieve(free, record.name)
    assert isinstance(source, Path)
    assert tells_position(source.read_bytes())
    assert world.stored_images.locates(free, record)
    world.drone.x = 195.0
    world.drone.y = 0.0
    bound = active_grant(FAR, denial)
    _, shown, data = await world.stored_images.retrieve(bound, record.name)
    assert isinstance(data, bytes)
    assert not tells_position(data)
    assert shown.size_bytes == len(data)
    assert np.array_equal(decode_image(data), decode_image(source.read_bytes())), "only the metadata is removed"
    assert not world.stored_images.locates(bound, record)
    owner = owner_of(free)
    world.stored_images.authorize_transfer(bound, owner, shown)
    with pytest.raises(PolicyDenied, match="request it again"):
        world.stored_images.authorize_transfer(bound, owner, record, has_position=True)


async def test_picture_of_fixed_camera_contains_position_without_mobility_method(world: World) -> None:
    world.drone.fixed = True
    grant = active_grant(FAR, locates=False)
    record = await world.capture(grant)
    assert tells_position(world.store.path(owner_of(grant), record.name).read_bytes())
    assert world.stored_images.locates(grant, record)


async def test_delayed_picture_is_judged_by_earlier_position(world: World) -> None:
    def cross_privacy_zone() -> None:
        for y in (0.0, 80.0):
            world.drone.y = y
            world.drone.situation(NOW)

    cross_privacy_zone()
    await world.capture(active_grant())
    world.scene.latency_s = 600.0
    cross_privacy_zone()
    assert await refusal(world.camera.capture(active_grant(), CaptureArgs())) == "PrivacyZone"


async def test_delayed_picture_is_judged_by_zones_active_at_exposure(world: World) -> None:
    world.drone.y = 0.0
    past = {**zone("z", box(-20, -20, 20, 20)), "schedule": [{"start": "08:00", "end": "11:50"}]}
    grant = active_grant(policy("p", "PrivacyControl", "camera", [past], action="refuse"))
    world.scene.latency_s = 300.0
    await world.capture(grant)
    world.scene.latency_s = 900.0
    assert await refusal(world.camera.capture(grant, CaptureArgs())) == "PrivacyZone"


async def test_queued_capture_is_judged_with_the_position_of_its_exposure(world: World) -> None:
    held_up = threading.Event()
    world.scene.during = lambda: held_up.wait(10) and None
    waiting = [asyncio.create_task(world.capture(active_grant())) for _ in range(MAX_PER_OWNER)]
    await world.scene.begun()
    assert await refusal_of_queue(world.capture(active_grant()))
    other = asyncio.create_task(world.capture(active_grant(instance="other")))
    await asyncio.sleep(0)
    world.drone.y = 60.0
    held_up.set()
    records = await asyncio.gather(*waiting)
    assert (await other).name == sorted(s.name for s in [*records, await other])[1], "callers take turns"
    for record in records:
        last = record.poses[-1]
        assert FRAME.xy(last.lat or 0, last.lon or 0)[1] == pytest.approx(60.0, abs=0.01)


async def refusal_of_queue(work: Any) -> bool:
    with pytest.raises(QueueFull, match="in progress") as caught:
        await work
    return caught.value.verdict.code == "ShutterBusy"


async def test_cancelled_capture_keeps_shutter_until_picture_is_stored(world: World) -> None:
    held_up = threading.Event()
    world.scene.during = lambda: held_up.wait(10) and None
    task = asyncio.create_task(world.camera.capture(active_grant(), CaptureArgs()))
    await world.scene.begun()
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    second = asyncio.create_task(world.capture(active_grant()))
    await asyncio.sleep(0.05)
    assert len(world.scene.taken) == 1, "the shutter is busy until the first picture is stored"
    held_up.set()
    await second
    for _ in range(1000):
        if len((await world.stored_images.list(active_grant()))[1]) == 2:
            return
        await asyncio.sleep(0.01)
    raise AssertionError("the picture of the cancelled call was not stored")


async def test_capture_is_refused_when_grant_ends_in_queue(world: World) -> None:
    def removed_grant() -> ActiveGrant:
        raise PolicyDenied("NoGrant", "gone")

    assert await refusal(world.camera.capture(active_grant(), CaptureArgs(), removed_grant)) == "NoGrant"
    assert not world.scene.taken


async def test_recreated_application_does_not_inherit_pictures(world: World) -> None:
    await world.capture(active_grant())
    assert len((await world.stored_images.list(active_grant()))[1]) == 1
    assert (await world.stored_images.list(active_grant(uid="u2")))[1] == ()


# Filters


async def test_audit_contains_filters_that_become_necessary(world: World) -> None:
    def written() -> list[tuple[str, list[str], list[str]]]:
        entries = [json.loads(line) for line in (world.directory.parent / "audit.jsonl").read_text().splitlines()]
        return [(entry["method"], entry["filters"], entry["policies"]) for entry in entries]

    far = policy("q", "PrivacyControl", "camera", [zone("far", box(500, 500, 510, 510))], action="refuse")
    free = active_grant(far)
    bound = active_grant(private("black"))
    faces = active_grant(private("blurFaces"))
    world.scene.during = lambda: setattr(world.drone, "y", 0.0)
    record = await world.capture(bound)  # The drone enters the zone during the exposure.
    await world.capture(bound)  # The drone is above the zone from the beginning.
    await world.capture(faces)  # The drone is too high to detect faces.
    plain = await world.capture(free)
    world.drone.y = 80.0
    await world.pixels(bound, record)  # The filter was applied at capture to `record`, but not to `plain`.
    await world.pixels(bound, plain)
    await world.audit.close()
    assert written() == [
        ("CaptureImage", [], []), ("CaptureImage", ["black"], ["p"]),
        ("CaptureImage", ["black"], ["p"]),
        ("CaptureImage", ["blurFaces"], ["p"]), ("CaptureImage", ["blurAverage"], ["p"]),
        ("CaptureImage", [], []),
        ("RetrieveImage", [], []),
        ("RetrieveImage", [], []), ("RetrieveImage", ["black"], ["p"]),
    ]  # fmt: skip


@pytest.mark.parametrize("action", ["black", "blurAverage", "blurMedian", "removeBackground"])
async def test_picture_is_filtered_before_it_is_stored(world: World, action: str) -> None:
    world.drone.y = 0.0
    grant = active_grant(private(action))
    verdict, record = await world.camera.capture(grant, CaptureArgs())
    assert (verdict.action, verdict.code, verdict.policies) == ("correct", "PrivacyFilter", ("p",))
    assert len(world.scene.taken) == (3 if action == "removeBackground" else 1)
    stored = world.stored(grant, record)
    assert grain(stored) < 12
    assert np.array_equal(await world.pixels(grant, record), stored), "a filtered picture is not filtered again"
    data = world.store.path(owner_of(grant), record.name).read_bytes()
    assert b"Exif" not in data
    assert b"Camera:" not in data


async def test_retrieval_is_judged_by_position_of_exposure(world: World) -> None:
    free = active_grant(
        policy("q", "PrivacyControl", "camera", [zone("far", box(500, 500, 510, 510))], action="refuse")
    )
    bound = active_grant(private("blurAverage"))  # fmt: skip
    world.drone.y = 0.0
    record = await world.capture(free)
    assert grain(world.stored(free, record)) > 30
    world.drone.y = 150.0
    verdict, shown, _ = await world.stored_images.retrieve(bound, record.name)
    assert (verdict.action, verdict.policies) == ("correct", ("p",))
    assert shown.filters
    assert grain(await world.pixels(bound, record)) < 12
    assert await refusal(world.stored_images.retrieve(active_grant(), record.name)) == "PrivacyZone"
    assert grain(await world.pixels(free, record)) > 30


async def test_retrieval_is_denied_when_picture_shows_denial_zone(world: World) -> None:
    """A denial of the method applies to the content of the picture, not to the current view of the camera."""
    ground = [zone("z", box(-20, -20, 20, 20))]
    methods = ["RetrieveImage"]
    grant = active_grant(policy("d", "AccessControl", "denial", ground, methods=methods))
    world.drone.y = 0.0
    record = await world.capture(grant)
    assert await refusal(world.stored_images.retrieve(grant, record.name)) == "MethodDenied"
    world.drone.y = 80.0
    assert await refusal(world.stored_images.retrieve(grant, record.name)) == "MethodDenied"
    assert (await world.stored_images.retrieve(grant, (await world.capture(grant)).name))[0].permits


async def test_delayed_picture_is_judged_by_denials_active_at_exposure(world: World) -> None:
    world.drone.y = 0.0
    past = {**zone("z", box(-20, -20, 20, 20)), "schedule": [{"start": "08:00", "end": "11:50"}]}
    grant = active_grant(policy("d", "AccessControl", "denial", [past], methods=["CaptureImage"]))
    await world.capture(grant)
    world.scene.latency_s = 900.0
    assert await refusal(world.camera.capture(grant, CaptureArgs())) == "MethodDenied"


async def test_retrieval_is_judged_again_after_filters_are_applied(world: World) -> None:
    far = [zone("far", box(500, 500, 510, 510))]
    free = active_grant(policy("q", "PrivacyControl", "camera", far, action="refuse"))
    bound = active_grant(private("blurAverage"))
    world.drone.y = 0.0
    record = await world.capture(free)
    _, shown, _ = await world.stored_images.retrieve(bound, record.name, lambda: bound)
    assert [filter_.action for filter_ in shown.filters] == ["blurAverage"]
    assert await refusal(world.stored_images.retrieve(bound, record.name, active_grant)) == "PrivacyZone"
    stricter = active_grant(private("black"))
    with pytest.raises(Refused, match="request it again") as caught:
        await world.stored_images.retrieve(bound, record.name, lambda: stricter)
    assert (caught.value.verdict.code, caught.value.verdict.policies) == ("PrivacyZone", ("p",))


async def test_retrieval_is_also_judged_by_current_position(world: World) -> None:
    record = await world.capture(active_grant(private("black")))
    world.drone.y = 0.0
    assert (await world.pixels(active_grant(private("black")), record)).max() == 0


async def test_faces_are_blurred_or_fallback_applies_when_too_small(tmp_path: Path) -> None:
    world = World(tmp_path, (1600, 1600))
    world.drone.y = 0.0
    world.drone.alt = 2.0
    world.finder.boxes = [(700, 700, 100, 100)]
    grant = active_grant(private("blurFaces"))
    stored = world.stored(grant, await world.capture(grant))
    assert grain(stored[700:800, 700:800]) < 12
    assert grain(stored[:600]) > 30
    world.drone.alt = 40.0
    verdict, record = await world.camera.capture(grant, CaptureArgs())
    assert "blurAverage is applied" in verdict.reason
    assert grain(world.stored(grant, record)) < 12
    strict = active_grant(private("blurFaces", fallback="refuse"))
    assert await refusal(world.camera.capture(strict, CaptureArgs())) == "FacesNotFound"
    assert grain(await world.pixels(active_grant(private("black")), record)) == 0
    world.shutter.close()


# The two shapes differ only in the axis.
@pytest.mark.parametrize(("width", "height"), [(62, 1600), pytest.param(1600, 62, marks=pytest.mark.slow)])
async def test_faces_cut_by_cropping_are_blurred(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, width: int, height: int
) -> None:
    world = World(tmp_path, (1600, 1600))
    world.drone.y = 0.0
    world.drone.alt = 2.0
    # The cropped picture shows two thirds of a face with a width of 97 pixels. A detector would not find this part.
    scene = np.full((1600, 1600, 3), 90, np.uint8)
    left = 776 - 225
    top = 776 - 114
    scene[top : top + 512, left : left + 512] = photograph()
    face = np.s_[776 - 38 : 776 + 38, 776 - 38 : 776 + 38]
    shown = np.s_[(1600 - height) // 2 : (1600 + height) // 2, (1600 - width) // 2 : (1600 + width) // 2]
    monkeypatch.setattr(world.scene, "capture", lambda _request: scene)
    monkeypatch.setattr(world.finder, "detect", CascadeDetector().detect)
    grant = active_grant(private("blurFaces"))
    later = active_grant(private("blurFaces"), uid="u2")
    picture = np.zeros_like(scene)
    picture[shown] = world.stored(grant, await world.capture(grant, width=width, height=height))
    before = np.zeros_like(scene)
    before[shown] = scene[shown]
    assert grain(picture[face]) < 0.5 * grain(before[face])
    world.drone.y = 80.0
    record = await world.capture(later, width=width, height=height)
    assert not record.filters
    assert not record.face_px, "face detection is not possible after cropping"
    assert (await world.capture(later, width=800, height=800)).face_px
    world.shutter.close()


async def test_weakly_blurred_faces_get_fallback_of_stricter_policy(tmp_path: Path) -> None:
    world = World(tmp_path, (1600, 1600))
    world.drone.y = 0.0
    world.drone.alt = 2.0
    world.finder.boxes = [(700, 700, 100, 100)]
    soft = active_grant(private("blurFaces", faces="gaussian"))
    record = await world.capture(soft)
    assert record.filters[0].faces == "gaussian"
    assert grain(await world.pixels(soft, record)) > 30
    world.finder.boxes = []
    for fallback, most in (("blurAverage", 12), ("black", 0)):
        hard = active_grant(private("blurFaces", faces="pixelate", fallback=fallback))
        assert grain(await world.pixels(hard, record)) <= most
    strict = active_grant(private("blurFaces", faces="pixelate", fallback="refuse"))
    assert await refusal(world.stored_images.retrieve(strict, record.name)) == "FacesNotFound"
    world.shutter.close()


@pytest.mark.parametrize(("size", "shown"), [((120, 160), (120, 68)), ((400, 90), (160, 90)), ((160, 90), (160, 90))])
async def test_stored_picture_shows_only_judged_view(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: tuple[int, int], shown: tuple[int, int]
) -> None:
    """The footprint is computed for 16:9. Pictures with another aspect ratio are cropped to it."""
    world = World(tmp_path, (160, 90))
    picture = np.zeros((size[1], size[0], 3), np.uint8)
    left = (size[0] - shown[0]) // 2
    top = (size[1] - shown[1]) // 2
    picture[top : top + shown[1], left : left + shown[0]] = 200
    monkeypatch.setattr(world.scene, "capture", lambda _request: picture)
    for requested in ({"width": 64, "height": 64}, {"width": 64, "height": 36}, {"width": 90, "height": 160}):
        stored = world.stored(active_grant(), await world.capture(active_grant(), **requested))
        assert stored.min() > 150, requested
    world.drone.lens = None
    elsewhere = active_grant(private("black"), uid="u9")
    assert (await world.capture(elsewhere, width=64, height=64)).filters, (
        "a camera without a known lens may see everything"
    )
    world.shutter.close()


async def test_face_size_is_unknown_without_lens(world: World) -> None:
    world.drone.lens = None
    verdict, _ = await world.camera.capture(active_grant(private("blurFaces")), CaptureArgs())
    assert "the size of faces is unknown" in verdict.reason
    assert verdict.policies == ("p",), "the zone is 80 m away, but the view of the camera is unknown"


async def test_enlarged_picture_does_not_enlarge_smallest_face(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(tmp_path, (1600, 1600))
    world.drone.y = 0.0
    world.drone.alt = 2.0
    small = np.zeros((100, 100, 3), np.uint8)
    monkeypatch.setattr(world.scene, "capture", lambda _request: small)
    verdict, record = await world.camera.capture(active_grant(private("blurFaces")), CaptureArgs())
    assert (record.width, record.height) == (1600, 1600)
    assert "faces may be as small as 3 pixels" in verdict.reason
    world.shutter.close()


@pytest.mark.parametrize(("width", "height"), [(15, 64), (64, 9000), (8192, 8192), (8000, 16)])
async def test_capture_refuses_invalid_picture_size(world: World, width: int, height: int) -> None:
    assert await refusal(world.camera.capture(active_grant(), CaptureArgs(width, height))) == "InvalidArgument"
    assert not world.scene.taken


# Failing cameras


async def test_hanging_camera_is_reported_and_recovers(tmp_path: Path) -> None:
    scene = Scene()
    stuck = threading.Event()
    scene.during = lambda: stuck.wait(20) and None
    shutter = Shutter(scene, timeout_s=0.2)
    request = CaptureRequest(8, 8, (8, 8), "RGB", at())
    with pytest.raises(CameraFailed, match="returned no image within"):
        await shutter.expose(request)
    begun = time.monotonic()
    with pytest.raises(CameraFailed, match="has not responded for"):
        await shutter.expose(request)
    assert time.monotonic() - begun < 5, "the call is refused at once"
    stuck.set()
    for _ in range(500):
        try:
            assert len(await shutter.expose(request)) == 1
            break
        except CameraFailed:
            await asyncio.sleep(0.01)
    else:
        raise AssertionError("the camera does not recover")
    shutter.close()


async def test_failed_camera_driver_is_used_again(world: World) -> None:
    def broken() -> None:
        raise CameraFailed("no light")

    world.scene.during = broken
    with pytest.raises(CameraFailed):
        await world.capture(active_grant())
    world.scene.during = lambda: None
    await world.capture(active_grant())
