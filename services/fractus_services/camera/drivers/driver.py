"""What every camera driver does, and what is asked of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from fractus_core.policy.decision_types import Situation

from fractus_services.camera.pixels import Pixels
from fractus_services.errors import Unavailable
from fractus_services.options import CannotServe

TIMEOUT_S = 5.0
"""A camera that takes longer for a picture is broken."""


class CameraFailed(Unavailable):
    """The camera gives no picture; says why, and what to look at."""

    def __init__(self, reason: str) -> None:
        super().__init__("CameraFailed", reason)


class BadConnection(CannotServe):
    """A connection that names no camera."""


@dataclass(frozen=True, slots=True)
class CaptureRequest:
    """What is asked of a camera.

    Attributes:
        width: pixels, in the camera's own proportions; it may give others.
        height: as width.
        native: the camera's own width and height.
        sensor: what it sees.
        now: where the camera is.
        label: what a drawn picture says.
    """

    width: int
    height: int
    native: tuple[int, int]
    sensor: Literal["RGB", "IR"]
    now: Situation
    label: str = ""


def as_described(picture: Pixels, wanted: CaptureRequest) -> Pixels:
    """The picture of a camera that was set to its native size, unless it is not of that size.

    Another size may be another part of the sensor, so the described field of view does not hold for it.

    Raises:
        CameraFailed: it is not, and the picture would be judged by what its description says that it shows.
    """
    rows, columns = picture.shape[:2]
    if wanted.now.lens is not None and (columns, rows) != wanted.native:
        width, height = wanted.native
        raise CameraFailed(
            f"the camera gives {columns}x{rows} pixels though it was set to {width}x{height}, so it is unknown what"
            " they show; set services.camera.resolution of the node to a size that the camera has, and"
            " horizontalFieldOfView to what it shows at that size"
        )
    return picture


class Driver(Protocol):
    """A camera. Its methods block, and are called from one thread, never two at a time."""

    @property
    def latency_s(self) -> float:
        """How many seconds before it is asked for a picture may have been exposed, at most."""

    def capture(self, wanted: CaptureRequest) -> Pixels:
        """A picture of the present moment, or of one at most `latency_s` ago.

        Raises:
            CameraFailed: the camera gives none.
        """

    def close(self) -> None:
        """Close the camera."""
