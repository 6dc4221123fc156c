"""Client of the camera service."""

from __future__ import annotations

import asyncio
import logging
import operator
from collections.abc import AsyncGenerator
from typing import SupportsIndex

import grpc
import grpc.aio
from fractus_proto.v1 import camera_pb2, camera_pb2_grpc, types_pb2

from fractus.channel import CALL_TIMEOUT_S, RECONNECT_TIMEOUT_S, ServiceChannel, ServiceClient
from fractus.environment import Endpoint, endpoint
from fractus.errors import FractusError, InvalidRequest, Unavailable, translate
from fractus.values import Decision, ImageInfo, Picture, Result

log = logging.getLogger(__name__)

MAX_PIXELS = 2**31 - 1
RETRIEVE_TIMEOUT_S = 60.0
CAPTURE_TIMEOUT_S = 120.0
"""Default timeout of a capture, in seconds. Face detection in pictures of several megapixels is slow."""


class Camera(ServiceClient):
    """Client of this node's camera service, which takes pictures and stores them until they are retrieved or deleted."""

    def __init__(
        self, endpoint: Endpoint, *, timeout_s: float = CALL_TIMEOUT_S, reconnect_timeout_s: float = RECONNECT_TIMEOUT_S
    ) -> None:
        self._channel = ServiceChannel(
            endpoint, camera_pb2_grpc.CameraServiceStub, timeout_s=timeout_s, reconnect_timeout_s=reconnect_timeout_s
        )

    async def capture(self, width: int = 0, height: int = 0, *, timeout_s: float = CAPTURE_TIMEOUT_S) -> ImageInfo:
        """Take a picture and store it on the node.

        If privacy policies require filters, the stored picture is filtered, and `decision` of the result contains the
        reason. If faces must be hidden but may be too small to be detected, the whole picture is blurred: fly closer, or
        request more pixels.

        The node stores 200 pictures per component and then takes no more: `delete` retrieved pictures, or use `take`.

        Args:
            width: Width in pixels; 0 selects the camera's default.
            height: Height in pixels; 0 selects the camera's default.
            timeout_s: Longest duration of the call, in seconds.

        Raises:
            PolicyDenied: Policies forbid pictures at this position, or of this area.
            Unavailable: The camera returned no picture.
        """
        request = capture_request(width, height)
        reply = await self._channel.unary("CaptureImage", request, timeout_s=timeout_s)
        return ImageInfo.from_proto(reply.image, reply.decision)

    async def take(self, width: int = 0, height: int = 0, *, timeout_s: float = CAPTURE_TIMEOUT_S) -> Picture:
        """Take a picture, retrieve it, and delete it from the node.

        The picture is judged twice: when it is taken and when it is retrieved. The component needs the methods
        CaptureImage, RetrieveImage and DeleteImage.

        Args:
            width: Width in pixels; 0 selects the camera's default.
            height: Height in pixels; 0 selects the camera's default.
            timeout_s: Longest duration of the capture, in seconds.

        Raises:
            PolicyDenied: Policies forbid pictures at this position, or of this area.
            Unavailable: The camera returned no picture, or the transfer was interrupted.
        """
        info = await self.capture(width, height, timeout_s=timeout_s)
        try:
            return Picture(info, await self.retrieve(info.name))
        finally:
            # A failed deletion must neither lose a retrieved picture nor hide the error of a failed retrieval.
            try:
                await self.delete(info.name)
            except FractusError as error:
                log.warning("camera: picture not deleted from the node (name=%s error=%s)", info.name, error)

    async def every(self, interval_s: float, width: int = 0, height: int = 0) -> AsyncGenerator[Picture, None]:
        """Take a picture every `interval_s` seconds until the iteration is left. A slower camera extends the interval.

        Each picture is retrieved and deleted from the node as by `take`, so the iteration may last for the whole flight.

        Args:
            interval_s: Seconds between the starts of two captures.
            width: Width in pixels; 0 selects the camera's default.
            height: Height in pixels; 0 selects the camera's default.

        Raises:
            PolicyDenied: Policies forbid pictures at this position, or of this area. Call the method again elsewhere.
            Unavailable: The camera returned no picture.
        """
        loop = asyncio.get_running_loop()
        while True:
            due = loop.time() + interval_s
            yield await self.take(width, height)
            await asyncio.sleep(max(due - loop.time(), 0.0))

    async def retrieve(self, name: str, *, timeout_s: float = RETRIEVE_TIMEOUT_S) -> bytes:
        """Retrieve a stored picture, filtered as privacy policies require.

        Raises:
            PolicyDenied: Policies forbid this picture.
            InvalidRequest: There is no picture with this name.
            Unavailable: The transfer was interrupted.
        """
        parts: list[bytes] = []
        size: int | None = None
        async with self._channel.stub() as stub:
            try:
                async for chunk in stub.RetrieveImage(camera_pb2.RetrieveImageRequest(name=name), timeout=timeout_s):
                    parts.append(chunk.data)
                    if chunk.HasField("image") and chunk.image.size_bytes:
                        size = chunk.image.size_bytes
            except grpc.aio.AioRpcError as error:
                raise translate(error, "RetrieveImage", self._channel.address) from None
        picture = b"".join(parts)
        if size is not None and len(picture) != size:
            raise Unavailable(f"RetrieveImage: {name} ended after {len(picture)} of {size} bytes; retrieve it again")
        return picture

    async def list(self) -> tuple[ImageInfo, ...]:
        """Return the stored pictures of this component, oldest first."""
        reply = await self._channel.unary("ListImages", camera_pb2.ListImagesRequest())
        return tuple(ImageInfo.from_proto(image, reply.decision) for image in reply.images)

    async def delete(self, name: str) -> Result:
        """Delete a picture from the node.

        If the node records pictures (`fractus camera serve --recordings`), the copy in the recording stays until its
        segment is removed.
        """
        reply: types_pb2.Decision = (
            await self._channel.unary("DeleteImage", camera_pb2.DeleteImageRequest(name=name))
        ).decision
        return Result(decision=Decision.from_proto(reply))


def camera(target: Endpoint | None = None, *, reconnect_timeout_s: float = RECONNECT_TIMEOUT_S) -> Camera:
    """Return a client of this node's camera service: `async with fractus.camera() as camera`.

    Args:
        target: Endpoint of the service; by default from the pod's environment.
        reconnect_timeout_s: Time for which calls wait for a restarting service, in seconds.

    Raises:
        NotConfigured: The process is not in a pod of a Fractus application, and no target is given.
    """
    return Camera(target or endpoint("camera"), reconnect_timeout_s=reconnect_timeout_s)


def capture_request(width: int, height: int) -> camera_pb2.CaptureImageRequest:
    """Return the request of a picture with a size in pixels."""
    for name, value in (("width", width), ("height", height)):
        if not isinstance(value, SupportsIndex) or not 0 <= operator.index(value) <= MAX_PIXELS:
            raise InvalidRequest(
                f"CaptureImage: {name} must be a whole number of pixels, not {value!r:.40}; 0 selects the camera's default"
            )
    return camera_pb2.CaptureImageRequest(width=width, height=height)
