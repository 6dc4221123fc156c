"""A camera's own properties, and which sizes of pictures it allows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fractus_core.api.nodes import Drone, EdgeNode

from fractus_services.camera.pixels import source_size
from fractus_services.errors import InvalidRequest

MIN_PX, MAX_PX = 16, 8192
MIN_ALLOWED_PIXELS = 8_300_000
"""Pixels that may be asked for of any camera, also of one that has fewer."""


@dataclass(frozen=True, slots=True)
class CameraProperties:
    """A camera as its node describes it.

    Attributes:
        resolution: its width and height.
        model: make and model; may be empty.
        sensor: what it sees.
        fixed: it does not move.
        pinhole: its lens is described as one, so that the field of view tells its focal length.
    """

    resolution: tuple[int, int] = (1280, 720)
    model: str = ""
    sensor: Literal["RGB", "IR"] = "RGB"
    fixed: bool = False
    pinhole: bool = False

    @classmethod
    def of(cls, description: Drone | EdgeNode | None) -> CameraProperties:
        """The properties of a node's camera; defaults where the node describes none."""
        camera = description.spec.services.camera if description is not None else None
        fixed = isinstance(description, EdgeNode)
        if camera is None:
            return cls(fixed=fixed)
        pinhole = camera.lens is not None and camera.lens.model == "pinhole"
        return cls(camera.pixels, camera.model, camera.sensor_type, fixed, pinhole)

    def source_size(self, width: int, height: int) -> tuple[int, int]:
        """Pixels to ask the camera for, in its own proportions, so that they can be cropped to a width and height."""
        return source_size(width, height, self.resolution)

    def check_size(self, width: int, height: int) -> None:
        """Refuse sizes for which the camera's picture, before it is cropped, would take too much memory.

        Raises:
            InvalidRequest: too small, too large, or cut from too large a picture.
        """
        if not (MIN_PX <= width <= MAX_PX and MIN_PX <= height <= MAX_PX):
            raise InvalidRequest(
                "InvalidArgument",
                f"{width}x{height} pixels is not between {MIN_PX}x{MIN_PX} and {MAX_PX}x{MAX_PX}; ask for another size",
            )
        native, source = self.resolution, self.source_size(width, height)
        limit = max(native[0] * native[1], MIN_ALLOWED_PIXELS)
        # One per cent for sizes that were rounded up to whole pixels.
        if source[0] * source[1] > limit * 1.01:
            raise InvalidRequest(
                "InvalidArgument",
                f"{width}x{height} pixels would be cut from {source[0]}x{source[1]}, more than {limit / 1e6:.1f}"
                f" megapixels; ask for less, or for the proportions of {native[0]}x{native[1]}",
            )
