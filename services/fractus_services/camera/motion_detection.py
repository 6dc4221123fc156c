"""Detection of moving objects in three consecutive frames."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from fractus_services.camera.pixels import Pixels, limit_width

Mask = npt.NDArray[np.bool_]
"""Array of shape (height, width)."""

MAX_MOTION_WIDTH_PX = 1280
"""Images are reduced to this width before motion is detected."""
MOTION_THRESHOLD = 25
"""Difference between two frames that counts as motion. Pixel values are 0 to 255."""
MAX_MOTION_SHARE = 0.5
"""Maximum share of the image that may move. A larger share means that the estimate of the camera's own motion is wrong."""
_MIN_LEVEL = 16
_MAX_LEVEL = 250
"""Range of pixel values from which the exposure ratio is estimated. Darker pixels are noisy, and brighter pixels may be saturated."""
_MAX_EXPOSURE_RATIO = 2.0
"""Maximum ratio of exposure between frames. With a larger ratio, the nonlinear response of the camera would appear as motion."""
_FEATURES = 1500
_MIN_MATCHES = 25


def detect_motion(before: Pixels, picture: Pixels, after: Pixels, *, fixed: bool) -> Mask | None:
    """Detect objects that move over the ground, with a margin. The camera's own motion is compensated.

    The frames before and after are aligned with the frame between them by matching ORB features and estimating a
    homography with RANSAC. Pixels that differ from both aligned frames belong to a moving object.

    Args:
        before: Frame taken before `picture`, of the same view.
        picture: Frame in which objects are detected.
        after: Frame taken after `picture`, of the same view.
        fixed: True if the camera stands still, except for the sway of its mast.

    Returns:
        A mask of the size of `picture` that is True for moving objects, or None if the frames could not be aligned.
    """
    still = limit_width(picture, MAX_MOTION_WIDTH_PX)
    before_small, after_small = (
        frame if frame.shape == still.shape else cv2.resize(frame, still.shape[1::-1], interpolation=cv2.INTER_AREA)
        for frame in (before, after)
    )
    difference_before = _align_and_compare(before_small, still, fixed)
    difference_after = _align_and_compare(after_small, still, fixed)
    if difference_before is None or difference_after is None:
        return None
    mask = (difference_before & difference_after).astype(np.uint8)
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    if mask.mean() > MAX_MOTION_SHARE:
        return None
    mask = cv2.dilate(mask, np.ones((max(mask.shape[1] // 50, 3),) * 2, np.uint8))
    size = (picture.shape[1], picture.shape[0])
    return np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) > 0)


def _align_and_compare(other: Pixels, picture: Pixels, fixed: bool) -> Mask | None:
    """Return the pixels in which `picture` differs from another frame that is aligned with it.

    Pixels that only one of the frames shows do not count as different.
    """
    everywhere = np.full(picture.shape[:2], 255, np.uint8)
    matrix = _estimate_homography(cv2.cvtColor(other, cv2.COLOR_BGR2GRAY), cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
    aligned = None
    if matrix is not None:
        size = (picture.shape[1], picture.shape[0])
        visible = cv2.warpPerspective(everywhere, matrix, size)
        aligned = _compare(cv2.warpPerspective(other, matrix, size), visible, picture)
    if not fixed:
        return aligned
    # A mast that sways in the wind moves the edges of still objects by some pixels. An object counts as moving only if
    # the frames differ both with and without alignment.
    unaligned = _compare(other, everywhere, picture)
    if aligned is None or unaligned is None:
        return unaligned
    return unaligned & aligned


def _compare(other: Pixels, visible: npt.NDArray[np.uint8], picture: Pixels) -> Mask | None:
    """Return a mask of the pixels in which two aligned frames differ, or None if their exposures differ too much.

    `visible` is 255 at the pixels that `other` shows. All other pixels count as equal.
    """
    matched = _match_exposure(other, picture, visible == 255)
    if matched is None:
        return None
    other, picture = matched
    difference = cv2.absdiff(cv2.GaussianBlur(other, (5, 5), 0), cv2.GaussianBlur(picture, (5, 5), 0)).max(axis=2)
    inside = cv2.erode(visible, np.ones((7, 7), np.uint8)) == 255
    return np.asarray((difference > MOTION_THRESHOLD) & inside)


def _match_exposure(first: Pixels, second: Pixels, visible: Mask) -> tuple[Pixels, Pixels] | None:
    """Adjust two aligned frames to the same exposure.

    In each colour channel, the brighter frame is scaled down to the level of the darker one. Otherwise, a change of
    exposure or white balance between the frames would count as motion. Saturated pixels of the brighter frame do not
    contain the true brightness, so both frames are clipped at the scaled saturation level.

    Returns:
        The two frames, or None if the exposure changed too much.
    """
    first_matched = np.empty_like(first)
    second_matched = np.empty_like(second)
    for channel in range(first.shape[2]):
        first_level = first[..., channel]
        second_level = second[..., channel]
        level = np.maximum(first_level, second_level)
        usable = visible & (level >= _MIN_LEVEL) & (level <= _MAX_LEVEL)
        ratio = 1.0
        if usable.any():
            ratio = float(np.median((first_level[usable] + 1.0) / (second_level[usable] + 1.0)))
        if not 1 / _MAX_EXPOSURE_RATIO <= ratio <= _MAX_EXPOSURE_RATIO:
            return None
        saturation = 255 / max(ratio, 1 / ratio)
        first_matched[..., channel] = np.minimum(first_level / max(ratio, 1.0), saturation)
        second_matched[..., channel] = np.minimum(second_level * min(ratio, 1.0), saturation)
    return first_matched, second_matched


def _estimate_homography(other: npt.NDArray[np.uint8], gray: npt.NDArray[np.uint8]) -> npt.NDArray[np.float64] | None:
    """Estimate the homography from another frame to `gray`, or return None if too few features match."""
    orb = cv2.ORB_create(nfeatures=_FEATURES)
    other_points, other_features = orb.detectAndCompute(other, None)
    points, features = orb.detectAndCompute(gray, None)
    if other_features is None or features is None:
        return None
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(other_features, features)
    if len(matches) < _MIN_MATCHES:
        return None
    source = np.array([other_points[match.queryIdx].pt for match in matches], np.float32)
    target = np.array([points[match.trainIdx].pt for match in matches], np.float32)
    matrix, inliers = cv2.findHomography(source, target, cv2.RANSAC, 2.0)
    if matrix is None or inliers is None or int(inliers.sum()) < max(_MIN_MATCHES, len(matches) // 3):
        return None
    return np.asarray(matrix, np.float64)
