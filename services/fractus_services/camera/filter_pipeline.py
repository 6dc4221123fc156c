"""Filter pipeline: selects the filters that are reliable for an image, and applies them. Filtered images cannot be restored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import assert_never

import cv2
import numpy as np
from fractus_core.api.policies import FaceMethod
from fractus_core.policy.decision_types import Filter
from fractus_core.policy.picture_rules import combine_filters

from fractus_services.camera.face_detection import Box, FaceDetector
from fractus_services.camera.motion_detection import Mask, detect_motion
from fractus_services.camera.pixels import Pixels, resize

BLUR_CELLS = 16
"""Number of averages along the longer side of a blurred image. A face that fills the height of
the image is nine cells wide, which is too few to recognise a person."""
FACE_CELLS = 4
"""Number of colours across a hidden face."""
FACE_MARGIN = 0.35
"""Margin that is hidden around a face, as a share of the face's width."""
_MEDIAN_SAMPLES = 33
"""Side of the square of pixels whose median becomes one cell. The image is first reduced to this many pixels per cell."""


class FaceDetectionUnreliable(Exception):
    """Faces cannot be detected reliably, and a policy then permits no image."""


@dataclass(frozen=True, slots=True)
class FilterPlan:
    """Filters to apply to an image.

    Attributes:
        filters: Filters in order of application. No filter relies on an unreliable face detector.
        note: Reason why a fallback filter is used, or an empty string.
    """

    filters: tuple[Filter, ...]
    note: str = ""


def plan_filters(required: tuple[Filter, ...], face_px: float, detector: FaceDetector) -> FilterPlan:
    """Select filters that reliably fulfil the requirements of policies.

    A detector misses faces that are too small, and each missed face violates privacy. If the image may show faces below the
    reliable size, the fallback filter of the policy replaces face detection.

    Args:
        required: Filters that policies require.
        face_px: Width of the smallest face that the image may show, in pixels, or 0 if it is unknown.
        detector: Face detector.

    Raises:
        FaceDetectionUnreliable: Faces cannot be detected reliably, and the fallback of a policy is to refuse.
    """
    blur_faces = next((required_filter for required_filter in required if required_filter.action == "blurFaces"), None)
    if blur_faces is None or face_px >= detector.min_px:
        return FilterPlan(required)
    size = f"faces may be as small as {face_px:.0f} pixels" if face_px else "the size of faces is unknown"
    note = f"{size}, and detection is reliable from {detector.min_px:.0f} pixels"
    if blur_faces.fallback == "refuse":
        raise FaceDetectionUnreliable(f"{note}; go closer, or request more pixels")
    others = [required_filter for required_filter in required if required_filter is not blur_faces]
    return FilterPlan(
        combine_filters([*others, Filter(blur_faces.fallback)]), f"{note}, so {blur_faces.fallback} is applied"
    )


def apply_filters(
    frames: Sequence[Pixels],
    plan: FilterPlan,
    detector: FaceDetector,
    face_px: float,
    *,
    upright: bool,
    fixed: bool = False,
) -> Pixels:
    """Apply filters to an image.

    Args:
        frames: One frame, or three frames of the same view for motion detection. The middle frame is the image.
        plan: Filters to apply.
        detector: Face detector.
        face_px: Width of the smallest face that the image may show, in pixels.
        upright: True if people stand upright in the image.
        fixed: True if the camera does not move.
    """
    original = frames[len(frames) // 2]
    picture = original
    for planned in plan.filters:
        match planned.action:
            case "black":
                picture = blacken(picture)
            case "blurAverage":
                picture = blur_average(picture)
            case "blurMedian":
                picture = blur_median(picture)
            case "blurFaces":
                picture = hide_faces(picture, detector.detect(picture, face_px, upright=upright), planned.faces)
            case "removeBackground":
                # Detect motion in the original frames, because the filters applied so far hide it.
                mask = detect_motion(frames[0], original, frames[2], fixed=fixed) if len(frames) == 3 else None
                picture = remove_background(picture, mask)
            case _:
                assert_never(planned.action)
    return picture


def blacken(picture: Pixels) -> Pixels:
    """Return a black image of the same size."""
    return np.zeros_like(picture)


def blur_average(picture: Pixels) -> Pixels:
    """Replace an image by averages over squares, `BLUR_CELLS` along the longer side, with smooth transitions."""
    return _enlarge(resize(picture, *_cell_counts(picture)), picture)


def blur_median(picture: Pixels) -> Pixels:
    """Replace an image by medians over squares, `BLUR_CELLS` along the longer side, with smooth transitions."""
    columns, rows = _cell_counts(picture)
    samples = (columns * _MEDIAN_SAMPLES, rows * _MEDIAN_SAMPLES)
    smooth = cv2.medianBlur(cv2.resize(picture, samples, interpolation=cv2.INTER_NEAREST), _MEDIAN_SAMPLES)
    middle = _MEDIAN_SAMPLES // 2
    return _enlarge(np.ascontiguousarray(smooth[middle::_MEDIAN_SAMPLES, middle::_MEDIAN_SAMPLES]), picture)


def _cell_counts(picture: Pixels) -> tuple[int, int]:
    """Return the number of columns and rows of blur cells."""
    rows, columns = picture.shape[:2]
    cell_px = max(rows, columns) / BLUR_CELLS
    return max(round(columns / cell_px), 1), max(round(rows / cell_px), 1)


def _enlarge(cells: Pixels, picture: Pixels) -> Pixels:
    rows, columns = picture.shape[:2]
    return resize(cells, columns, rows)


def hide_faces(picture: Pixels, boxes: Sequence[Box], method: FaceMethod) -> Pixels:
    """Reduce each face and a margin around it to `FACE_CELLS` colours across, as pixels or as a smooth blur."""
    hidden = picture.copy()
    rows, columns = picture.shape[:2]
    for left, top, width, height in boxes:
        x0 = max(int(left - FACE_MARGIN * width), 0)
        y0 = max(int(top - FACE_MARGIN * height), 0)
        x1 = min(int(left + (1 + FACE_MARGIN) * width) + 1, columns)
        y1 = min(int(top + (1 + FACE_MARGIN) * height) + 1, rows)
        if x1 <= x0 or y1 <= y0:
            continue
        # Read from the partly hidden image. Detectors also find small faces within large ones. If a small face were
        # read from the original image, its finer cells would show parts of the large face again.
        region = hidden[y0:y1, x0:x1]
        # The region is larger than the face by the margins, unless it ends at the image border. Its number of cells is
        # in proportion.
        cell_columns = min(max(round(FACE_CELLS * (x1 - x0) / max(width, 1)), 1), x1 - x0)
        cell_rows = min(max(round(FACE_CELLS * (y1 - y0) / max(height, 1)), 1), y1 - y0)
        cells = cv2.resize(region, (cell_columns, cell_rows), interpolation=cv2.INTER_AREA)
        if method == "gaussian":
            smooth = cv2.resize(cells, (x1 - x0, y1 - y0), interpolation=cv2.INTER_CUBIC)
            hidden[y0:y1, x0:x1] = cv2.GaussianBlur(smooth, (0, 0), max((x1 - x0) / cell_columns, 0.8))
        else:
            hidden[y0:y1, x0:x1] = cv2.resize(cells, (x1 - x0, y1 - y0), interpolation=cv2.INTER_NEAREST)
    return hidden


def remove_background(picture: Pixels, moving: Mask | None) -> Pixels:
    """Blacken all pixels that do not move, or the entire image if the motion is unknown."""
    if moving is None:
        return blacken(picture)
    kept = picture.copy()
    kept[~moving] = 0
    return kept
