"""Face detectors, and from which size on each can be trusted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from fractus_core.policy.decision_types import Lens

from fractus_services.camera.pixels import Pixels, opencv
from fractus_services.errors import PreconditionFailed

Box = tuple[int, int, int, int]
"""Left, top, width and height in pixels."""

FACE_M = 0.13
"""Width of a child's face, the narrowest that must be found."""
DEFAULT_MIN_PX = 48
"""From this width on the cascades find faces as reliably as `bench/faces.py` shows."""
_WINDOW_PX = 28
"""Pictures are reduced until the smallest face that matters has this width: the cascades were trained with 20 pixels, and
every further pixel only costs time."""
_MIN_WINDOW_PX = 20
_STEP = 1.1
_PROFILE_STEP = 1.2
"""Ratio from one size of faces to the next; wider for the profile cascade, which is slow."""
_PLAIN = tuple(range(0, 360, 30))
_EQUALISED = tuple(range(15, 360, 30))
"""Tilts at which faces are searched: the first in the picture as it is, those between them in one with equalised
contrast, so that each face gets a second chance under other conditions."""
_PLAIN_UPRIGHT = (0, -30, 30)
_EQUALISED_UPRIGHT = (0, -15, 15)


class BadModel(PreconditionFailed):
    """A face model that cannot be used."""

    def __init__(self, reason: str) -> None:
        super().__init__("FilterUnavailable", reason)


class Detector(Protocol):
    """Finds faces.

    Attributes:
        name: for people.
        min_px: width from which on faces are found reliably.
    """

    name: str
    min_px: float

    def find(self, picture: Pixels, smallest_px: float, *, upright: bool) -> list[Box]:
        """Boxes around faces.

        Args:
            picture: where to look.
            smallest_px: no face in it is narrower.
            upright: people stand upright in the picture; otherwise they may lie in every direction, as seen from above.
        """


def smallest_face_px(lens: Lens | None, farthest_m: float, width: int) -> float:
    """Width of the smallest face that a picture may show, in pixels; 0 when it is unknown.

    Args:
        lens: the camera's.
        farthest_m: how far away the ground is that is shown furthest from the camera.
        width: pixels of the whole view.
    """
    if lens is None or not 0 < farthest_m < math.inf:
        return 0.0
    focal_px = width / 2 / math.tan(math.radians(lens.horizontal_deg) / 2)
    return FACE_M * focal_px / farthest_m


class CascadeDetector:
    """The cascades of Viola and Jones that OpenCV 4 ships: frontal faces and profiles, also turned and mirrored."""

    name = "cascades"

    def __init__(self, min_px: float = DEFAULT_MIN_PX) -> None:
        self.min_px = min_px
        self._frontal: list[Any] = []
        self._profile: Any = None

    def find(self, picture: Pixels, smallest_px: float, *, upright: bool) -> list[Box]:
        """See `Detector`."""
        cv2 = opencv()
        self._load()
        gray, scale = _reduced(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), smallest_px)
        found: list[Box] = []
        for degrees in _PLAIN_UPRIGHT if upright else _PLAIN:
            turned, back = _turned(gray, degrees)
            for cascade in self._frontal if degrees % 90 == 0 else self._frontal[:1]:
                found += [_place(box, back, scale) for box in _run(cascade, turned, _STEP)]
            if degrees % 90 == 0:
                found += [_place(box, back, scale) for box in self._profiles(turned)]
        even = cv2.createCLAHE(3.0, (8, 8)).apply(gray)
        for degrees in _EQUALISED_UPRIGHT if upright else _EQUALISED:
            turned, back = _turned(even, degrees)
            found += [_place(box, back, scale) for box in _run(self._frontal[0], turned, _STEP)]
        return found

    def _load(self) -> None:
        if self._profile is not None:
            return
        cv2 = opencv()
        folder = Path(cv2.data.haarcascades)
        loaded = []
        for name in ("frontalface_alt2", "frontalface_default", "profileface"):
            cascade = cv2.CascadeClassifier(str(folder / f"haarcascade_{name}.xml"))
            if cascade.empty():
                raise BadModel(f"OpenCV's cascade {name} is missing from {folder}; reinstall opencv-python-headless")
            loaded.append(cascade)
        *self._frontal, self._profile = loaded

    def _profiles(self, gray: npt.NDArray[np.uint8]) -> list[Box]:
        """Faces that look to the left, and with the picture mirrored those that look to the right."""
        mirrored = opencv().flip(gray, 1)
        right = [(gray.shape[1] - x - w, y, w, h) for x, y, w, h in _run(self._profile, mirrored, _PROFILE_STEP)]
        return [*_run(self._profile, gray, _PROFILE_STEP), *right]


def _run(cascade: Any, gray: npt.NDArray[np.uint8], step: float) -> list[Box]:
    boxes = cascade.detectMultiScale(gray, step, 1, minSize=(_MIN_WINDOW_PX,) * 2)
    return [(int(x), int(y), int(w), int(h)) for x, y, w, h in boxes]


class ModelDetector:
    """A network in the form of YuNet (ONNX), which the operator of the camera provides.

    Args:
        path: the model's file.
        min_px: from which width on its operator trusts it.

    Raises:
        BadModel: the file is missing, or OpenCV cannot use it as a face detector.
    """

    def __init__(self, path: Path, min_px: float = DEFAULT_MIN_PX, score: float = 0.5) -> None:
        cv2 = opencv()
        self.name = path.name
        self.min_px = min_px
        if not path.is_file():
            raise BadModel(f"--face-model {path}: there is no such file; name a YuNet model (ONNX), or leave it out")
        try:
            self._network = cv2.FaceDetectorYN.create(str(path), "", (320, 320), score, 0.3, 5000)
            self._detect(np.zeros((320, 320, 3), np.uint8))
        except cv2.error as error:
            sentence = " ".join(str(error.err).split())
            raise BadModel(
                f"--face-model {path}: OpenCV cannot use it as a face detector ({sentence}); name a YuNet model (ONNX)"
            ) from None

    def find(self, picture: Pixels, smallest_px: float, *, upright: bool) -> list[Box]:
        """See `Detector`."""
        small, scale = _reduced(picture, smallest_px)
        found: list[Box] = []
        for degrees in _PLAIN_UPRIGHT if upright else _PLAIN:
            turned, back = _turned(small, degrees)
            found += [_place(box, back, scale) for box in self._detect(turned)]
        return found

    def _detect(self, picture: Pixels) -> list[Box]:
        self._network.setInputSize((picture.shape[1], picture.shape[0]))
        _, faces = self._network.detect(picture)
        return [] if faces is None else [(int(x), int(y), int(w), int(h)) for x, y, w, h in faces[:, :4]]


def _reduced(picture: Pixels, smallest_px: float) -> tuple[Pixels, float]:
    """The picture with its smallest face reduced to `_WINDOW_PX`, and the scale of that."""
    cv2 = opencv()
    scale = min(_WINDOW_PX / max(smallest_px, _WINDOW_PX), 1.0)
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else picture
    return small, scale


def _turned(picture: npt.NDArray[np.uint8], degrees: int) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float64]]:
    """A picture turned around its middle, nothing cut off, and the affine map back to where it came from."""
    cv2 = opencv()
    if degrees % 360 == 0:
        return picture, np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    rows, columns = picture.shape[:2]
    matrix = cv2.getRotationMatrix2D((columns / 2, rows / 2), degrees, 1.0)
    c, s = abs(matrix[0, 0]), abs(matrix[0, 1])
    wide, tall = round(columns * c + rows * s), round(columns * s + rows * c)
    matrix[:, 2] += (wide / 2 - columns / 2, tall / 2 - rows / 2)
    turned = cv2.warpAffine(picture, matrix, (wide, tall), borderMode=cv2.BORDER_REPLICATE)
    return turned, cv2.invertAffineTransform(matrix)


def _place(box: Sequence[int], back: npt.NDArray[np.float64], scale: float) -> Box:
    """The upright box, in the original picture, around a box of a reduced and turned one."""
    left, top, width, height = box
    corners = np.array([(x, y, 1.0) for x in (left, left + width) for y in (top, top + height)]) @ back.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    upright = (int(low[0]), int(low[1]), math.ceil(high[0] - low[0]), math.ceil(high[1] - low[1]))
    x, y, w, h = (round(value / scale) for value in upright)
    return x, y, w, h
