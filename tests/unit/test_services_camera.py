"""The camera between judging and keeping: the drone moves, callers wait, applications are replaced."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fractus_core.policy.values import CaptureArgs, Situation
from fractus_services.audit import AuditLog
from fractus_services.camera import service as camera
from fractus_services.camera.album import Album
from fractus_services.camera.service import MAX_WAITING, CameraService
from fractus_services.grants import Held
from fractus_services.replies import Refused
from policy_world import FRAME, NOW, at, box, compiled, policy, spec, zone

PRIVATE = policy("p", "PrivacyControl", "camera", [zone("z", box(-20, -20, 20, 20))], action="refuse")


class Drone:
    """Whereabouts that a test moves."""

    def __init__(self) -> None:
        self.x, self.y = 0.0, 80.0

    def situation(self, time_s: float) -> Situation:
        return at(self.x, self.y, time_s=time_s)

    async def run(self) -> None:
        """Nothing to follow."""


def held(uid: str = "u1") -> Held:
    fields: dict[str, Any] = {
        "application": {"namespace": "default", "name": "app", "uid": uid},
        "services": [{"service": "camera", "methods": ["CaptureImage", "ListImages"]}],
    }
    return Held(uid, "g", spec(PRIVATE, **fields), compiled(PRIVATE, **fields))


@pytest.fixture
def drone() -> Drone:
    return Drone()


@pytest.fixture
def service(tmp_path: Path, drone: Drone) -> CameraService:
    log = AuditLog(tmp_path / "audit.jsonl", lambda: NOW)
    return CameraService(drone, Album(tmp_path / "album", 50, 10**9), log, lambda: NOW, (64, 64))


def exposing(monkeypatch: pytest.MonkeyPatch, during: Callable[[], None]) -> list[tuple[Any, ...]]:
    taken: list[tuple[Any, ...]] = []

    def render(*given: Any) -> bytes:
        taken.append(given)
        during()
        return b"jpeg"

    monkeypatch.setattr(camera, "render", render)
    return taken


async def refusal(work: Any) -> str:
    with pytest.raises(Refused) as caught:
        await work
    return caught.value.verdict.code


async def test_a_drone_that_flies_over_private_ground_during_the_exposure_keeps_no_picture(
    service: CameraService, drone: Drone, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = exposing(monkeypatch, lambda: setattr(drone, "y", 0.0))
    assert await refusal(service.capture(held(), CaptureArgs())) == "PrivacyZone"
    drone.y = 80.0
    assert len(taken) == 1
    assert (await service.list(held()))[1] == ()


async def test_those_who_wait_are_judged_and_placed_when_it_is_their_turn(
    service: CameraService, drone: Drone, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = exposing(monkeypatch, lambda: None)
    async with service._shutter:
        waiting = [asyncio.create_task(service.capture(held(), CaptureArgs())) for _ in range(MAX_WAITING)]
        await asyncio.sleep(0)
        assert await refusal(service.capture(held(), CaptureArgs())) == "ShutterBusy"
        drone.y = 60.0
    shots = [shot for _, shot in await asyncio.gather(*waiting)]
    assert len(taken) == MAX_WAITING
    for shot in shots:
        assert shot.lat is not None
        assert shot.lon is not None
        assert FRAME.xy(shot.lat, shot.lon)[1] == pytest.approx(60.0, abs=0.01)


async def test_a_caller_that_hangs_up_does_not_free_the_shutter(
    service: CameraService, monkeypatch: pytest.MonkeyPatch
) -> None:
    exposing(monkeypatch, lambda: None)
    async with service._shutter:
        task = asyncio.create_task(service.capture(held(), CaptureArgs()))
        await asyncio.sleep(0)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        assert len(service._exposing) == 1


async def test_a_grant_that_ends_while_its_caller_waits_takes_no_picture(
    service: CameraService, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = exposing(monkeypatch, lambda: None)

    def gone() -> Held:
        raise camera.refused(camera.Verdict("deny", None, "NoGrant", "gone"))

    assert await refusal(service.capture(held(), CaptureArgs(), gone)) == "NoGrant"
    assert not taken


async def test_an_application_of_the_same_name_does_not_inherit_pictures(
    service: CameraService, monkeypatch: pytest.MonkeyPatch
) -> None:
    exposing(monkeypatch, lambda: None)
    await service.capture(held(), CaptureArgs())
    assert len((await service.list(held()))[1]) == 1
    assert (await service.list(held("u2")))[1] == ()
