"""gRPC handlers of the camera service."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from fractus_core.policy.decision_types import CaptureArgs
from fractus_proto.v1 import camera_pb2, camera_pb2_grpc

from fractus_services.admission import CallAdmission
from fractus_services.auth import Caller
from fractus_services.camera.image_capture import ImageCapture
from fractus_services.camera.image_record import ImageRecord
from fractus_services.camera.image_store import NoSuchImage, owner_of
from fractus_services.camera.stored_images import StoredImages
from fractus_services.error_details import decision
from fractus_services.errors import ResourceExhausted

CHUNK_BYTES = 256 * 1024
READ_BYTES = 4 * CHUNK_BYTES


class CameraHandlers(camera_pb2_grpc.CameraServiceServicer):
    """The service on the wire."""

    def __init__(self, capture: ImageCapture, library: StoredImages, calls: CallAdmission) -> None:
        self._capture = capture
        self._library = library
        self._admission = calls

    @asynccontextmanager
    async def _call(self, context: Any) -> AsyncIterator[Caller]:
        async with self._admission.call(context) as caller:
            try:
                yield caller
            except OSError as error:
                raise storage_failed(error) from error

    async def CaptureImage(self, request: Any, context: Any) -> Any:  # noqa: N802 - the protocol's name
        """See camera.proto."""
        async with self._call(context) as caller:
            grant = self._admission.grant_of(caller)
            args = CaptureArgs(request.width, request.height)
            verdict, shot = await self._capture.capture(grant, args, lambda: self._admission.grant_of(caller))
            return camera_pb2.CaptureImageResponse(decision=decision(verdict), image=_info(shot))

    async def RetrieveImage(self, request: Any, context: Any) -> None:  # noqa: N802
        """See camera.proto."""
        async with self._call(context) as caller:
            grant = self._admission.grant_of(caller)
            verdict, shot, source = await self._library.retrieve(
                grant, request.name, lambda: self._admission.grant_of(caller)
            )
            head: dict[str, Any] = {"decision": decision(verdict), "image": _info(shot)}
            async for piece in _pieces(source, request.name):
                for at in range(0, len(piece), CHUNK_BYTES):
                    # A reader sets the pace, and a deadline may be far away: what was permitted may not be any more.
                    self._library.judge_again(self._admission.grant_of(caller), owner_of(grant), shot)
                    await context.write(camera_pb2.ImageChunk(data=piece[at : at + CHUNK_BYTES], **head))
                    head = {}

    async def ListImages(self, _request: Any, context: Any) -> Any:  # noqa: N802
        """See camera.proto."""
        async with self._call(context) as caller:
            verdict, shots = await self._library.list(self._admission.grant_of(caller))
            return camera_pb2.ListImagesResponse(decision=decision(verdict), images=[_info(shot) for shot in shots])

    async def DeleteImage(self, request: Any, context: Any) -> Any:  # noqa: N802
        """See camera.proto."""
        async with self._call(context) as caller:
            verdict = await self._library.delete(self._admission.grant_of(caller), request.name)
            return camera_pb2.DeleteImageResponse(decision=decision(verdict))


def storage_failed(error: OSError) -> ResourceExhausted:
    """A failure of the disk as a refusal."""
    reason = f"the picture cannot be stored: {error.strerror or error}; delete pictures, or make room on the node"
    return ResourceExhausted("StorageFailed", reason)


async def _pieces(source: bytes | Path, name: str) -> AsyncIterator[bytes]:
    """The bytes of a picture; a file is read in pieces, so that slow readers cost no memory.

    Raises:
        NoSuchImage: it was deleted meanwhile.
    """
    if isinstance(source, bytes):
        yield source
        return
    try:
        file = await asyncio.to_thread(source.open, "rb")
    except FileNotFoundError:
        raise NoSuchImage(f"picture {name[:64]!r} was deleted") from None
    with file:
        while piece := await asyncio.to_thread(file.read, READ_BYTES):
            yield piece


def _info(shot: ImageRecord) -> camera_pb2.ImageInfo:
    info = camera_pb2.ImageInfo(
        name=shot.name, width=shot.width, height=shot.height, size_bytes=shot.size_bytes, media_type="image/jpeg"
    )
    info.time.FromNanoseconds(int(shot.time_s * 1e9))
    taken = shot.poses[-1]
    # Where a filtered picture was taken is private too: a policy asked for the filter there.
    if taken.lat is not None and taken.lon is not None and not shot.filters:
        info.position.latitude_deg, info.position.longitude_deg = taken.lat, taken.lon
        info.position.altitude_m = taken.altitude_m
    return info
