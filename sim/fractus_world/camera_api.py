"""HTTP API of the simulated camera without sockets: pictures, their ground truth, and a map."""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from http import HTTPStatus
from importlib import resources
from typing import Any

import cv2

from fractus_world.optics import Intrinsics, Mount, Pose
from fractus_world.photos import Photos, resized
from fractus_world.pose_provider import CameraPose, PoseProvider
from fractus_world.render import Band
from fractus_world.survey import Sheet
from fractus_world.tiles import Picture
from fractus_world.truth import Truth
from fractus_world.world import World, WorldAround

RENDER_WAIT_S = 5.0
MAX_WAITING = 8
MAX_SNAPSHOT_PX = 16_000_000
KEPT_SNAPSHOTS = 64
JPEG_QUALITY = 90
_NO_POSE = "the position of the vehicle is unknown; check that it is powered on and has a GPS fix"


class RequestError(Exception):
    """A rejected request.

    Args:
        status: HTTP status.
        reason: Reason in one sentence.
    """

    def __init__(self, status: HTTPStatus, reason: str) -> None:
        super().__init__(reason)
        self.status = status


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Inputs of a picture, kept so that its ground truth can be computed later."""

    number: int
    pose: Pose
    mount: Mount
    intrinsics: Intrinsics
    time_s: float
    band: Band
    amsl_m: float


@dataclass(frozen=True, slots=True)
class Response:
    """Body and headers of a response."""

    content_type: str
    body: bytes
    headers: tuple[tuple[str, str], ...] = ()


class CameraApi:
    """Handles requests.

    Args:
        world: World to show.
        poses: Provides the camera position.
        intrinsics: Lens and resolution of the camera.
        mount: Mount on the airframe, unless a gimbal reports its attitude.
        now: Returns Unix seconds for moving objects.
        photos: Photographs to show instead of the world.
    """

    def __init__(
        self,
        world: WorldAround,
        poses: PoseProvider,
        intrinsics: Intrinsics,
        mount: Mount,
        *,
        now: Callable[[], float],
        photos: Photos | None = None,
    ) -> None:
        self._world = world
        self._poses = poses
        self._intrinsics = intrinsics
        self._mount = mount
        self._now = now
        self._photos = photos
        self._snapshots: OrderedDict[int, Snapshot] = OrderedDict()
        self._count = 0
        self._lock = threading.Lock()
        self._busy = threading.Lock()
        self._waiting = threading.BoundedSemaphore(MAX_WAITING)

    def handle(self, path: str, query: dict[str, str]) -> Response:
        """Handle a GET request.

        Raises:
            RequestError: The page does not exist, a parameter is invalid, or no picture is available now.
        """
        pages: dict[str, Callable[[dict[str, str]], Response]] = {
            "/": self._index,
            "/snapshot.jpg": self._snapshot,
            "/truth.json": self._truth,
            "/orthophoto.png": self._orthophoto,
            "/orthophoto.pgw": self._world_file,
        }
        page = pages.get(path)
        if page is None:
            raise RequestError(HTTPStatus.NOT_FOUND, f"unknown page {path}; available: {', '.join(pages)}")
        try:
            return page(query)
        except ValueError as error:
            raise RequestError(HTTPStatus.BAD_REQUEST, str(error)) from error

    def _index(self, query: dict[str, str]) -> Response:
        _only(query)
        return Response("text/html; charset=utf-8", resources.files(__package__).joinpath("index.html").read_bytes())

    def _snapshot(self, query: dict[str, str]) -> Response:
        _only(query, "width", "height", "band", "time")
        band = query.get("band", "rgb")
        if band not in ("rgb", "ir"):
            raise RequestError(HTTPStatus.BAD_REQUEST, f"band: {band[:20]!r} is neither rgb nor ir")
        width = _whole(query, "width", self._intrinsics.width)
        height = _whole(query, "height", self._intrinsics.height)
        lens = Intrinsics(width, height, self._intrinsics.horizontal_fov_deg)
        if width * height > MAX_SNAPSHOT_PX:
            raise RequestError(HTTPStatus.BAD_REQUEST, f"width and height: more than {MAX_SNAPSHOT_PX:,} pixels")
        time_s = _number(query, "time", self._now())
        camera_pose = self._poses.now()
        if camera_pose is None:
            raise RequestError(HTTPStatus.SERVICE_UNAVAILABLE, _NO_POSE)
        snapshot = self._record(camera_pose, lens, time_s, "ir" if band == "ir" else "rgb")
        with _RenderSlot(self._waiting, self._busy):
            picture = self._render(snapshot)
        done, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if not done:
            raise RequestError(HTTPStatus.INTERNAL_SERVER_ERROR, "the picture cannot be encoded")
        headers = (("X-Fractus-Snapshot", str(snapshot.number)), ("X-Fractus-Time", f"{snapshot.time_s:.3f}"))
        return Response("image/jpeg", encoded.tobytes(), headers)

    def _render(self, shot: Snapshot) -> Picture:
        lens = shot.intrinsics
        if self._photos is not None:
            photo, _ = self._photos.nearest(shot.pose.lat, shot.pose.lon, shot.amsl_m, shot.band)
            return resized(photo, lens.width, lens.height)
        world = self._world_at(shot.pose)
        return world.render(shot.pose, lens, mount=shot.mount, time_s=shot.time_s, band=shot.band)

    def _pose(self) -> Pose | None:
        camera_pose = self._poses.now()
        return None if camera_pose is None else camera_pose.pose

    def _world_at(self, pose: Pose | None) -> World:
        world = self._world.at(pose)
        if world is None:
            raise RequestError(HTTPStatus.SERVICE_UNAVAILABLE, _NO_POSE)
        return world

    def _record(self, camera_pose: CameraPose, lens: Intrinsics, time_s: float, band: Band) -> Snapshot:
        pose = camera_pose.pose
        mount = camera_pose.mount or self._mount
        amsl_m = camera_pose.ground_amsl_m + pose.height_m
        with self._lock:
            self._count += 1
            snapshot = Snapshot(self._count, pose, mount, lens, time_s, band, amsl_m)
            self._snapshots[snapshot.number] = snapshot
            while len(self._snapshots) > KEPT_SNAPSHOTS:
                self._snapshots.popitem(last=False)
        return snapshot

    def _truth(self, query: dict[str, str]) -> Response:
        _only(query, "snapshot")
        with self._lock:
            if not self._snapshots:
                raise RequestError(HTTPStatus.NOT_FOUND, "no picture has been taken; request /snapshot.jpg first")
            number = _whole(query, "snapshot", next(reversed(self._snapshots)))
            snapshot = self._snapshots.get(number)
        if snapshot is None:
            raise RequestError(HTTPStatus.NOT_FOUND, f"snapshot {number} is not one of the last {KEPT_SNAPSHOTS}")
        content: dict[str, Any] = {"snapshot": snapshot.number, "time": snapshot.time_s, "band": snapshot.band}
        pose = snapshot.pose
        if self._photos is not None:
            photo, distance_m = self._photos.nearest(pose.lat, pose.lon, snapshot.amsl_m, snapshot.band)
            place = {"lat": photo.lat, "lon": photo.lon, "amslM": photo.amsl_m, "awayM": round(distance_m, 3)}
            content |= {"photo": {"name": photo.path.name, **place}} | Truth(pose, (), ()).as_json()
        else:
            with _RenderSlot(self._waiting, self._busy):
                truth = self._world_at(pose).truth(
                    pose, snapshot.intrinsics, mount=snapshot.mount, time_s=snapshot.time_s
                )
            content |= truth.as_json()
        return Response("application/json", json.dumps(content).encode())

    def _sheet(self, query: dict[str, str]) -> Sheet:
        _only(query, "lat", "lon", "metres", "pixels")
        frame = self._world_at(self._pose()).frame
        return Sheet(
            _number(query, "lat", frame.lat),
            _number(query, "lon", frame.lon),
            _number(query, "metres", 600.0),
            _whole(query, "pixels", 1024),
        )

    def _orthophoto(self, query: dict[str, str]) -> Response:
        sheet = self._sheet(query)
        with _RenderSlot(self._waiting, self._busy):
            picture = self._world_at(None).map(sheet)
        done, encoded = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 3])
        if not done:
            raise RequestError(HTTPStatus.INTERNAL_SERVER_ERROR, "the map cannot be encoded")
        return Response("image/png", encoded.tobytes())

    def _world_file(self, query: dict[str, str]) -> Response:
        return Response("text/plain; charset=ascii", self._sheet(query).world_file().encode("ascii"))


class _RenderSlot:
    """Permission to render. One request renders at a time. A few other requests wait for a limited time."""

    def __init__(self, waiting: threading.BoundedSemaphore, busy: threading.Lock) -> None:
        self._waiting = waiting
        self._busy = busy

    def __enter__(self) -> None:
        if not self._waiting.acquire(blocking=False):
            raise RequestError(HTTPStatus.SERVICE_UNAVAILABLE, "too many concurrent requests; try again")
        if not self._busy.acquire(timeout=RENDER_WAIT_S):
            self._waiting.release()
            raise RequestError(HTTPStatus.SERVICE_UNAVAILABLE, "earlier pictures take too long; try again")

    def __exit__(self, *_: object) -> None:
        self._busy.release()
        self._waiting.release()


def _only(query: dict[str, str], *known: str) -> None:
    for name in query:
        if name not in known:
            names = ", ".join(known) or "none"
            raise RequestError(HTTPStatus.BAD_REQUEST, f"unknown parameter {name[:40]!r}; known parameters: {names}")


def _number(query: dict[str, str], name: str, default: float) -> float:
    text = query.get(name)
    try:
        value = default if text is None else float(text)
    except ValueError as error:
        raise RequestError(HTTPStatus.BAD_REQUEST, f"{name}: {text!r} is not a number") from error
    if not abs(value) < 1e15:
        raise RequestError(HTTPStatus.BAD_REQUEST, f"{name}: {text!r} is out of range")
    return value


def _whole(query: dict[str, str], name: str, default: int) -> int:
    text = query.get(name)
    if text is None:
        return default
    if not text.isascii() or not text.isdigit() or len(text) > 9:
        raise RequestError(HTTPStatus.BAD_REQUEST, f"{name}: {text[:40]!r} is not a whole number")
    return int(text)
