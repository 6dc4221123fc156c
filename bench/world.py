"""What a picture of the simulated world costs, and how true it is.

    uv run python bench/world.py [--quick] [--json FILE]

All figures are processor time of one core (OpenCV is held to one thread), so that other load does not count. Beside it
the naive way: every pixel looked up in the finest level of the ground by itself.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from fractus_world.optics import Intrinsics, Mount, Pose, View
from fractus_world.render import render_ground
from fractus_world.tiles import TILE_PX, TileStore
from fractus_world.world import World

LENS = Intrinsics(1920, 1080, 62.2)
LAT = 50.8637
LON = 4.6785
LIMIT_MS = 40.0


@dataclass(frozen=True, slots=True)
class Claim:
    """One figure."""

    name: str
    ours: float
    theirs: float | None
    unit: str
    target: str
    holds: bool

    def as_json(self) -> dict[str, object]:
        """The claim as the benchmarks' common format has it."""
        ratio = None if not self.theirs else round(self.ours / self.theirs, 4)
        return {
            "name": self.name,
            "ours": round(self.ours, 3),
            "theirs": None if self.theirs is None else round(self.theirs, 3),
            "unit": self.unit,
            "ratio": ratio,
            "target": self.target,
            "holds": self.holds,
        }


def cost_ms(work: Callable[[], object], repeats: int) -> float:
    """Median processor time."""
    times = []
    for _ in range(repeats):
        begun = time.process_time()
        work()
        times.append((time.process_time() - begun) * 1000.0)
    return statistics.median(times)


def pose(world: World, east_m: float, north_m: float, height_m: float) -> Pose:
    return Pose(*world.frame.latlon(east_m, north_m), height_m, yaw_deg=25.0)


def naive(view: View, store: TileStore, level: int = 0) -> np.ndarray:
    """The ground below the camera, pixel by pixel."""
    lens = view.intrinsics
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    ground = np.stack((u, v, np.ones_like(u)), axis=-1) @ view.ground_matrix().T
    metres = store.ground.finest_m * 2**level
    x = ground[..., 0] / ground[..., 2] / metres
    y = -ground[..., 1] / ground[..., 2] / metres
    window = (int(x.min()), int(y.min()), int(x.max()) + 2, int(y.max()) + 2)
    picture, left, top = store.mosaic(level, window)
    return picture[(np.floor(y).astype(int) - top), (np.floor(x).astype(int) - left)]


def speed(world: World, repeats: int) -> list[Claim]:
    """A picture whose ground has been seen before: what a drone that hovers or flies on pays for nearly every one."""
    claims = []
    scenes = {
        "1080p, 60 m, looking down": (pose(world, 70.0, 55.0, 60.0), Mount()),
        "1080p, 120 m, looking down": (pose(world, 70.0, 55.0, 120.0), Mount()),
        "1080p, 80 m, 45 degrees": (pose(world, 0.0, 0.0, 80.0), Mount(-45.0)),
        "1080p, 100 m, with horizon": (pose(world, 0.0, 0.0, 100.0), Mount(-12.0)),
    }
    store = TileStore(world.ground)
    for name, (at, mount) in scenes.items():
        world.render(at, LENS, mount=mount, time_s=100.0)
        moments = iter(range(10_000))

        def shoot(at: Pose = at, mount: Mount = mount, moments: object = moments) -> object:
            return world.render(at, LENS, mount=mount, time_s=100.0 + 0.2 * next(moments))  # type: ignore[call-overload]

        ours = cost_ms(shoot, repeats)
        theirs = None
        if mount.pitch_deg == -90.0:
            view = world.view(at, LENS, mount)
            naive(view, store)
            theirs = cost_ms(lambda view=view: naive(view, store), max(repeats // 5, 2))
        claims.append(Claim(name, ours, theirs, "ms", f"< {LIMIT_MS:g}", ours < LIMIT_MS))
    at = scenes["1080p, 60 m, looking down"][0]
    thermal = cost_ms(lambda: world.render(at, LENS, time_s=100.0, band="ir"), repeats)
    claims.append(Claim("the same, thermal", thermal, None, "ms", f"< {LIMIT_MS:g}", thermal < LIMIT_MS))
    picture = world.render(at, LENS, time_s=100.0)
    jpeg = cost_ms(lambda: cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90]), repeats)
    claims.append(Claim("JPEG of it", jpeg, None, "ms", "-", True))
    truth = cost_ms(lambda: world.truth(at, LENS, time_s=100.0), repeats)
    claims.append(Claim("its truth", truth, None, "ms", f"< {LIMIT_MS:g}", truth < LIMIT_MS))
    return claims


def flight(frames: int) -> list[Claim]:
    """A flight over new ground at 10 m/s, five pictures a second: what the tiles cost that no one has seen before."""
    world = World.procedural(LAT, LON, 11)
    begun = time.process_time()
    world.render(pose(world, 0.0, 0.0, 100.0), LENS)
    first = (time.process_time() - begun) * 1000.0
    times = []
    for frame in range(1, frames + 1):
        at = pose(world, 2.0 * frame, 0.5 * frame, 100.0)
        begun = time.process_time()
        world.render(at, LENS, time_s=0.2 * frame)
        times.append((time.process_time() - begun) * 1000.0)
    mean = statistics.fmean(times)
    return [
        Claim("first picture of a world", first, None, "ms", "-", True),
        Claim("mean over new ground at 10 m/s, 5 pictures a second", mean, None, "ms", "< 100", mean < 100.0),
        Claim(
            "share of those pictures within 40 ms",
            100.0 * sum(t < 40 for t in times) / len(times),
            None,
            "%",
            "-",
            True,
        ),
    ]


def visit(world: World) -> float:
    """Resident memory, MB, after pictures all over a world of many kilometres."""
    for step in range(24):
        at = pose(world, 900.0 * step - 8000.0, 700.0 * (step % 5), 60.0 + 20 * (step % 4))
        world.render(at, Intrinsics(1280, 720), mount=Mount(-90.0 if step % 2 else -35.0))
    return int(Path("/proc/self/status").read_text(encoding="ascii").split("VmRSS:")[1].split()[0]) / 1024


def memory() -> Claim:
    """The same in a process of its own."""
    done = subprocess.run(
        [sys.executable, __file__, "--visit"], capture_output=True, text=True, check=True, timeout=600
    )
    resident = float(done.stdout)
    return Claim("resident memory after 24 places of 17 km of world", resident, None, "MB", "< 500", resident < 500.0)


def likeness(world: World) -> Claim:
    """How far a slanted picture is from one of sixteen times as many rays; the naive one flickers."""
    small = Intrinsics(480, 270, 62.2)
    large = Intrinsics(1920, 1080, 62.2)
    at = pose(world, 0.0, 0.0, 120.0)
    mount = Mount(-50.0)
    store = TileStore(world.ground, 600_000_000)
    fine = render_ground(world.view(at, large, mount), store, "rgb")
    reference = cv2.resize(fine, (small.width, small.height), interpolation=cv2.INTER_AREA).astype(float)

    def error(picture: np.ndarray) -> float:
        return float(np.sqrt(np.mean((picture.astype(float) - reference) ** 2)))

    view = world.view(at, small, mount)
    ours = error(render_ground(view, store, "rgb"))
    theirs = error(naive(view, store, 1))
    return Claim("grey levels off a 16-fold oversampled picture", ours, theirs, "rms", "< naive", ours < theirs)


def tiles(world: World) -> list[Claim]:
    """What a tile costs that no one has seen before."""
    claims = []
    for level in (0, 2, 4):
        numbers = iter(range(-6, 7))
        cost = cost_ms(lambda level=level, numbers=numbers: world.ground.tile(level, next(numbers), 3), 10)
        claims.append(Claim(f"a new tile of {TILE_PX * 2**level / 32:.0f} m, median", cost, None, "ms", "-", True))
    return claims


def main() -> None:
    """Measure and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--visit", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    world = World.procedural(LAT, LON, 7)
    if arguments.visit:
        print(visit(world))
        return
    claims = speed(world, 8 if arguments.quick else 40)
    claims += flight(40 if arguments.quick else 250) + tiles(World.procedural(LAT, LON, 12))
    claims += [likeness(World.procedural(LAT, LON, 7)), memory()]
    width = max(len(claim.name) for claim in claims)
    for claim in claims:
        theirs = "" if claim.theirs is None else f"naive {claim.theirs:.1f}"
        verdict = "" if claim.target == "-" else "holds" if claim.holds else "MISSED"
        print(f"{claim.name:<{width}}  {claim.ours:9.2f} {claim.unit:<4} {theirs:<14} {claim.target:<8} {verdict}")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({"claims": [claim.as_json() for claim in claims]}, indent=2) + "\n")


if __name__ == "__main__":
    main()
