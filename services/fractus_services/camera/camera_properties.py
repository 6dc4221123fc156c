"""Properties of the node's camera, and the image sizes that it supports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fractus_core.api.nodes import Drone, EdgeNode

from fractus_services.camera.pixels import source_size
from fractus_services.errors import InvalidRequest

MIN_PX = 16
MAX_PX = 8192
MIN_ALLOWED_PIXELS = 8_300_000
"""Number of pixels before cropping that every request may have, even if the resolution of the camera is lower."""


@dataclass(frozen=True, slots=True)
class CameraProperties:
    """Properties of a camera, taken from the node description.

    Attributes:
        resolution: Width and height in pixels.
        model: Make and model, or an empty string.
        sensor: Spectral band.
        fixed: True if the camera does not move.
        pinhole: True if the description has a pinhole lens. The focal length then follows from the field of view.
    """

    resolution: tuple[int, int] = (1280, 720)
    model: str = ""
    sensor: Literal["RGB", "IR"] = "RGB"
    fixed: bool = False
    pinhole: bool = False

    @classmethod
    def from_description(cls, description: Drone | EdgeNode | None) -> CameraProperties:
        """Return the properties of a node's camera, or the defaults if the node describes no camera."""
        camera = description.spec.services.camera if description is not None else None
        fixed = isinstance(description, EdgeNode)
        if camera is None:
            return cls(fixed=fixed)
        pinhole = camera.lens is not None and camera.lens.model == "pinhole"
        return cls(camera.pixels, camera.model, camera.sensor_type, fixed, pinhole)

    def source_size(self, width: int, height: int) -> tuple[int, int]:
        """Return the size to request from the camera, in its own aspect ratio, for an image of `width` and `height`."""
        return source_size(width, height, self.resolution)

    def check_size(self, width: int, height: int) -> None:
        """Check the size of a requested image.

        Raises:
            InvalidRequest: The size is out of range, or the image before cropping would take too much memory.
        """
        if not (MIN_PX <= width <= MAX_PX and MIN_PX <= height <= MAX_PX):
            raise InvalidRequest(
                "InvalidArgument",
                f"{width}x{height} pixels is not between {MIN_PX}x{MIN_PX} and {MAX_PX}x{MAX_PX}; request another size",
            )
        native = self.resolution
        source = self.source_size(width, height)
        limit = max(native[0] * native[1], MIN_ALLOWED_PIXELS)
        # Allow 1 % more, because sizes are rounded to whole pixels.
        if source[0] * source[1] > limit * 1.01:
            raise InvalidRequest(
                "InvalidArgument",
                f"{width}x{height} pixels would be cropped from {source[0]}x{source[1]}, more than {limit / 1e6:.1f}"
                f" megapixels; request fewer pixels, or the aspect ratio of {native[0]}x{native[1]}",
            )
