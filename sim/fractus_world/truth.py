"""Ground truth of a picture: visible objects and faces, with their positions and visible shares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fractus_world.optics import Pose

Box = tuple[float, float, float, float]
"""Left, top, right, bottom in pixels; (0, 0) is the upper left corner of the picture."""


@dataclass(frozen=True, slots=True)
class Seen:
    """An object in a picture.

    Attributes:
        id: Identical in every picture.
        kind: Object class.
        lat: Latitude, degrees.
        lon: Longitude, degrees.
        heading_deg: Clockwise from north.
        speed_mps: Ground speed.
        box: Bounding box of the part inside the picture.
        in_frame: Share inside the picture, from 0 to 1.
        visible: Share inside the picture that is not occluded, from 0 to 1.
    """

    id: str
    kind: str
    lat: float
    lon: float
    heading_deg: float
    speed_mps: float
    box: Box
    in_frame: float
    visible: float

    def as_json(self) -> dict[str, Any]:
        """Return the JSON representation."""
        return {
            "id": self.id,
            "class": self.kind,
            "lat": round(self.lat, 8),
            "lon": round(self.lon, 8),
            "headingDeg": round(self.heading_deg % 360.0, 2),
            "speedMps": round(self.speed_mps, 3),
            "box": [round(edge, 2) for edge in self.box],
            "inFrame": round(self.in_frame, 4),
            "visible": round(self.visible, 4),
        }


@dataclass(frozen=True, slots=True)
class SeenFace:
    """A face on a billboard of the world, as it appears in one picture.

    Attributes:
        id: Identical in every picture.
        lat: Latitude, degrees.
        lon: Longitude, degrees.
        standing: True if the billboard is upright, False if it lies on the ground.
        box: Bounding box of the part of the face inside the picture.
        height_px: Height of the whole face in the picture.
        in_frame: Share inside the picture.
        visible: Share inside the picture that is not occluded. 0 if the camera is behind the billboard.
    """

    id: str
    lat: float
    lon: float
    standing: bool
    box: Box
    height_px: float
    in_frame: float
    visible: float

    def as_json(self) -> dict[str, Any]:
        """Return the JSON representation."""
        return {
            "id": self.id,
            "lat": round(self.lat, 8),
            "lon": round(self.lon, 8),
            "standing": self.standing,
            "box": [round(edge, 2) for edge in self.box],
            "heightPx": round(self.height_px, 2),
            "inFrame": round(self.in_frame, 4),
            "visible": round(self.visible, 4),
        }


@dataclass(frozen=True, slots=True)
class Truth:
    """Visible content of a picture."""

    pose: Pose
    objects: tuple[Seen, ...]
    faces: tuple[SeenFace, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the JSON representation."""
        pose = self.pose
        return {
            "pose": {
                "lat": round(pose.lat, 8),
                "lon": round(pose.lon, 8),
                "heightM": round(pose.height_m, 3),
                "rollDeg": round(pose.roll_deg, 3),
                "pitchDeg": round(pose.pitch_deg, 3),
                "yawDeg": round(pose.yaw_deg, 3),
            },
            "objects": [seen.as_json() for seen in self.objects],
            "faces": [face.as_json() for face in self.faces],
        }
