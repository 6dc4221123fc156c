"""Camera service with a fake drone, camera and face detector, for tests."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fractus_core.policy.decision_types import Attitude, CaptureArgs, Lens, Situation
from fractus_runtime.audit import AuditLog
from fractus_services.camera.camera_properties import CameraProperties
from fractus_services.camera.drivers.driver import CaptureRequest
from fractus_services.camera.face_detection import Box
from fractus_services.camera.fair_queue import FairQueue
from fractus_services.camera.image_authorization import ImageAuthorizer
from fractus_services.camera.image_capture import ImageCapture
from fractus_services.camera.image_store import ImageRecord, ImageStore, owner_of
from fractus_services.camera.pixels import Pixels, decode_image
from fractus_services.camera.shutter import Shutter
from fractus_services.camera.stored_images import StoredImages
from fractus_services.errors import Refused
from fractus_services.grant_files import ActiveGrant
from policy_world import NOW, at, box, compiled, policy, spec, zone

MAX_PER_OWNER = 4
SEEING = Lens(60.0, 60.0, stabilised=True, error_deg=0.0)


def private(action: str = "refuse", name: str = "p", **fields: Any) -> dict[str, Any]:
    return policy(name, "PrivacyControl", "camera", [zone("z", box(-20, -20, 20, 20))], action=action, **fields)


class Drone:
    """Fake pose provider. A test sets the pose. All returned situations are recorded."""

    fixed = False

    def __init__(self) -> None:
        self.x = 0.0
        self.y = 80.0
        self.alt = 10.0
        self.yaw = 0.0
        self.lens: Lens | None = SEEING
        self.recorded: list[tuple[float, Situation]] = []

    def situation(self, time_s: float) -> Situation:
        now = at(
            self.x, self.y, alt=self.alt, time_s=time_s, lens=self.lens, attitude=Attitude(0, 0, self.yaw, 0, 0)
        )  # fmt: skip
        self.recorded.append((time.monotonic(), now))
        return now

    def situations_since(self, begun_s: float, time_s: float) -> tuple[Situation, ...]:
        self.situation(time_s)
        return tuple(situation for recorded_s, situation in self.recorded if recorded_s >= begun_s)


class Scene:
    """Fake camera. It returns noise, and calls the function `during` of the test during the exposure."""

    def __init__(self) -> None:
        self.latency_s = 0.0
        self.taken: list[CaptureRequest] = []
        self.during: Callable[[], None] = lambda: None
        self._begun = threading.Event()

    async def begun(self) -> None:
        assert await asyncio.to_thread(self._begun.wait, 10)

    def capture(self, request: CaptureRequest) -> Pixels:
        self.taken.append(request)
        self._begun.set()
        self.during()
        noise = np.random.default_rng(1).integers(0, 256, (request.height, request.width, 3))
        return noise.astype(np.uint8)

    def close(self) -> None:
        """Do nothing."""


class Finder:
    """Face detector that returns the boxes set by the test."""

    name = "test"
    min_px = 40.0

    def __init__(self) -> None:
        self.boxes: list[Box] = []

    def detect(self, picture: Pixels, smallest_px: float, *, upright: bool) -> list[Box]:
        assert smallest_px >= self.min_px
        assert not upright
        return self.boxes


CAMERA_SERVICE = {"service": "camera", "methods": ["CaptureImage", "RetrieveImage", "ListImages", "DeleteImage"]}
MOBILITY_SERVICE = {"service": "mobility", "methods": ["GetPosition"]}


def active_grant(
    *policies: dict[str, Any], uid: str = "u1", instance: str = "app-navigator", locates: bool = True
) -> ActiveGrant:
    fields: dict[str, Any] = {
        "application": {"namespace": "default", "name": "app", "uid": uid},
        "instance": instance,
        "services": [CAMERA_SERVICE, *([MOBILITY_SERVICE] if locates else [])],
    }
    chosen = policies or (private(),)
    return ActiveGrant(uid, "g", spec(*chosen, **fields), compiled(*chosen, **fields))


class World:
    """Camera service with its collaborators."""

    def __init__(
        self, directory: Path, resolution: tuple[int, int] = (64, 64), keep: int = 50, pinhole: bool = False
    ) -> None:
        self.directory = directory / "images"
        self.drone = Drone()
        self.scene = Scene()
        self.finder = Finder()
        self.shutter = Shutter(self.scene, timeout_s=5.0)
        self.audit = AuditLog(directory / "audit.jsonl", lambda: NOW)
        self.store = ImageStore(self.directory, keep, 10**9)
        authorizer = ImageAuthorizer(self.audit, self.finder)
        filter_queue = FairQueue(MAX_PER_OWNER, 8)
        capture_queue = FairQueue(MAX_PER_OWNER, 8)
        self.camera = ImageCapture(
            self.drone, self.shutter, CameraProperties(resolution, pinhole=pinhole), detector=self.finder, filter_queue=filter_queue,
            capture_queue=capture_queue, store=self.store, authorizer=authorizer, clock=lambda: NOW,
        )  # fmt: skip
        self.stored_images = StoredImages(
            self.drone,
            self.store,
            detector=self.finder,
            filter_queue=filter_queue,
            authorizer=authorizer,
            clock=lambda: NOW,
        )

    async def capture(self, grant: ActiveGrant, **size: int) -> ImageRecord:
        return (await self.camera.capture(grant, CaptureArgs(**size)))[1]

    async def pixels(self, grant: ActiveGrant, record: ImageRecord) -> Pixels:
        source = (await self.stored_images.retrieve(grant, record.name))[2]
        return decode_image(source if isinstance(source, bytes) else source.read_bytes())

    def stored(self, grant: ActiveGrant, record: ImageRecord) -> Pixels:
        return decode_image(self.store.path(owner_of(grant), record.name).read_bytes())


async def refusal(work: Any) -> str:
    with pytest.raises(Refused) as caught:
        await work
    return caught.value.verdict.code


def grain(picture: Pixels) -> float:
    """Return the mean difference of adjacent pixels. It is small in blurred pictures."""
    return float(np.abs(np.diff(picture.astype(float), axis=1)).mean())
