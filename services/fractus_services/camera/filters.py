"""Filters that take people and places out of pictures for good: nothing brings back what they remove."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from fractus_core.api.policies import FaceMethod

from fractus_services.camera.face_detection import Box
from fractus_services.camera.pixels import Pixels, opencv, reduced, resized

Mask = npt.NDArray[np.bool_]

CELLS = 16
"""Averages left along the longer side of a blurred picture: a face that fills its height keeps nine across, fewer than
people or programs need to recognise anyone."""
FACE_CELLS = 4
"""Colours left across a hidden face."""
MARGIN = 0.35
"""Share of a face's width that is hidden around it."""
_SAMPLES = 33
"""Side of the square of pixels whose median becomes one cell; the picture is reduced to this many per cell first."""

MOTION_PX = 1280
"""Motion is looked for in pictures of this width at most."""
MOTION_LEVELS = 25
MAX_MOTION = 0.5
"""Share of a picture that may move; if it is more, the camera's own motion was not estimated."""
_MIN_LIGHT = 16
_MAX_LIGHT = 250
"""Darker pixels tell nothing of how light changed, and brighter ones may be saturated."""
_MAX_LIGHT_CHANGE = 2.0
"""Beyond this, a camera's curve leaves too much of a change of light to tell it from motion."""
_FEATURES = 1500
_MIN_MATCHES = 25


def black(picture: Pixels) -> Pixels:
    """Nothing."""
    return np.zeros_like(picture)


def blur_average(picture: Pixels) -> Pixels:
    """Averages over squares, 16 along the longer side, with soft transitions."""
    return _grown(resized(picture, *_cells(picture)), picture)


def blur_median(picture: Pixels) -> Pixels:
    """Medians over squares, 16 along the longer side, with soft transitions."""
    cv2 = opencv()
    columns, rows = _cells(picture)
    samples = (columns * _SAMPLES, rows * _SAMPLES)
    smooth = cv2.medianBlur(cv2.resize(picture, samples, interpolation=cv2.INTER_NEAREST), _SAMPLES)
    middle = _SAMPLES // 2
    return _grown(np.ascontiguousarray(smooth[middle::_SAMPLES, middle::_SAMPLES]), picture)


def _cells(picture: Pixels) -> tuple[int, int]:
    rows, columns = picture.shape[:2]
    cell = max(rows, columns) / CELLS
    return max(round(columns / cell), 1), max(round(rows / cell), 1)


def _grown(cells: Pixels, picture: Pixels) -> Pixels:
    rows, columns = picture.shape[:2]
    return resized(cells, columns, rows)


def hide_faces(picture: Pixels, boxes: Sequence[Box], method: FaceMethod) -> Pixels:
    """Each face and a margin around it, reduced to four colours across: as pixels, or as a soft blur."""
    cv2 = opencv()
    hidden = picture.copy()
    rows, columns = picture.shape[:2]
    for left, top, width, height in boxes:
        x0, y0 = max(int(left - MARGIN * width), 0), max(int(top - MARGIN * height), 0)
        x1, y1 = min(int(left + (1 + MARGIN) * width) + 1, columns), min(int(top + (1 + MARGIN) * height) + 1, rows)
        if x1 <= x0 or y1 <= y0:
            continue
        # Of what is hidden by now: detectors also find small faces within large ones, whose finer cells must bring back
        # nothing of the picture.
        region = hidden[y0:y1, x0:x1]
        # The region has both margins or ends with the picture, so it gets cells in proportion.
        columns_left = min(max(round(FACE_CELLS * (x1 - x0) / max(width, 1)), 1), x1 - x0)
        rows_left = min(max(round(FACE_CELLS * (y1 - y0) / max(height, 1)), 1), y1 - y0)
        few = cv2.resize(region, (columns_left, rows_left), interpolation=cv2.INTER_AREA)
        if method == "gaussian":
            soft = cv2.resize(few, (x1 - x0, y1 - y0), interpolation=cv2.INTER_CUBIC)
            hidden[y0:y1, x0:x1] = cv2.GaussianBlur(soft, (0, 0), max((x1 - x0) / columns_left, 0.8))
        else:
            hidden[y0:y1, x0:x1] = cv2.resize(few, (x1 - x0, y1 - y0), interpolation=cv2.INTER_NEAREST)
    return hidden


def remove_background(picture: Pixels, mask: Mask | None) -> Pixels:
    """What moves, on black; all black where it is unknown what moves."""
    if mask is None:
        return black(picture)
    kept = picture.copy()
    kept[~mask] = 0
    return kept


def moving(before: Pixels, picture: Pixels, after: Pixels, *, fixed: bool) -> Mask | None:
    """What moves over the ground in a picture, with a margin; the camera's own motion does not count.

    Pictures from before and after are laid over the one between by the features that most of them share (ORB, RANSAC
    over a homography). What differs from both of them moves.

    Args:
        before: taken a moment before, of the same view.
        picture: the one that is asked about.
        after: taken a moment after, of the same view.
        fixed: the camera does not move, but for what the wind does to its mast.

    Returns:
        True where something moves; None when the pictures could not be laid over each other.
    """
    cv2 = opencv()
    still = reduced(picture, MOTION_PX)
    small = [
        one if one.shape == still.shape else cv2.resize(one, still.shape[1::-1], interpolation=cv2.INTER_AREA)
        for one in (before, still, after)
    ]
    differs = [_difference(other, small[1], fixed) for other in (small[0], small[2])]
    if differs[0] is None or differs[1] is None:
        return None
    mask = (differs[0] & differs[1]).astype(np.uint8)
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    if mask.mean() > MAX_MOTION:
        return None
    mask = cv2.dilate(mask, np.ones((max(mask.shape[1] // 50, 3),) * 2, np.uint8))
    size = (picture.shape[1], picture.shape[0])
    return np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) > 0)


def _difference(other: Pixels, picture: Pixels, fixed: bool) -> Mask | None:
    """Where a picture differs from another that is laid over it; what only one of them shows does not."""
    cv2 = opencv()
    everything = np.full(picture.shape[:2], 255, np.uint8)
    matrix = _overlay(cv2.cvtColor(other, cv2.COLOR_BGR2GRAY), cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
    laid = None
    if matrix is not None:
        size = (picture.shape[1], picture.shape[0])
        shown = cv2.warpPerspective(everything, matrix, size)
        laid = _differing(cv2.warpPerspective(other, matrix, size), shown, picture)
    if not fixed:
        return laid
    # A mast sways in the wind, so that edges of what stands move by some pixels: what the overlay explains stands, too.
    as_it_is = _differing(other, everything, picture)
    return as_it_is if laid is None or as_it_is is None else as_it_is & laid


def _differing(other: Pixels, shown: npt.NDArray[np.uint8], picture: Pixels) -> Mask | None:
    """Where two pictures differ that lie over each other, as far as the other one shows anything there."""
    cv2 = opencv()
    even = _in_one_light(other, picture, shown == 255)
    if even is None:
        return None
    other, picture = even
    difference = cv2.absdiff(cv2.GaussianBlur(other, (5, 5), 0), cv2.GaussianBlur(picture, (5, 5), 0)).max(axis=2)
    return np.asarray((difference > MOTION_LEVELS) & (cv2.erode(shown, np.ones((7, 7), np.uint8)) == 255))


def _in_one_light(one: Pixels, other: Pixels, shown: Mask) -> tuple[Pixels, Pixels] | None:
    """Two pictures that lie over each other, both as bright as the darker one, for each colour.

    A camera that adapts its exposure or its white balance between them changes all that stands still, too. Where the
    brighter picture is saturated, the darker one is cut off at the same level.

    Returns:
        None when light changed too much to tell.
    """
    ones, others = np.empty_like(one), np.empty_like(other)
    for colour in range(one.shape[2]):
        here, there = one[..., colour], other[..., colour]
        high = np.maximum(here, there)
        telling = shown & (high >= _MIN_LIGHT) & (high <= _MAX_LIGHT)
        change = float(np.median((here[telling] + 1.0) / (there[telling] + 1.0))) if telling.any() else 1.0
        if not 1 / _MAX_LIGHT_CHANGE <= change <= _MAX_LIGHT_CHANGE:
            return None
        ones[..., colour] = np.minimum(here / max(change, 1.0), 255 / max(change, 1 / change))
        others[..., colour] = np.minimum(there * min(change, 1.0), 255 / max(change, 1 / change))
    return ones, others


def _overlay(other: npt.NDArray[np.uint8], gray: npt.NDArray[np.uint8]) -> npt.NDArray[np.float64] | None:
    cv2 = opencv()
    detector = cv2.ORB_create(nfeatures=_FEATURES)
    (points, features), (there, wanted) = (detector.detectAndCompute(one, None) for one in (other, gray))
    if features is None or wanted is None:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(features, wanted)
    if len(pairs) < _MIN_MATCHES:
        return None
    source = np.array([points[p.queryIdx].pt for p in pairs], np.float32)
    target = np.array([there[p.trainIdx].pt for p in pairs], np.float32)
    matrix, inliers = cv2.findHomography(source, target, cv2.RANSAC, 2.0)
    if matrix is None or inliers is None or int(inliers.sum()) < max(_MIN_MATCHES, len(pairs) // 3):
        return None
    return np.asarray(matrix, np.float64)
