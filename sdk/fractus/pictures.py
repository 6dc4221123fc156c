"""The camera of the node that this component runs on."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncGenerator

import grpc
import grpc.aio
from fractus_proto.v1 import camera_pb2, camera_pb2_grpc, types_pb2

from fractus.channel import CALL_TIMEOUT_S, RECONNECT_TIMEOUT_S, ServiceChannel, ServiceClient
from fractus.environment import Endpoint, endpoint
from fractus.errors import FractusError, Unavailable, translate
from fractus.requests import capture_request
from fractus.values import Decision, ImageInfo, Picture, Result

log = logging.getLogger(__name__)

RETRIEVE_TIMEOUT_S = 60.0
CAPTURE_TIMEOUT_S = 120.0
"""Looking for faces in megapixels takes its time."""


class Camera(ServiceClient):
    """The camera service of this node: pictures are taken, kept on the node, and fetched from there."""

    def __init__(
        self, endpoint: Endpoint, *, timeout_s: float = CALL_TIMEOUT_S, reconnect_timeout_s: float = RECONNECT_TIMEOUT_S
    ) -> None:
        self._channel = ServiceChannel(
            endpoint, camera_pb2_grpc.CameraServiceStub, timeout_s=timeout_s, reconnect_timeout_s=reconnect_timeout_s
        )

    async def capture(self, width: int = 0, height: int = 0, *, timeout_s: float = CAPTURE_TIMEOUT_S) -> ImageInfo:
        """Take a picture; 0 leaves width and height to the camera.

        Where privacy policies ask for filters, the picture is kept filtered: `corrected` says so, and why. It is blurred as
        a whole where faces are to be hidden but may be too small to be found; come closer, or ask for more pixels.

        The node keeps 200 of a component, and then takes no more: `delete` those that are fetched, or use `take`.

        Raises:
            PolicyDenied: no pictures from here, or not of this.
            Unavailable: the camera gives no picture.
        """
        request = capture_request(width, height)
        reply = await self._channel.unary("CaptureImage", request, timeout_s=timeout_s)
        return ImageInfo.from_proto(reply.image, reply.decision)

    async def take(self, width: int = 0, height: int = 0, *, timeout_s: float = CAPTURE_TIMEOUT_S) -> Picture:
        """Take a picture, fetch it, and delete it from the node, which keeps 200 of a component and then takes no more.

        Judged twice, when it is taken and when it is fetched. The component needs CaptureImage, RetrieveImage and DeleteImage.

        Args:
            width: pixels; 0 leaves it to the camera.
            height: pixels; 0 leaves it to the camera.
            timeout_s: how long the camera may take.

        Raises:
            PolicyDenied: no pictures from here, or not of this.
            Unavailable: the camera gives no picture, or the transfer broke off.
        """
        info = await self.capture(width, height, timeout_s=timeout_s)
        try:
            return Picture(info, await self.retrieve(info.name))
        finally:
            # A failure here neither loses a picture that was fetched nor hides why one was not.
            try:
                await self.delete(info.name)
            except FractusError as error:
                log.warning("camera: picture stays on the node (name=%s error=%s)", info.name, error)

    async def every(self, interval_s: float, width: int = 0, height: int = 0) -> AsyncGenerator[Picture, None]:
        """Take a picture each `interval_s` seconds, until the iteration is left; a camera that takes longer is waited for.

        Each is fetched and deleted from the node, as `take` does, so it may go on for as long as the flight.

        Args:
            interval_s: seconds from the beginning of one picture to that of the next.
            width: pixels; 0 leaves it to the camera.
            height: pixels; 0 leaves it to the camera.

        Raises:
            PolicyDenied: no pictures from here, or not of this; call it again further on.
            Unavailable: the camera gives no picture.
        """
        loop = asyncio.get_running_loop()
        while True:
            due = loop.time() + interval_s
            yield await self.take(width, height)
            await asyncio.sleep(max(due - loop.time(), 0.0))

    async def retrieve(self, name: str, *, timeout_s: float = RETRIEVE_TIMEOUT_S) -> bytes:
        """Fetch a picture, with what privacy policies demand already done to it.

        Raises:
            PolicyDenied: not this one.
            InvalidRequest: there is no such picture.
            Unavailable: the transfer broke off.
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
            raise Unavailable(f"RetrieveImage: {name} ended after {len(picture)} of {size} bytes; fetch it again")
        return picture

    async def list(self) -> tuple[ImageInfo, ...]:
        """The pictures of this component on the node, oldest first."""
        reply = await self._channel.unary("ListImages", camera_pb2.ListImagesRequest())
        return tuple(ImageInfo.from_proto(image, reply.decision) for image in reply.images)

    async def delete(self, name: str) -> Result:
        """Delete a picture from the node.

        Where the node records pictures (`fractus camera serve --recordings`), the copy in the recording stays until its segment
        makes room for newer ones.
        """
        reply: types_pb2.Decision = (
            await self._channel.unary("DeleteImage", camera_pb2.DeleteImageRequest(name=name))
        ).decision
        return Result(decision=Decision.from_proto(reply))


def camera(target: Endpoint | None = None, *, reconnect_timeout_s: float = RECONNECT_TIMEOUT_S) -> Camera:
    """The camera service of this node: `async with fractus.camera() as camera`.

    Args:
        target: where it is; by default what the pod's environment says.
        reconnect_timeout_s: how long calls wait for a service that is restarting.

    Raises:
        NotConfigured: not in a pod of a Fractus application, and no target given.
    """
    return Camera(target or endpoint("camera"), reconnect_timeout_s=reconnect_timeout_s)
