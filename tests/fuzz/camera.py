"""Fuzz sequences of calls to the camera service, from callers with and without a Grant.

No handler fails. No picture is taken in the private zone. Pictures are returned only to their owner, and no other file is read or
removed.
"""

from __future__ import annotations

import asyncio
import functools
import logging
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import atheris

with atheris.instrument_imports(include=["fractus_services.camera"]):
    from fractus_services.camera.fair_queue import FairQueue
    from fractus_services.camera.handlers import CameraHandlers
    from fractus_services.camera.image_authorization import ImageAuthorizer
    from fractus_services.camera.image_capture import ImageCapture
    from fractus_services.camera.image_store import ImageStore
    from fractus_services.camera.picture_counts import PictureCounts
import numpy as np
from camera_world import Drone, Finder, active_grant, private
from fractus_proto.v1 import camera_pb2, camera_pb2_grpc
from fractus_services.camera.camera_properties import CameraProperties
from fractus_services.camera.drivers.driver import CameraFailed, CaptureRequest
from fractus_services.camera.pixels import Pixels, limit_width
from fractus_services.camera.stored_images import StoredImages
from fractus_services.grant_files import ActiveGrant
from fractus_services.grpc_server import CallAdmission
from mobility_world import Grants
from policy_world import NOW
from virtual_time import fly
from wire import DEADLINES_S, STRANGE, Context, Registry, called, certificate, request

FOLDER = Path(tempfile.mkdtemp())
OTHERS = FOLDER / "other.jpg"
METHODS = camera_pb2.DESCRIPTOR.services_by_name["CameraService"].methods
TYPES = {method.name: getattr(camera_pb2, method.input_type.name) for method in METHODS}
NAMES = sorted(TYPES)
FIRST = active_grant()
SECOND = active_grant(private("blurFaces"), uid="u2", instance="app-viewer")
PLACES_M = [80.0, 0.0, 21.0]
"""Positions in metres north of home. The private zone extends to 20 m."""
PATHS = ["../../other.jpg", "../other.json", "/etc/passwd", "20260601120000000-0000.jpg/..", "a" * 20_000, "\0", ".jpg"]
logging.disable(logging.CRITICAL)
os.fsync = os.fdatasync = lambda _file: None  # durability is not tested


class Shutter:
    """Fake camera that returns a grey picture at once, or fails."""

    latency_s = 0.0

    def __init__(self) -> None:
        self.broken = False

    async def expose(self, request: CaptureRequest, count: int = 1, interval_s: float = 0.0) -> list[Pixels]:
        await asyncio.sleep(count * interval_s)
        if self.broken:
            raise CameraFailed("the camera returned no image")
        picture = np.full((request.height, request.width, 3), 128, np.uint8)
        return [picture if i == count // 2 else limit_width(picture, 64) for i in range(count)]


class Service:
    """Camera service with two components, on a drone at a position set by the fuzzer."""

    def __init__(self) -> None:
        self.drone = Drone()
        self.shutter = Shutter()
        self.grants = Grants()
        self.names: dict[str, list[str]] = {}
        for grant in (FIRST, SECOND):
            self.grants.active[grant.identity] = grant
        shutil.rmtree(FOLDER / "images", ignore_errors=True)
        store = ImageStore(FOLDER / "images", 5, 10**6)
        audit: Any = SimpleNamespace(append=lambda _kind, _content: None)
        finder = Finder()
        shared: Any = {
            "detector": finder, "filter_queue": FairQueue(4, 8), "store": store,
            "authorizer": ImageAuthorizer(audit, finder), "clock": lambda: NOW,
        }  # fmt: skip
        admission = CallAdmission(self.grants, time.time)  # type: ignore[arg-type]
        handlers = CameraHandlers(
            ImageCapture(self.drone, self.shutter, CameraProperties((64, 48)), capture_queue=FairQueue(4, 8), **shared),  # type: ignore[arg-type]
            StoredImages(self.drone, **shared), admission, PictureCounts(FOLDER / "picture-counts.json", tuple),
        )  # fmt: skip
        registry = Registry(admission)
        camera_pb2_grpc.add_CameraServiceServicer_to_server(handlers, registry)
        self.handlers = registry.handlers


@functools.cache
def of(identity: str, days: int = 36500) -> bytes:
    """Return the certificate of a caller, from a cache."""
    return certificate(identity, days=days)


async def calls(data_provider: atheris.FuzzedDataProvider) -> None:
    """Make up to twelve calls, in sequence or in parallel."""
    service = Service()
    chains = [(of(FIRST.identity),), (of(SECOND.identity),), *STRANGE, (of(FIRST.identity, 1),)]
    running: list[asyncio.Task[None]] = []
    for _ in range(12):
        if not data_provider.remaining_bytes():
            break
        if not running:
            service.drone.y = data_provider.PickValueInList(PLACES_M)
            service.shutter.broken = not data_provider.ConsumeIntInRange(0, 9)
        which = data_provider.ConsumeIntInRange(0, 3 * len(chains) - 1)
        chain = chains[which if which < len(chains) else which % 2]
        name = data_provider.PickValueInList(NAMES)
        body = (
            _named(data_provider, service, name) if data_provider.ConsumeBool() else request(data_provider, TYPES[name])
        )
        deadline_s = (
            data_provider.PickValueInList(DEADLINES_S) if not data_provider.ConsumeIntInRange(0, 7) else DEADLINES_S[0]
        )
        caller = {chains[0]: FIRST, chains[1]: SECOND}.get(chain)
        call = asyncio.ensure_future(checked_call(service, name, body, Context(chain, deadline_s), caller))
        running.append(call)
        if not data_provider.ConsumeIntInRange(0, 7):
            call.cancel()
        if data_provider.ConsumeBool():
            await _ended(running)
    await _ended(running)
    assert OTHERS.read_bytes() == b"other"


async def _ended(running: list[asyncio.Task[None]]) -> None:
    for outcome in await asyncio.gather(*running, return_exceptions=True):
        if isinstance(outcome, Exception):
            raise outcome
    running.clear()


def _named(data_provider: atheris.FuzzedDataProvider, service: Service, name: str) -> bytes:
    """Return a request with a valid or extreme size, or with the name of an existing picture of either component."""
    if name == "CaptureImage":
        sizes = [0, 16, 48, 64, 2**32 - 1]
        return bytes(
            camera_pb2.CaptureImageRequest(
                width=data_provider.PickValueInList(sizes), height=data_provider.PickValueInList(sizes)
            ).SerializeToString()
        )
    message = TYPES[name]()
    if hasattr(message, "name"):
        known = [name for names in service.names.values() for name in names]
        message.name = (
            data_provider.PickValueInList(known or PATHS)
            if data_provider.ConsumeBool()
            else data_provider.PickValueInList(PATHS)
        )
    return bytes(message.SerializeToString())


async def checked_call(service: Service, name: str, body: bytes, context: Context, caller: ActiveGrant | None) -> None:
    """Make a call and check its reply."""
    answer = await called(service.handlers[name], body, context)
    if answer is None and not context.written:
        assert context.code is not None, f"{name} has no reply"
        return
    assert caller is not None, f"{name} of a caller without Grant is allowed"
    own_names = service.names.setdefault(caller.identity, [])
    if name == "CaptureImage":
        in_private_zone = abs(service.drone.y) < 20
        assert not (in_private_zone and caller is FIRST), "a picture of the private zone"
        own_names.append(answer.image.name)
    elif name == "RetrieveImage":
        assert context.written[0].image.name in own_names, context.written[0].image.name
        assert b"".join(part.data for part in context.written)[:2] == b"\xff\xd8"
    elif name == "ListImages":
        assert {image.name for image in answer.images} <= set(own_names)


def fuzz_one(data: bytes) -> None:
    """Run one sequence of calls."""
    OTHERS.write_bytes(b"other")
    fly(lambda: calls(atheris.FuzzedDataProvider(data)))


if __name__ == "__main__":
    atheris.Setup(sys.argv, fuzz_one)
    atheris.Fuzz()
