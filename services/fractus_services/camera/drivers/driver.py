"""Interface of camera drivers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from fractus_core.policy.decision_types import Situation

from fractus_services.camera.pixels import Pixels
from fractus_services.errors import Unavailable
from fractus_services.options import CannotServe

TIMEOUT_S = 5.0
"""Timeout of one image, in seconds, for drivers that use the network."""


class CameraFailed(Unavailable):
    """The camera returned no image. The message contains the reason and what to check."""

    def __init__(self, reason: str) -> None:
        super().__init__("CameraFailed", reason)


class InvalidCameraConnection(CannotServe):
    """The connection string names no supported camera."""


@dataclass(frozen=True, slots=True)
class CaptureRequest:
    """Request for one image.

    Attributes:
        width: Width in pixels, in the camera's own aspect ratio. The camera may return another size.
        height: Height in pixels, as `width`.
        native: Native width and height of the camera, in pixels.
        sensor: Spectral band.
        situation: Current position and attitude of the camera.
        label: Text that the test pattern shows.
    """

    width: int
    height: int
    native: tuple[int, int]
    sensor: Literal["RGB", "IR"]
    situation: Situation
    label: str = ""


def check_native_size(picture: Pixels, request: CaptureRequest) -> Pixels:
    """Check that an image has the native size of the camera, and return it.

    An image of another size may show another part of the sensor, to which the described field of view does not apply.

    Raises:
        CameraFailed: The image has another size, and policies depend on the described field of view.
    """
    rows, columns = picture.shape[:2]
    if request.situation.lens is not None and (columns, rows) != request.native:
        width, height = request.native
        raise CameraFailed(
            f"the camera returned {columns}x{rows} pixels although it was set to {width}x{height}, so its field of view is"
            " unknown; set services.camera.resolution of the node to a supported size, and horizontalFieldOfView to the"
            " field of view at that size"
        )
    return picture


class CameraDriver(Protocol):
    """A camera. Its methods block. They are called from one thread, one call at a time."""

    @property
    def latency_s(self) -> float:
        """Maximum time between exposure and the call of `capture` that returns the image, in seconds."""

    def capture(self, request: CaptureRequest) -> Pixels:
        """Return an image that was exposed at most `latency_s` before the call.

        Raises:
            CameraFailed: The camera returned no image.
        """

    def close(self) -> None:
        """Close the camera."""
