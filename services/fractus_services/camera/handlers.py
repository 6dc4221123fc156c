"""gRPC handlers of the camera service."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from fractus_core.policy.decision_types import CaptureArgs
from fractus_proto.v1 import camera_pb2, camera_pb2_grpc
from fractus_runtime.files import UnsuitableFile, open_file
from grpc.aio import ServicerContext

from fractus_services.auth import Caller
from fractus_services.camera.image_capture import ImageCapture
from fractus_services.camera.image_store import ImageRecord, NoSuchImage, owner_of
from fractus_services.camera.picture_counts import PictureCounts
from fractus_services.camera.stored_images import StoredImages
from fractus_services.error_details import decision
from fractus_services.errors import PolicyDenied, ResourceExhausted
from fractus_services.grpc_server import CallAdmission

CHUNK_BYTES = 256 * 1024
READ_BYTES = 4 * CHUNK_BYTES


class CameraHandlers(camera_pb2_grpc.CameraServiceServicer):
    """Servicer of `CameraService`. Methods are documented in camera.proto."""

    def __init__(
        self, capture: ImageCapture, stored: StoredImages, admission: CallAdmission, counts: PictureCounts
    ) -> None:
        self._capture = capture
        self._stored = stored
        self._admission = admission
        self._counts = counts

    @asynccontextmanager
    async def _call(self, context: ServicerContext) -> AsyncIterator[Caller]:
        async with self._admission.call(context) as caller:
            try:
                yield caller
            except OSError as error:
                raise storage_failed(error) from error

    async def CaptureImage(  # noqa: N802
        self, request: camera_pb2.CaptureImageRequest, context: ServicerContext
    ) -> camera_pb2.CaptureImageResponse:
        """See camera.proto."""
        async with self._call(context) as caller:
            grant = self._admission.grant_of(caller)
            args = CaptureArgs(request.width, request.height)
            try:
                verdict, record = await self._capture.capture(grant, args, lambda: self._admission.grant_of(caller))
            except PolicyDenied:
                self._counts.count(grant.key, refused=True)
                raise
            self._counts.count(grant.key, refused=False)
            located = self._stored.locates(self._admission.grant_of(caller), record)
            return camera_pb2.CaptureImageResponse(decision=decision(verdict), image=_image_info(record, located))

    async def RetrieveImage(  # noqa: N802
        self, request: camera_pb2.RetrieveImageRequest, context: ServicerContext
    ) -> None:
        """See camera.proto."""
        async with self._call(context) as caller:
            grant = self._admission.grant_of(caller)
            verdict, record, source = await self._stored.retrieve(
                grant, request.name, lambda: self._admission.grant_of(caller)
            )
            # Images in memory have no metadata: filters were applied now, or the position was removed.
            located = isinstance(source, Path) and not record.filters
            head: dict[str, Any] = {"decision": decision(verdict), "image": _image_info(record, located)}
            async for block in _read_blocks(source, request.name):
                for start in range(0, len(block), CHUNK_BYTES):
                    # Authorize each chunk: a slow reader can extend the transfer until the image is no longer permitted.
                    self._stored.authorize_transfer(
                        self._admission.grant_of(caller), owner_of(grant), record, has_position=located
                    )
                    await context.write(camera_pb2.ImageChunk(data=block[start : start + CHUNK_BYTES], **head))
                    head = {}

    async def ListImages(  # noqa: N802
        self, _request: camera_pb2.ListImagesRequest, context: ServicerContext
    ) -> camera_pb2.ListImagesResponse:
        """See camera.proto."""
        async with self._call(context) as caller:
            verdict, records = await self._stored.list(self._admission.grant_of(caller))
            grant = self._admission.grant_of(caller)
            images = [_image_info(record, self._stored.locates(grant, record)) for record in records]
            return camera_pb2.ListImagesResponse(decision=decision(verdict), images=images)

    async def DeleteImage(  # noqa: N802
        self, request: camera_pb2.DeleteImageRequest, context: ServicerContext
    ) -> camera_pb2.DeleteImageResponse:
        """See camera.proto."""
        async with self._call(context) as caller:
            verdict = await self._stored.delete(self._admission.grant_of(caller), request.name)
            return camera_pb2.DeleteImageResponse(decision=decision(verdict))


def storage_failed(error: OSError) -> ResourceExhausted:
    """Convert a disk error to a refusal."""
    reason = f"cannot store the image: {error.strerror or error}; delete images, or free disk space on the node"
    return ResourceExhausted("StorageFailed", reason)


async def _read_blocks(source: bytes | Path, name: str) -> AsyncIterator[bytes]:
    """Yield the bytes of an image. A file is read in blocks, so that slow readers use little memory.

    Raises:
        NoSuchImage: The image was deleted.
    """
    if isinstance(source, bytes):
        yield source
        return
    try:
        file = await asyncio.to_thread(open_file, source)
    except (FileNotFoundError, UnsuitableFile):
        raise NoSuchImage(f"image {name[:64]!r} was deleted") from None
    with file:
        while block := await asyncio.to_thread(file.read, READ_BYTES):
            yield block


def _image_info(record: ImageRecord, located: bool) -> camera_pb2.ImageInfo:
    """Return the description of an image, with its position if the caller may know the position (`located`)."""
    info = camera_pb2.ImageInfo(
        name=record.name,
        width=record.width,
        height=record.height,
        size_bytes=record.size_bytes,
        media_type="image/jpeg",
    )
    info.time.FromNanoseconds(int(record.time_s * 1e9))
    pose = record.poses[-1]
    if located and pose.lat is not None and pose.lon is not None:
        info.position.latitude_deg = pose.lat
        info.position.longitude_deg = pose.lon
        info.position.altitude_m = pose.altitude_m
    return info
