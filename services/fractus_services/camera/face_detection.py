"""Face detectors, and the minimum face size for which each detector is reliable."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import numpy.typing as npt
from fractus_core.policy.decision_types import Lens

from fractus_services.camera.pixels import Pixels
from fractus_services.errors import PreconditionFailed

# Filters run on worker threads while the drone may be in flight, so OpenCV must not occupy all processors.
cv2.setNumThreads(1)

Box = tuple[int, int, int, int]
"""Left, top, width and height in pixels."""

FACE_WIDTH_M = 0.13
"""Width of a child's face, the narrowest face that must be detected."""
DEFAULT_MIN_PX = 48
"""Minimum face width for which the cascades are reliable, in pixels. `bench/faces.py` measures it."""
_REDUCED_FACE_PX = 28
"""Images are reduced until the smallest face that they may show has this width. The cascades were trained with faces of 20 pixels,
so larger images only take more time."""
_MIN_WINDOW_PX = 20
_SCALE_STEP = 1.1
_PROFILE_SCALE_STEP = 1.2
"""Ratio between consecutive face sizes of the search. It is larger for the profile cascade, which is slow."""
_ANGLES_DEG = tuple(range(0, 360, 30))
_EQUALISED_ANGLES_DEG = tuple(range(15, 360, 30))
"""Rotations at which faces are searched, in the original image and in an image with equalised contrast. The angles alternate, so
that each face is searched in both images."""
_UPRIGHT_ANGLES_DEG = (0, -30, 30)
_EQUALISED_UPRIGHT_ANGLES_DEG = (0, -15, 15)


class InvalidFaceModel(PreconditionFailed):
    """The face detection model is unusable."""

    def __init__(self, reason: str) -> None:
        super().__init__("FilterUnavailable", reason)


class FaceDetector(Protocol):
    """Detects faces.

    Attributes:
        name: Name for log messages and benchmarks.
        min_px: Minimum face width for reliable detection, in pixels.
    """

    name: str
    min_px: float

    def detect(self, picture: Pixels, smallest_px: float, *, upright: bool) -> list[Box]:
        """Return boxes around the faces in an image.

        Args:
            picture: Image to search.
            smallest_px: Width of the smallest face that the image may show, in pixels.
            upright: True if people stand upright in the image. False searches faces at all rotations, as in a view from above.
        """


def smallest_face_px(lens: Lens | None, farthest_m: float, width: int) -> float:
    """Return the width of the smallest face that an image may show, in pixels, or 0 if it is unknown.

    Args:
        lens: Lens of the camera.
        farthest_m: Distance between the camera and the farthest visible ground, in metres.
        width: Width of the full view, in pixels.
    """
    if lens is None or not 0 < farthest_m < math.inf:
        return 0.0
    focal_px = width / 2 / math.tan(math.radians(lens.horizontal_deg) / 2)
    return FACE_WIDTH_M * focal_px / farthest_m


class CascadeDetector:
    """Viola-Jones cascades that OpenCV 4 ships: frontal and profile faces, also rotated and mirrored.

    Args:
        min_px: Minimum face width for which detection counts as reliable, in pixels.
    """

    name = "cascades"

    def __init__(self, min_px: float = DEFAULT_MIN_PX) -> None:
        self.min_px = min_px
        self._frontal: list[Any] = []
        self._profile: Any = None

    def detect(self, picture: Pixels, smallest_px: float, *, upright: bool) -> list[Box]:
        """See `FaceDetector`."""
        self._load()
        gray, scale = _reduce(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), smallest_px)
        boxes: list[Box] = []
        for degrees in _UPRIGHT_ANGLES_DEG if upright else _ANGLES_DEG:
            rotated, inverse = _rotate(gray, degrees)
            for cascade in self._frontal if degrees % 90 == 0 else self._frontal[:1]:
                boxes += [_map_back(box, inverse, scale) for box in _run_cascade(cascade, rotated, _SCALE_STEP)]
            if degrees % 90 == 0:
                boxes += [_map_back(box, inverse, scale) for box in self._detect_profiles(rotated)]
        equalised = cv2.createCLAHE(3.0, (8, 8)).apply(gray)
        for degrees in _EQUALISED_UPRIGHT_ANGLES_DEG if upright else _EQUALISED_ANGLES_DEG:
            rotated, inverse = _rotate(equalised, degrees)
            boxes += [_map_back(box, inverse, scale) for box in _run_cascade(self._frontal[0], rotated, _SCALE_STEP)]
        return boxes

    def _load(self) -> None:
        if self._profile is not None:
            return
        directory = Path(cv2.data.haarcascades)
        cascades = []
        for name in ("frontalface_alt2", "frontalface_default", "profileface"):
            cascade = cv2.CascadeClassifier(str(directory / f"haarcascade_{name}.xml"))
            if cascade.empty():
                raise InvalidFaceModel(
                    f"OpenCV's cascade {name} is missing from {directory}; reinstall opencv-python-headless"
                )
            cascades.append(cascade)
        *self._frontal, self._profile = cascades

    def _detect_profiles(self, gray: npt.NDArray[np.uint8]) -> list[Box]:
        """Detect faces that look to the left, and, in the mirrored image, faces that look to the right."""
        mirrored = _run_cascade(self._profile, cv2.flip(gray, 1), _PROFILE_SCALE_STEP)
        right = [(gray.shape[1] - x - w, y, w, h) for x, y, w, h in mirrored]
        return [*_run_cascade(self._profile, gray, _PROFILE_SCALE_STEP), *right]


def _run_cascade(cascade: Any, gray: npt.NDArray[np.uint8], scale_step: float) -> list[Box]:
    boxes = cascade.detectMultiScale(gray, scale_step, 1, minSize=(_MIN_WINDOW_PX,) * 2)
    return [(int(x), int(y), int(w), int(h)) for x, y, w, h in boxes]


class ModelDetector:
    """A YuNet neural network (ONNX) that the user provides.

    Args:
        path: File of the model.
        min_px: Minimum face width for which detection counts as reliable, in pixels.
        score: Minimum score of a detection.

    Raises:
        InvalidFaceModel: The file is missing, or OpenCV cannot use it as a face detector.
    """

    def __init__(self, path: Path, min_px: float = DEFAULT_MIN_PX, score: float = 0.5) -> None:
        self.name = path.name
        self.min_px = min_px
        if not path.is_file():
            raise InvalidFaceModel(
                f"--face-model {path}: file not found; specify a YuNet model (ONNX), or omit the option"
            )
        try:
            self._network = cv2.FaceDetectorYN.create(str(path), "", (320, 320), score, 0.3, 5000)
            self._run(np.zeros((320, 320, 3), np.uint8))
        except cv2.error as error:
            sentence = " ".join(str(error.err).split())
            raise InvalidFaceModel(
                f"--face-model {path}: OpenCV cannot use it as a face detector ({sentence}); specify a YuNet model (ONNX)"
            ) from None

    def detect(self, picture: Pixels, smallest_px: float, *, upright: bool) -> list[Box]:
        """See `FaceDetector`."""
        small, scale = _reduce(picture, smallest_px)
        boxes: list[Box] = []
        for degrees in _UPRIGHT_ANGLES_DEG if upright else _ANGLES_DEG:
            rotated, inverse = _rotate(small, degrees)
            boxes += [_map_back(box, inverse, scale) for box in self._run(rotated)]
        return boxes

    def _run(self, picture: Pixels) -> list[Box]:
        self._network.setInputSize((picture.shape[1], picture.shape[0]))
        _, faces = self._network.detect(picture)
        return [] if faces is None else [(int(x), int(y), int(w), int(h)) for x, y, w, h in faces[:, :4]]


def _reduce(picture: Pixels, smallest_px: float) -> tuple[Pixels, float]:
    """Reduce an image until its smallest face has a width of `_REDUCED_FACE_PX`. Return it with its scale."""
    scale = min(_REDUCED_FACE_PX / max(smallest_px, _REDUCED_FACE_PX), 1.0)
    if scale >= 1:
        return picture, scale
    return cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), scale


def _rotate(picture: npt.NDArray[np.uint8], degrees: int) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float64]]:
    """Rotate an image around its centre without cutting it. Return it with the affine map back to the original."""
    if degrees % 360 == 0:
        return picture, np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    rows, columns = picture.shape[:2]
    matrix = cv2.getRotationMatrix2D((columns / 2, rows / 2), degrees, 1.0)
    cosine = abs(matrix[0, 0])
    sine = abs(matrix[0, 1])
    width = round(columns * cosine + rows * sine)
    height = round(columns * sine + rows * cosine)
    matrix[:, 2] += (width / 2 - columns / 2, height / 2 - rows / 2)
    rotated = cv2.warpAffine(picture, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)
    return rotated, cv2.invertAffineTransform(matrix)


def _map_back(box: Sequence[int], inverse: npt.NDArray[np.float64], scale: float) -> Box:
    """Convert a box in a reduced and rotated image to a box in the original image.

    The returned box is not rotated. It is the smallest box that contains the converted one.
    """
    left, top, width, height = box
    corners = np.array([(x, y, 1.0) for x in (left, left + width) for y in (top, top + height)]) @ inverse.T
    low = corners.min(axis=0)
    high = corners.max(axis=0)
    bounds = (int(low[0]), int(low[1]), math.ceil(high[0] - low[0]), math.ceil(high[1] - low[1]))
    x, y, w, h = (round(value / scale) for value in bounds)
    return x, y, w, h
