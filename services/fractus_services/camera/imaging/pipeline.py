"""From what the camera gave to what may be kept: cropped, filtered, encoded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import assert_never

from fractus_core.policy.privacy import compose
from fractus_core.policy.values import Filter

from fractus_services.camera.album.shots import Pose, directions
from fractus_services.camera.imaging import filters as do
from fractus_services.camera.imaging.faces import Detector
from fractus_services.camera.imaging.pixels import Pixels

_UPRIGHT_PITCH_DEG = -45.0
_UPRIGHT_ROLL_DEG = 15.0


class NotHidden(Exception):
    """A policy wants no picture where faces cannot be found reliably."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """What is to be done to a picture.

    Attributes:
        filters: in this order; none of them needs a detector that is not trusted.
        note: why a fallback is among them; empty when none is.
    """

    filters: tuple[Filter, ...]
    note: str = ""


def recipe(asked: tuple[Filter, ...], face_px: float, detector: Detector) -> Recipe:
    """The filters that can be trusted to do what is asked.

    Args:
        asked: what policies ask for.
        face_px: the smallest face that the picture may show is so wide; 0 when nobody knows.
        detector: finds faces.

    Raises:
        NotHidden: faces cannot be found reliably, and a policy wants no picture then.
    """
    faces = next((one for one in asked if one.action == "blurFaces"), None)
    if faces is None or face_px >= detector.least_px:
        return Recipe(asked)
    width = f"faces may be as small as {face_px:.0f} pixels" if face_px else "nobody knows how small faces may be"
    note = f"{width}, and they are found reliably from {detector.least_px:.0f} pixels on"
    if faces.fallback == "refuse":
        raise NotHidden(f"{note}; go closer, or ask for more pixels")
    rest = [one for one in asked if one is not faces]
    return Recipe(compose([*rest, Filter(faces.fallback)]), f"{note}, so {faces.fallback} instead")


def is_upright(poses: Sequence[Pose]) -> bool:
    """Whether people stand upright in pictures taken from these, as those see them who look ahead."""
    for pose in poses:
        roll_deg, pitch_deg, _ = directions(pose)
        if roll_deg is None or pitch_deg is None:
            return False
        if pitch_deg < _UPRIGHT_PITCH_DEG or abs(roll_deg) > _UPRIGHT_ROLL_DEG:
            return False
    return True


def developed(
    pictures: Sequence[Pixels],
    chosen: Recipe,
    detector: Detector,
    face_px: float,
    *,
    upright: bool,
    fixed: bool = False,
) -> Pixels:
    """A picture with its filters applied.

    Args:
        pictures: one; or three of the same view, when there are more to tell what moves by. The middle one counts.
        chosen: what to do.
        detector: finds faces.
        face_px: width of the smallest face.
        upright: people stand upright in it.
        fixed: the camera does not move.
    """
    middle = pictures[len(pictures) // 2]
    picture = middle
    for one in chosen.filters:
        match one.action:
            case "black":
                picture = do.black(picture)
            case "blurAverage":
                picture = do.blur_average(picture)
            case "blurMedian":
                picture = do.blur_median(picture)
            case "blurFaces":
                picture = do.hide_faces(picture, detector.find(picture, face_px, upright=upright), one.faces)
            case "removeBackground":
                still = len(pictures) < 3
                mask = None if still else do.moving(pictures[0], middle, pictures[2], fixed=fixed)
                picture = do.remove_background(picture, mask)
            case _:
                assert_never(one.action)
    return picture
