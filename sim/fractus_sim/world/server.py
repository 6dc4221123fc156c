"""The simulated world as an IP camera: pictures, what they show, and a map, over HTTP."""

from __future__ import annotations

import json
import logging
import socket
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import cv2

from fractus_sim.world.optics import Intrinsics, Mount, Pose
from fractus_sim.world.render import Band
from fractus_sim.world.survey import Sheet
from fractus_sim.world.whereabouts import Whereabouts
from fractus_sim.world.world import World, WorldAround

log = logging.getLogger(__name__)

MAX_CLIENTS = 32
CLIENT_TIMEOUT_S = 10.0
CLIENT_LIFE_S = 30.0
RENDER_WAIT_S = 5.0
MAX_WAITING = 8
MAX_SNAPSHOT_PX = 16_000_000
KEPT_SNAPSHOTS = 64
JPEG_QUALITY = 90
_NO_POSE = "the vehicle has not told its position; is it switched on, and has it a GPS fix?"


class Refused(Exception):
    """A request that gets no answer but a reason.

    Args:
        status: HTTP status.
        reason: One sentence.
    """

    def __init__(self, status: HTTPStatus, reason: str) -> None:
        super().__init__(reason)
        self.status = status


@dataclass(frozen=True, slots=True)
class Snapshot:
    """All that a picture depended on."""

    number: int
    pose: Pose
    mount: Mount
    intrinsics: Intrinsics
    time_s: float
    band: Band


@dataclass(frozen=True, slots=True)
class Answer:
    """A response's body and headers."""

    content_type: str
    body: bytes
    headers: tuple[tuple[str, str], ...] = ()


class Studio:
    """Answers requests; knows nothing of sockets.

    Args:
        world: What there is to see.
        whereabouts: Tells where the camera is.
        intrinsics: The camera's own lens and resolution.
        mount: How it sits on the airframe, unless a gimbal reports.
        now: Unix seconds, for what moves.
    """

    def __init__(
        self,
        world: WorldAround,
        whereabouts: Whereabouts,
        intrinsics: Intrinsics,
        mount: Mount,
        now: Callable[[], float],
    ) -> None:
        self._world = world
        self._whereabouts = whereabouts
        self._intrinsics = intrinsics
        self._mount = mount
        self._now = now
        self._snapshots: OrderedDict[int, Snapshot] = OrderedDict()
        self._count = 0
        self._lock = threading.Lock()
        self._busy = threading.Lock()
        self._waiting = threading.BoundedSemaphore(MAX_WAITING)

    def answer(self, path: str, query: dict[str, str]) -> Answer:
        """The answer to a GET request.

        Raises:
            Refused: There is no such page, a parameter is wrong, or there is nothing to show now.
        """
        pages: dict[str, Callable[[dict[str, str]], Answer]] = {
            "/": self._index,
            "/snapshot.jpg": self._snapshot,
            "/truth.json": self._truth,
            "/orthophoto.png": self._orthophoto,
            "/orthophoto.pgw": self._world_file,
        }
        page = pages.get(path)
        if page is None:
            raise Refused(HTTPStatus.NOT_FOUND, f"there is no {path}; there are {', '.join(pages)}")
        try:
            return page(query)
        except ValueError as error:
            raise Refused(HTTPStatus.BAD_REQUEST, str(error)) from error

    def _index(self, query: dict[str, str]) -> Answer:
        _only(query)
        return Answer("text/html; charset=utf-8", resources.files(__package__).joinpath("index.html").read_bytes())

    def _snapshot(self, query: dict[str, str]) -> Answer:
        _only(query, "width", "height", "band", "time")
        band = query.get("band", "rgb")
        if band not in ("rgb", "ir"):
            raise Refused(HTTPStatus.BAD_REQUEST, f"band: {band[:20]!r} is neither rgb nor ir")
        width = _whole(query, "width", self._intrinsics.width)
        height = _whole(query, "height", self._intrinsics.height)
        lens = Intrinsics(width, height, self._intrinsics.horizontal_fov_deg)
        if width * height > MAX_SNAPSHOT_PX:
            raise Refused(HTTPStatus.BAD_REQUEST, f"width and height: more than {MAX_SNAPSHOT_PX:,} pixels")
        time_s = _number(query, "time", self._now())
        sighting = self._whereabouts.now()
        if sighting is None:
            raise Refused(HTTPStatus.SERVICE_UNAVAILABLE, _NO_POSE)
        snapshot = self._noted(
            sighting.pose, sighting.mount or self._mount, lens, time_s, "ir" if band == "ir" else "rgb"
        )
        with _Turn(self._waiting, self._busy):
            picture = self._seen(snapshot.pose).render(
                snapshot.pose, lens, mount=snapshot.mount, time_s=snapshot.time_s, band=snapshot.band
            )
        done, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if not done:
            raise Refused(HTTPStatus.INTERNAL_SERVER_ERROR, "the picture cannot be encoded")
        headers = (("X-Fractus-Snapshot", str(snapshot.number)), ("X-Fractus-Time", f"{snapshot.time_s:.3f}"))
        return Answer("image/jpeg", encoded.tobytes(), headers)

    def _sighted(self) -> Pose | None:
        sighting = self._whereabouts.now()
        return None if sighting is None else sighting.pose

    def _seen(self, pose: Pose | None) -> World:
        world = self._world.seen_from(pose)
        if world is None:
            raise Refused(HTTPStatus.SERVICE_UNAVAILABLE, _NO_POSE)
        return world

    def _noted(self, pose: Pose, mount: Mount, lens: Intrinsics, time_s: float, band: Band) -> Snapshot:
        with self._lock:
            self._count += 1
            snapshot = Snapshot(self._count, pose, mount, lens, time_s, band)
            self._snapshots[snapshot.number] = snapshot
            while len(self._snapshots) > KEPT_SNAPSHOTS:
                self._snapshots.popitem(last=False)
        return snapshot

    def _truth(self, query: dict[str, str]) -> Answer:
        _only(query, "snapshot")
        with self._lock:
            if not self._snapshots:
                raise Refused(HTTPStatus.NOT_FOUND, "no picture has been taken; ask for /snapshot.jpg first")
            number = _whole(query, "snapshot", next(reversed(self._snapshots)))
            snapshot = self._snapshots.get(number)
        if snapshot is None:
            raise Refused(HTTPStatus.NOT_FOUND, f"snapshot {number} is not one of the last {KEPT_SNAPSHOTS}")
        with _Turn(self._waiting, self._busy):
            truth = self._seen(snapshot.pose).truth(
                snapshot.pose, snapshot.intrinsics, mount=snapshot.mount, time_s=snapshot.time_s
            )
        content: dict[str, Any] = {"snapshot": snapshot.number, "time": snapshot.time_s, "band": snapshot.band}
        return Answer("application/json", json.dumps(content | truth.as_json()).encode())

    def _sheet(self, query: dict[str, str]) -> Sheet:
        _only(query, "lat", "lon", "metres", "pixels")
        frame = self._seen(self._sighted()).frame
        return Sheet(
            _number(query, "lat", frame.lat),
            _number(query, "lon", frame.lon),
            _number(query, "metres", 600.0),
            _whole(query, "pixels", 1024),
        )

    def _orthophoto(self, query: dict[str, str]) -> Answer:
        sheet = self._sheet(query)
        with _Turn(self._waiting, self._busy):
            picture = self._seen(None).map(sheet)
        done, encoded = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 3])
        if not done:
            raise Refused(HTTPStatus.INTERNAL_SERVER_ERROR, "the map cannot be encoded")
        return Answer("image/png", encoded.tobytes())

    def _world_file(self, query: dict[str, str]) -> Answer:
        return Answer("text/plain; charset=ascii", self._sheet(query).world_file().encode("ascii"))


class _Turn:
    """The right to render: one at a time, few wait, and none for long."""

    def __init__(self, waiting: threading.BoundedSemaphore, busy: threading.Lock) -> None:
        self._waiting, self._busy = waiting, busy

    def __enter__(self) -> None:
        if not self._waiting.acquire(blocking=False):
            raise Refused(HTTPStatus.SERVICE_UNAVAILABLE, "too many pictures are being asked for; try again")
        if not self._busy.acquire(timeout=RENDER_WAIT_S):
            self._waiting.release()
            raise Refused(HTTPStatus.SERVICE_UNAVAILABLE, "the pictures before this one take too long; try again")

    def __exit__(self, *_: object) -> None:
        self._busy.release()
        self._waiting.release()


def _only(query: dict[str, str], *known: str) -> None:
    for name in query:
        if name not in known:
            names = ", ".join(known) or "none"
            raise Refused(HTTPStatus.BAD_REQUEST, f"unknown parameter {name[:40]!r}; known are: {names}")


def _number(query: dict[str, str], name: str, default: float) -> float:
    text = query.get(name)
    try:
        value = default if text is None else float(text)
    except ValueError as error:
        raise Refused(HTTPStatus.BAD_REQUEST, f"{name}: {text!r} is not a number") from error
    if not abs(value) < 1e15:
        raise Refused(HTTPStatus.BAD_REQUEST, f"{name}: {text!r} is not a number that makes sense here")
    return value


def _whole(query: dict[str, str], name: str, default: int) -> int:
    text = query.get(name)
    if text is None:
        return default
    if not text.isascii() or not text.isdigit() or len(text) > 9:
        raise Refused(HTTPStatus.BAD_REQUEST, f"{name}: {text[:40]!r} is not a whole number")
    return int(text)


class _Handler(BaseHTTPRequestHandler):
    """One request a connection, so that an idle client holds nothing."""

    server: CameraServer
    server_version = "fractus-camera-world"
    sys_version = ""
    timeout = CLIENT_TIMEOUT_S

    def do_GET(self) -> None:
        parts = urlsplit(self.path)
        try:
            answer = self.server.studio.answer(parts.path, dict(parse_qsl(parts.query, max_num_fields=16)))
        except Refused as refusal:
            self._send(refusal.status, Answer("text/plain; charset=utf-8", f"{refusal}\n".encode()))
        except ValueError as error:
            self._send(HTTPStatus.BAD_REQUEST, Answer("text/plain; charset=utf-8", f"query: {error}\n".encode()))
        else:
            self._send(HTTPStatus.OK, answer)

    def _send(self, status: HTTPStatus, answer: Answer) -> None:
        try:
            self.send_response(status)
            self.send_header("Content-Type", answer.content_type)
            self.send_header("Content-Length", str(len(answer.body)))
            self.send_header("Cache-Control", "no-store")
            for name, value in answer.headers:
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(answer.body)
        except OSError as error:
            log.debug("a client went away: %s", error)
            self.close_connection = True

    def log_message(self, format: str, *args: object) -> None:
        log.debug("%s %s", self.client_address[0], format % args)


class CameraServer(ThreadingHTTPServer):
    """Serves a studio to a limited number of clients, each for a limited time.

    Args:
        address: Host and port to listen on; port 0 takes a free one.
        studio: Answers the requests.
    """

    daemon_threads = True
    request_queue_size = 64
    allow_reuse_address = True

    def __init__(self, address: tuple[str, int], studio: Studio) -> None:
        if ":" in address[0]:
            self.address_family = socket.AF_INET6
        self.studio = studio
        self._clients: dict[socket.socket, float] = {}
        self._lock = threading.Lock()
        super().__init__(address, _Handler)

    @property
    def port(self) -> int:
        """The port it listens on."""
        return int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a client in a thread of its own, or close the connection when there are too many."""
        with self._lock:
            full = len(self._clients) >= MAX_CLIENTS
            if not full:
                self._clients[request] = time.monotonic()
        if full:
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._lock:
            self._clients.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Cut off clients that have been connected for too long."""
        now_s = time.monotonic()
        with self._lock:
            old = [client for client, since_s in self._clients.items() if now_s - since_s > CLIENT_LIFE_S]
        for client in old:
            try:
                client.shutdown(socket.SHUT_RDWR)
            except OSError as error:
                log.debug("a slow client is gone already: %s", error)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Note what went wrong with one client; the others are not concerned."""
        log.warning("request of %s failed", client_address, exc_info=True)
