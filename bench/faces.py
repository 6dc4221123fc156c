"""Share of faces that the camera service finds and hides, by their size, direction and light, and the cost of its filters.

One face is from a photograph of an astronaut. If scikit-image is installed (`uv pip install scikit-image`), a hundred
more are from its subset of Labeled Faces in the Wild (25 x 25 pixels, enlarged) and are placed on pictures of the
ground. All faces are rotated, and get different light and noise. The comparator is the method of most tutorials: one
upright pass of OpenCV's default cascade with its usual parameters.

A face is found if a detected box of about the size of the face covers the middle of the face. A face is hidden if the
filter changes at least 95 % of the disc of the face, in squares of at least a sixth of the width of the face.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from fractus_services.camera.face_detection import DEFAULT_MIN_PX, Box, CascadeDetector
from fractus_services.camera.filter_pipeline import FACE_CELLS, blur_average, blur_median, hide_faces
from fractus_services.camera.pixels import Pixels
from fractus_world.billboards import photograph
from harness import Report, median_ms, parser, print_table

SEED = 40
ASTRONAUT = (177, 66, 97)
"""Left, top and width of the face in the photograph."""
LFW_FACES = 100
CANVAS = 3.0
"""Width of a scene, as a multiple of the width of its face."""
LIGHTS: dict[str, Callable[[Pixels], Pixels]] = {
    "plain": lambda p: p,
    "dark": lambda p: cv2.convertScaleAbs(p, alpha=0.3),
    "bright": lambda p: cv2.convertScaleAbs(p, alpha=1.4, beta=30),
    "flat": lambda p: cv2.convertScaleAbs(p, alpha=0.35, beta=100),
    "lit from the side": lambda p: np.clip(p * np.linspace(0.35, 1.3, p.shape[1])[None, :, None], 0, 255).astype(np.uint8),
    "noisy": lambda p: np.clip(p + np.random.default_rng(SEED).normal(0, 14, p.shape), 0, 255).astype(np.uint8),
}  # fmt: skip


@dataclass(frozen=True)
class Scene:
    """A picture with one face in its middle.

    Attributes:
        picture: Square picture.
        width: Width of the face in pixels.
    """

    picture: Pixels
    width: float

    @property
    def middle(self) -> float:
        """Column and row of the middle of the face."""
        return self.picture.shape[0] / 2


def scene_of(photo: Pixels, face: tuple[float, float, float], width_px: float, angle_deg: float, light: str) -> Scene:
    """Return the part of a photograph around a face, scaled and rotated, in one of the `LIGHTS`.

    Args:
        photo: Photograph.
        face: x, y and width of the face in the photograph. x and y are the middle of the face.
        width_px: Width of the face in the scene.
        angle_deg: Rotation, counter-clockwise.
        light: Key of `LIGHTS`.
    """
    x, y, width = face
    side = round(width_px * CANVAS)
    matrix = cv2.getRotationMatrix2D((x, y), angle_deg, width_px / width)
    matrix[:, 2] += (side / 2 - x, side / 2 - y)
    # Without smoothing, a face that is scaled down would consist of single pixels of the photograph.
    blur = max(width / width_px / 2, 0.01)
    smooth = cv2.GaussianBlur(photo, (0, 0), blur) if blur > 0.5 else photo
    picture = cv2.warpAffine(smooth, matrix, (side, side), borderMode=cv2.BORDER_REFLECT)
    return Scene(LIGHTS[light](picture), width_px)


def astronauts(width_px: float, quick: bool) -> Iterator[Scene]:
    """Return the astronaut's face in many directions and every light."""
    left, top, width = ASTRONAUT
    for angle in range(0, 360, 45 if quick else 15):
        for light in LIGHTS:
            yield scene_of(photograph(), (left + width / 2, top + width / 2, width), width_px, angle + 5, light)


def hundred(width_px: float, quick: bool) -> Iterator[Scene]:
    """Return the hundred faces, each in a random direction. A face fills about 0.9 of its 25 pixels."""
    import skimage.data  # noqa: PLC0415  (not a dependency)

    faces = np.load(Path(skimage.data.__file__).parent / "lfw_subset.npy")[:LFW_FACES]
    grounds = [cv2.cvtColor(getattr(skimage.data, name)(), cv2.COLOR_GRAY2BGR) for name in ("gravel", "grass", "brick")]
    random = np.random.default_rng(SEED)
    lights = list(LIGHTS)
    for index in range(0, LFW_FACES, 5 if quick else 1):
        face = cv2.resize((faces[index] * 255).astype(np.uint8), (100, 100), interpolation=cv2.INTER_CUBIC)
        photo = grounds[index % 3][:300, :300].copy()
        photo[100:200, 100:200] = face[..., None]
        angle = float(random.uniform(0, 360))
        yield scene_of(photo, (150.0, 150.0, 90.0), width_px, angle, lights[index % len(lights)])


def detect_like_tutorials(picture: Pixels) -> list[Box]:
    """Return the boxes of one upright pass of the default cascade."""
    cascade = cv2.CascadeClassifier(str(Path(cv2.data.haarcascades) / "haarcascade_frontalface_default.xml"))
    boxes = cascade.detectMultiScale(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), 1.3, 5)
    return [(int(x), int(y), int(w), int(h)) for x, y, w, h in boxes]


def is_found(scene: Scene, boxes: list[Box]) -> bool:
    """Return True if a box of about the size of the face covers its middle."""
    return any(
        x <= scene.middle <= x + w and y <= scene.middle <= y + h and 0.5 * scene.width <= w <= 2.5 * scene.width
        for x, y, w, h in boxes
    )


def is_hidden(scene: Scene, boxes: list[Box]) -> bool:
    """Return True if the filter covers the disc of the face with sufficiently large squares."""
    marks = np.random.default_rng(SEED).integers(0, 256, scene.picture.shape).astype(np.uint8)
    coarse = [box for box in boxes if box[2] / FACE_CELLS >= scene.width / 6]
    changed = (hide_faces(marks, coarse, "pixelate") != marks).any(axis=2)
    rows, columns = np.indices(changed.shape)
    disc = np.hypot(columns - scene.middle, rows - scene.middle) < scene.width / 2
    return bool(changed[disc].mean() >= 0.95)


def measure_shares(report: Report, name: str, series: Callable[[float, bool], Iterator[Scene]], quick: bool) -> None:
    """Measure the shares of found and hidden faces of a series, for each face width."""
    detector = CascadeDetector()
    rows = []
    reliable = []
    for width in (24, DEFAULT_MIN_PX) if quick else (16, 24, 32, 40, DEFAULT_MIN_PX, 64, 96):
        outcomes = []
        for scene in series(width, quick):
            boxes = detector.detect(scene.picture, scene.width * 0.95, upright=False)
            reference = detect_like_tutorials(scene.picture)
            outcomes.append((is_found(scene, boxes), is_hidden(scene, boxes), is_found(scene, reference)))
        rows.append((name, width, len(outcomes), *(float(share) for share in np.mean(outcomes, axis=0))))
        if width >= DEFAULT_MIN_PX:
            reliable += outcomes
    print_table(("faces", "width px", "scenes", "found", "hidden", "tutorial"), rows)
    found, hidden, reference = (float(share) for share in np.mean(reliable, axis=0))
    report.add(f"{name}_found", found, reference, width=DEFAULT_MIN_PX)
    report.add(f"{name}_hidden", hidden, reference, width=DEFAULT_MIN_PX)


def measure_filters(report: Report, quick: bool) -> None:
    """Measure the processor time of filters by picture size."""
    detector = CascadeDetector()
    sizes = {"VGA": (640, 480), "720p": (1280, 720)} | ({} if quick else {"1080p": (1920, 1080), "8 MP": (3264, 2448)})
    for size, (width, height) in sizes.items():
        tiles = np.tile(photograph(), (height // 512 + 1, width // 512 + 1, 1))
        picture = np.ascontiguousarray(tiles[:height, :width])
        report.add("average", median_ms(lambda p=picture: blur_average(p), 5), size=size)
        report.add("median", median_ms(lambda p=picture: blur_median(p), 5), size=size)
        for claim, upright in (("upright", True), ("any_direction", False)):
            job = lambda p=picture, u=upright: detector.detect(p, DEFAULT_MIN_PX, upright=u)  # noqa: E731
            report.add(claim, median_ms(job, 1), size=size)


def main() -> int:
    options = parser(__doc__, quick="fewer directions, sizes and faces").parse_args()
    cv2.setNumThreads(1)
    report = Report("faces", options)
    measure_shares(report, "astronaut", astronauts, options.quick)
    if importlib.util.find_spec("skimage") is not None:
        measure_shares(report, "hundred", hundred, options.quick)
    else:
        print("the hundred faces are not measured, because scikit-image is not installed")
    measure_filters(report, options.quick)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
