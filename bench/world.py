"""Cost of a picture of the simulated world, and the difference from an oversampled picture.

Durations are processor time of one core, with OpenCV on one thread. The comparator is a naive renderer that looks up every
pixel separately in the finest level of the ground.
"""

from __future__ import annotations

import functools
import itertools
import statistics
import subprocess
import sys
import time

import cv2
import numpy as np
from fractus_world.optics import Intrinsics, Mount, Pose, View
from fractus_world.render import render_ground
from fractus_world.tiles import TILE_PX, TileStore
from fractus_world.world import World
from harness import Report, median_ms, memory_mb, parser

LENS = Intrinsics(1920, 1080, 62.2)
LAT = 50.8637
LON = 4.6785


def pose(world: World, east_m: float, north_m: float, height_m: float) -> Pose:
    """Return the pose of a camera at a place, in metres from the origin of the world."""
    return Pose(*world.frame.latlon(east_m, north_m), height_m, yaw_deg=25.0)


def render_naively(view: View, store: TileStore, level: int = 0) -> np.ndarray:
    """Return the ground below the camera, pixel by pixel."""
    lens = view.intrinsics
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    ground = np.stack((u, v, np.ones_like(u)), axis=-1) @ view.ground_matrix().T
    metres = store.ground.finest_m * 2**level
    x = ground[..., 0] / ground[..., 2] / metres
    y = -ground[..., 1] / ground[..., 2] / metres
    window = (int(x.min()), int(y.min()), int(x.max()) + 2, int(y.max()) + 2)
    picture, left, top = store.mosaic(level, window)
    return picture[(np.floor(y).astype(int) - top), (np.floor(x).astype(int) - left)]


def measure_known_ground(report: Report, world: World, repeats: int) -> None:
    """Measure pictures of ground whose tiles are in the cache, as in nearly all pictures of a flight."""
    scenes = {
        "1080p, 60 m, looking down": (pose(world, 70.0, 55.0, 60.0), Mount()),
        "1080p, 120 m, looking down": (pose(world, 70.0, 55.0, 120.0), Mount()),
        "1080p, 80 m, 45 degrees": (pose(world, 0.0, 0.0, 80.0), Mount(-45.0)),
        "1080p, 100 m, with horizon": (pose(world, 0.0, 0.0, 100.0), Mount(-12.0)),
    }
    store = TileStore(world.ground)
    for name, (camera, mount) in scenes.items():
        world.render(camera, LENS, mount=mount, time_s=100.0)
        measured_ms = median_ms(functools.partial(render_next, world, camera, mount, itertools.count()), repeats)
        reference_ms = None
        if mount.pitch_deg == -90.0:
            view = world.view(camera, LENS, mount)
            render_naively(view, store)
            reference_ms = median_ms(functools.partial(render_naively, view, store), max(repeats // 5, 2))
        report.add("picture", measured_ms, reference_ms, scene=name)
    camera = scenes["1080p, 60 m, looking down"][0]
    report.add("thermal", median_ms(lambda: world.render(camera, LENS, time_s=100.0, band="ir"), repeats))
    picture = world.render(camera, LENS, time_s=100.0)
    report.add("jpeg", median_ms(lambda: cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90]), repeats))
    report.add("truth", median_ms(lambda: world.truth(camera, LENS, time_s=100.0), repeats))


def render_next(world: World, camera: Pose, mount: Mount, numbers: itertools.count[int]) -> None:
    """Render the next picture of a series with five pictures per second."""
    world.render(camera, LENS, mount=mount, time_s=100.0 + 0.2 * next(numbers))


def measure_new_ground(report: Report, frames: int) -> None:
    """Measure a flight over new ground at 10 m/s with five pictures per second, including the drawing of its tiles."""
    world = World.procedural(LAT, LON, 11)
    begun_s = time.process_time()
    world.render(pose(world, 0.0, 0.0, 100.0), LENS)
    report.add("first", (time.process_time() - begun_s) * 1000.0)
    taken_ms = []
    for frame in range(1, frames + 1):
        camera = pose(world, 2.0 * frame, 0.5 * frame, 100.0)
        begun_s = time.process_time()
        world.render(camera, LENS, time_s=0.2 * frame)
        taken_ms.append((time.process_time() - begun_s) * 1000.0)
    report.add("new_ground", statistics.fmean(taken_ms))
    report.add("new_ground_share", 100.0 * sum(t < 40 for t in taken_ms) / len(taken_ms))


def measure_tiles(report: Report) -> None:
    """Measure the drawing of new tiles."""
    ground = World.procedural(LAT, LON, 12).ground
    for level in (0, 2, 4):
        columns = iter(range(-6, 7))
        draw = functools.partial(lambda level, columns: ground.tile(level, next(columns), 3), level, columns)
        report.add("tile", median_ms(draw, 10), size=f"{TILE_PX * 2**level / 32:.0f} m")


def measure_likeness(report: Report) -> None:
    """Measure the difference between a slanted picture and a reference, rendered with 16 times as many pixels."""
    world = World.procedural(LAT, LON, 7)
    small = Intrinsics(480, 270, 62.2)
    large = Intrinsics(1920, 1080, 62.2)
    camera = pose(world, 0.0, 0.0, 120.0)
    mount = Mount(-50.0)
    store = TileStore(world.ground, 600_000_000)
    fine = render_ground(world.view(camera, large, mount), store, "rgb")
    reference = cv2.resize(fine, (small.width, small.height), interpolation=cv2.INTER_AREA).astype(float)

    def error(picture: np.ndarray) -> float:
        return float(np.sqrt(np.mean((picture.astype(float) - reference) ** 2)))

    view = world.view(camera, small, mount)
    report.add("likeness", error(render_ground(view, store, "rgb")), error(render_naively(view, store, 1)))


def visit(world: World) -> float:
    """Render pictures at 24 places of a world, and return the resident memory in megabytes."""
    for step in range(24):
        camera = pose(world, 900.0 * step - 8000.0, 700.0 * (step % 5), 60.0 + 20 * (step % 4))
        world.render(camera, Intrinsics(1280, 720), mount=Mount(-90.0 if step % 2 else -35.0))
    return memory_mb()["resident"]


def main() -> int:
    arguments = parser(__doc__, quick="fewer repetitions")
    arguments.add_argument("--visit", action="store_true", help="only print the memory after 24 pictures")
    options = arguments.parse_args()
    world = World.procedural(LAT, LON, 7)
    if options.visit:
        print(visit(world))
        return 0
    report = Report("world", options)
    measure_known_ground(report, world, 8 if options.quick else 40)
    measure_new_ground(report, 40 if options.quick else 250)
    measure_tiles(report)
    measure_likeness(report)
    visited = subprocess.run([sys.executable, __file__, "--visit"], capture_output=True, check=True, timeout=600)
    report.add("memory", float(visited.stdout))
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
