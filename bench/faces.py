"""How many faces the camera service finds, and hides, at which size, in which direction and in which light.

Faces are the one of scikit-image's packaged photograph of an astronaut, and the hundred of its subset of Labeled Faces in
the Wild (25x25 pixels, enlarged). They are turned, lit, made noisy and laid on packaged pictures of ground. The comparator
is what tutorials do, in the same run: one upright pass of OpenCV's default cascade, with its usual parameters. A face is
found when a box of about its size covers its middle, and hidden when the filter changes at least 95 % of the disc that it
fills into pieces of a sixth of its width or more.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import skimage.data
from fractus_services.camera.face_detection import DEFAULT_MIN_PX, Box, CascadeDetector
from fractus_services.camera.filter_pipeline import FACE_CELLS, blur_average, blur_median, hide_faces
from fractus_services.camera.pixels import Pixels

SEED = 40
ASTRONAUT = (177, 66, 97)
"""Left, top and width of the face in the photograph."""
LFW_FACES = 100
CANVAS = 3.0
"""Width of a scene, in widths of its face."""
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
    """A picture with one face: its middle and its width in pixels, how far it is turned, and how it is lit."""

    picture: Pixels
    x: float
    y: float
    width: float
    turn_deg: float
    light: str


def astronaut(width_px: float, turn_deg: float, light: str) -> Scene:
    """The astronaut's face, so wide and so far turned, with what is around it."""
    left, top, width = ASTRONAUT
    photo = cv2.cvtColor(skimage.data.astronaut(), cv2.COLOR_RGB2BGR)
    return laid(photo, (left + width / 2, top + width / 2, width), width_px, turn_deg, light)


def labelled(face: np.ndarray, ground: Pixels, width_px: float, turn_deg: float, light: str) -> Scene:
    """A face of the hundred on a piece of ground; it fills about 0.9 of its 25 pixels."""
    face = cv2.resize((face * 255).astype(np.uint8), (100, 100), interpolation=cv2.INTER_CUBIC)
    scene = ground[:300, :300].copy()
    scene[100:200, 100:200] = face[..., None]
    return laid(scene, (150.0, 150.0, 90.0), width_px, turn_deg, light)


def laid(photo: Pixels, face: tuple[float, float, float], width_px: float, turn_deg: float, light: str) -> Scene:
    """A square around a face, scaled and turned."""
    x, y, width = face
    side = round(width_px * CANVAS)
    matrix = cv2.getRotationMatrix2D((x, y), turn_deg, width_px / width)
    matrix[:, 2] += (side / 2 - x, side / 2 - y)
    # Reduced with care: without it, small faces would be made of stray pixels.
    blur = max(width / width_px / 2, 0.01)
    smooth = cv2.GaussianBlur(photo, (0, 0), blur) if blur > 0.5 else photo
    picture = cv2.warpAffine(smooth, matrix, (side, side), borderMode=cv2.BORDER_REFLECT)
    return Scene(LIGHTS[light](picture), side / 2, side / 2, width_px, turn_deg, light)


def naive(picture: Pixels) -> list[Box]:
    """What tutorials do."""
    cascade = cv2.CascadeClassifier(str(Path(cv2.data.haarcascades) / "haarcascade_frontalface_default.xml"))
    return [
        tuple(int(v) for v in box)
        for box in cascade.detectMultiScale(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), 1.3, 5)
    ]  # type: ignore[misc]


def found(scene: Scene, boxes: list[Box]) -> bool:
    return any(
        x <= scene.x <= x + w and y <= scene.y <= y + h and 0.5 * scene.width <= w <= 2.5 * scene.width
        for x, y, w, h in boxes
    )


def hidden(scene: Scene, boxes: list[Box]) -> bool:
    """Whether the filter covers the disc of the face with coarse pieces."""
    marks = np.random.default_rng(SEED).integers(0, 256, scene.picture.shape).astype(np.uint8)
    coarse = [box for box in boxes if box[2] / FACE_CELLS >= scene.width / 6]
    changed = (hide_faces(marks, coarse, "pixelate") != marks).any(axis=2)
    rows, columns = np.indices(changed.shape)
    disc = np.hypot(columns - scene.x, rows - scene.y) < scene.width / 2
    return bool(changed[disc].mean() >= 0.95)


@dataclass
class Tally:
    """Scenes, and in how many the face was found by us and by the comparator, and hidden by us."""

    scenes: int = 0
    ours: int = 0
    theirs: int = 0
    hidden: int = 0

    def add(self, scene: Scene, detector: CascadeDetector) -> None:
        boxes = detector.detect(scene.picture, scene.width * 0.95, upright=False)
        ours = found(scene, boxes)
        self.scenes += 1
        self.ours += ours
        self.hidden += hidden(scene, boxes)
        self.theirs += found(scene, naive(scene.picture))

    def share(self, name: str) -> float:
        return getattr(self, name) / max(self.scenes, 1)


def astronauts(width_px: float, quick: bool) -> Iterator[Scene]:
    for turn in range(0, 360, 45 if quick else 15):
        for light in LIGHTS:
            yield astronaut(width_px, turn + 5, light)


def hundred(width_px: float, quick: bool) -> Iterator[Scene]:
    faces = np.load(Path(skimage.data.__file__).parent / "lfw_subset.npy")[:LFW_FACES]
    grounds = [cv2.cvtColor(getattr(skimage.data, name)(), cv2.COLOR_GRAY2BGR) for name in ("gravel", "grass", "brick")]
    random = np.random.default_rng(SEED)
    lights = list(LIGHTS)
    for index in range(0, LFW_FACES, 5 if quick else 1):
        turn = float(random.uniform(0, 360))
        yield labelled(faces[index], grounds[index % 3], width_px, turn, lights[index % len(lights)])


def recall_table(quick: bool) -> dict[tuple[str, int], Tally]:
    detector = CascadeDetector()
    tallies = {}
    print(f"{'faces':<12}{'width px':>9}{'scenes':>8}{'ours':>8}{'hidden':>8}{'tutorial':>10}")
    for name, series in (("astronaut", astronauts), ("hundred", hundred)):
        for width in (24, DEFAULT_MIN_PX) if quick else (16, 24, 32, 40, DEFAULT_MIN_PX, 64, 96):
            tally = Tally()
            for scene in series(width, quick):
                tally.add(scene, detector)
            tallies[name, width] = tally
            print(
                f"{name:<12}{width:>9}{tally.scenes:>8}{tally.share('ours'):>8.3f}{tally.share('hidden'):>8.3f}"
                f"{tally.share('theirs'):>10.3f}"
            )
    return tallies


def timings(quick: bool) -> None:
    detector = CascadeDetector()
    photo = cv2.cvtColor(skimage.data.astronaut(), cv2.COLOR_RGB2BGR)
    print(
        f"\n{'picture':<12}{'average':>10}{'median':>10}{'faces up':>10}{'faces all':>10}   ms of one core, smallest face {DEFAULT_MIN_PX} px"
    )
    sizes = {"VGA": (640, 480), "720p": (1280, 720)} | ({} if quick else {"1080p": (1920, 1080), "8MP": (3264, 2448)})
    for name, (width, height) in sizes.items():
        picture = np.ascontiguousarray(np.tile(photo, (height // 512 + 1, width // 512 + 1, 1))[:height, :width])
        jobs: list[Callable[[], object]] = [
            lambda p=picture: blur_average(p),
            lambda p=picture: blur_median(p),
            lambda p=picture: detector.detect(p, DEFAULT_MIN_PX, upright=True),
            lambda p=picture: detector.detect(p, DEFAULT_MIN_PX, upright=False),
        ]
        print(f"{name:<12}" + "".join(f"{1000 * timed(job, 1 if i > 1 else 5):>10.1f}" for i, job in enumerate(jobs)))


def timed(job: Callable[[], object], times: int) -> float:
    taken = []
    for _ in range(times):
        begun = time.process_time()
        job()
        taken.append(time.process_time() - begun)
    return statistics.median(taken)


def claims(tallies: dict[tuple[str, int], Tally]) -> list[dict[str, object]]:
    made = []
    for name, target in (("astronaut", 0.97), ("hundred", 0.95)):
        trusted = [tally for (series, width), tally in tallies.items() if series == name and width >= DEFAULT_MIN_PX]
        whole = Tally(*(sum(getattr(t, field) for t in trusted) for field in ("scenes", "ours", "theirs", "hidden")))
        for field, what in (("ours", "found"), ("hidden", "hidden")):
            ours = whole.share(field)
            theirs = whole.share("theirs")
            made.append(
                {
                    "name": f"{name}: faces {what} from {DEFAULT_MIN_PX} px on, every direction and light", "ours": round(ours, 4),
                    "theirs": round(theirs, 4), "unit": "share", "ratio": round(ours / max(theirs, 1e-9), 2),
                    "target": target, "holds": ours >= target,
                }
            )  # fmt: skip
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer camera_orientation, sizes and faces")
    parser.add_argument("--json", type=Path, help="write the claims to a file")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    made = claims(recall_table(options.quick))
    timings(options.quick)
    print()
    for claim in made:
        print(
            f"{'holds' if claim['holds'] else 'FAILS'}: {claim['name']}: {claim['ours']:.3f} (target {claim['target']}),"
            f" tutorial {claim['theirs']:.3f}"
        )
    if options.json:
        options.json.write_text(json.dumps({"claims": made}, indent=1))


if __name__ == "__main__":
    main()
