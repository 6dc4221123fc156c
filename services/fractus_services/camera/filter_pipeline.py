"""The filter pipeline: which filters can be trusted with a picture, and their application in order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import assert_never

from fractus_core.policy.decision_types import Filter
from fractus_core.policy.picture_rules import combine_filters

from fractus_services.camera import filters
from fractus_services.camera.face_detection import Detector
from fractus_services.camera.pixels import Pixels


class FacesNotReliable(Exception):
    """Faces cannot be found reliably, and a policy allows no picture then."""


@dataclass(frozen=True, slots=True)
class FilterPlan:
    """The filters that a picture gets.

    Attributes:
        filters: in this order; none of them needs a detector that cannot be trusted here.
        note: why a fallback is among them; empty when none is.
    """

    filters: tuple[Filter, ...]
    note: str = ""


def plan_filters(required: tuple[Filter, ...], face_px: float, detector: Detector) -> FilterPlan:
    """The filters that can be trusted to do what policies require.

    A detector misses faces that are too small for it, and one missed face is a failure of privacy. So where faces may be
    smaller than it finds reliably, it does not run at all, and the policy's fallback hides everything instead.

    Args:
        required: what policies require.
        face_px: width of the smallest face that the picture may show; 0 when it is unknown.
        detector: finds faces.

    Raises:
        FacesNotReliable: faces cannot be found reliably, and the fallback of a policy is to refuse.
    """
    faces = next((one for one in required if one.action == "blurFaces"), None)
    if faces is None or face_px >= detector.min_px:
        return FilterPlan(required)
    width = f"faces may be as small as {face_px:.0f} pixels" if face_px else "it is unknown how small faces may be"
    note = f"{width}, and they are found reliably from {detector.min_px:.0f} pixels on"
    if faces.fallback == "refuse":
        raise FacesNotReliable(f"{note}; go closer, or ask for more pixels")
    rest = [one for one in required if one is not faces]
    return FilterPlan(combine_filters([*rest, Filter(faces.fallback)]), f"{note}, so {faces.fallback} instead")


def apply_filters(
    frames: Sequence[Pixels],
    plan: FilterPlan,
    detector: Detector,
    face_px: float,
    *,
    upright: bool,
    fixed: bool = False,
) -> Pixels:
    """A picture with its filters applied.

    Args:
        frames: one; or three of the same view, when motion is to be detected. The middle one is the picture.
        plan: what to do.
        detector: finds faces.
        face_px: width of the smallest face.
        upright: people stand upright in it.
        fixed: the camera does not move.
    """
    middle = frames[len(frames) // 2]
    picture = middle
    for one in plan.filters:
        match one.action:
            case "black":
                picture = filters.black(picture)
            case "blurAverage":
                picture = filters.blur_average(picture)
            case "blurMedian":
                picture = filters.blur_median(picture)
            case "blurFaces":
                picture = filters.hide_faces(picture, detector.find(picture, face_px, upright=upright), one.faces)
            case "removeBackground":
                # Motion is detected in the frames as the camera gave them: a filter applied before would hide it.
                mask = filters.moving(frames[0], middle, frames[2], fixed=fixed) if len(frames) == 3 else None
                picture = filters.remove_background(picture, mask)
            case _:
                assert_never(one.action)
    return picture
