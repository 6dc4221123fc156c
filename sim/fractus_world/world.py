"""A world: a ground and moving objects, from which pictures and their ground truth are created."""

from __future__ import annotations

import threading

import cv2
from fractus_core.geo import LocalFrame

from fractus_world.billboards import BillboardsAroundOrigin, LandscapeBillboards
from fractus_world.landscape import Landscape
from fractus_world.objects import ObjectLayer
from fractus_world.optics import Intrinsics, Mount, Pose, View
from fractus_world.population import TownPopulation, Unpopulated
from fractus_world.render import Band, render_ground
from fractus_world.survey import Sheet, draw_sheet
from fractus_world.thermal import ThermalGround
from fractus_world.tiles import Ground, Picture, TileStore
from fractus_world.truth import Truth

DEFAULT_MOUNT = Mount()


class World:
    """A ground with objects. Equal arguments always give equal pictures.

    Args:
        ground: Appearance of the ground from above.
        objects: Objects on the ground.
    """

    def __init__(self, ground: Ground, objects: ObjectLayer) -> None:
        self.ground = ground
        self._objects = objects
        self._store = TileStore(ground)
        self._warmth = TileStore(ThermalGround(self._store), 30_000_000)
        self._lock = threading.Lock()
        cv2.setNumThreads(1)

    @classmethod
    def procedural(cls, lat: float, lon: float, seed: int = 7) -> World:
        """Create a world from a seed, around a place."""
        land = Landscape(LocalFrame(lat, lon), seed)
        return cls(
            land, ObjectLayer(TownPopulation(land.roads, land.blocks), LandscapeBillboards(land.roads, land.blocks))
        )

    @classmethod
    def on(cls, ground: Ground, seed: int = 7) -> World:
        """Create a world on a ground picture of the user.

        It has billboards near the origin, but no traffic, because its roads are unknown.
        """
        return cls(ground, ObjectLayer(Unpopulated(), BillboardsAroundOrigin(seed)))

    @property
    def frame(self) -> LocalFrame:
        """Local frame in metres east and north of the world's origin."""
        return self.ground.frame

    def view(self, pose: Pose, intrinsics: Intrinsics, mount: Mount = DEFAULT_MOUNT) -> View:
        """Return the geometry of a picture."""
        return View.of(pose, mount, intrinsics, self.frame)

    def render(
        self,
        pose: Pose,
        intrinsics: Intrinsics,
        *,
        mount: Mount = DEFAULT_MOUNT,
        time_s: float = 0.0,
        band: Band = "rgb",
        hidden: frozenset[str] = frozenset(),
    ) -> Picture:
        """Return the picture of a camera.

        Args:
            pose: Pose of the airframe.
            intrinsics: Lens and sensor.
            mount: Mount of the camera on the airframe.
            time_s: Time in seconds on any clock. It determines the positions of moving objects.
            band: Daylight or thermal.
            hidden: Ids of objects to omit.

        Returns:
            Shape (height, width, 3); blue, green, red.
        """
        with self._lock:
            view = self.view(pose, intrinsics, mount)
            picture = render_ground(view, self._warmth if band == "ir" else self._store, band)
            self._objects.draw(picture, view, self._objects.in_sight(view, time_s, hidden), band)
            return picture

    def truth(self, pose: Pose, intrinsics: Intrinsics, *, mount: Mount = DEFAULT_MOUNT, time_s: float = 0.0) -> Truth:
        """Return the ground truth of the picture that `render` returns for the same arguments."""
        with self._lock:
            view = self.view(pose, intrinsics, mount)
            return Truth(pose, *self._objects.truth(view, self._objects.in_sight(view, time_s), self.frame))

    def map(self, sheet: Sheet) -> Picture:
        """Return the ground of a map sheet without moving objects, shape (pixels, pixels, 3)."""
        with self._lock:
            return draw_sheet(sheet, self._store, self.frame)


class WorldAround:
    """A world that is created around the first camera pose unless its origin is given.

    Args:
        seed: Seed of landscape and objects.
        origin: Latitude and longitude. None: the first position rounded to 0.1 degrees, so that nearby cameras share
            it.
        world: An existing world.
    """

    def __init__(self, seed: int, origin: tuple[float, float] | None = None, world: World | None = None) -> None:
        self._seed = seed
        self._lock = threading.Lock()
        self._world = world if origin is None or world is not None else World.procedural(*origin, seed)

    def at(self, pose: Pose | None) -> World | None:
        """Return the world, or None if no position is known yet."""
        with self._lock:
            if self._world is None and pose is not None:
                self._world = World.procedural(round(pose.lat, 1), round(pose.lon, 1), self._seed)
            return self._world
