"""Camera position: fixed, or from the MAVLink telemetry of a vehicle."""

from __future__ import annotations

import contextlib
import logging
import math
import socket
import threading
import time
from dataclasses import dataclass, replace
from typing import Protocol

from fractus_runtime.backoff import Backoff
from fractus_runtime.mavlink_codec import Endpoint, Message, message_id
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_world.optics import Mount, Pose

log = logging.getLogger(__name__)

STALE_S = 2.0
CONNECT_TIMEOUT_S = 3.0
READ_TIMEOUT_S = 0.5
SILENCE_S = 5.0
"""Time without a message after which the link is reopened, in seconds."""

FIRST_RETRY_S = 0.2
MAX_RETRY_S = 3.0
REQUEST_INTERVAL_S = 5.0
SYSTEM = 242
COMPONENT = mavlink.MAV_COMP_ID_CAMERA
"""MAVLink component id. The camera sends no heartbeats, because they could delay a failsafe of the autopilot."""
_STREAMS = {"GLOBAL_POSITION_INT": 20.0, "ATTITUDE": 20.0, "GIMBAL_DEVICE_ATTITUDE_STATUS": 10.0}


@dataclass(frozen=True, slots=True)
class CameraPose:
    """Current position of the camera.

    Attributes:
        pose: Pose of the airframe.
        ground_amsl_m: Altitude of the ground above mean sea level.
        mount: Attitude reported by a gimbal. None without gimbal.
    """

    pose: Pose
    ground_amsl_m: float = 0.0
    mount: Mount | None = None


class PoseProvider(Protocol):
    """Provides the camera position."""

    def now(self) -> CameraPose | None:
        """Return the position, or None if it is unknown."""


@dataclass(frozen=True, slots=True)
class FixedPose:
    """A camera on a mast."""

    pose: Pose
    ground_amsl_m: float = 0.0

    def now(self) -> CameraPose | None:
        """Return the fixed position."""
        return CameraPose(self.pose, self.ground_amsl_m)


@dataclass(slots=True)
class _Telemetry:
    position: Message | None = None
    position_s: float = -math.inf
    attitude: Message | None = None
    attitude_s: float = -math.inf
    mount: Mount | None = None
    mount_s: float = -math.inf


class VehiclePose:
    """Position and attitude of a vehicle, received in a thread. The link is reopened after a failure.

    Args:
        address: Host and port of the autopilot's TCP server.
        ground_amsl_m: Altitude of the ground. None: altitude of the vehicle's home.
    """

    def __init__(self, address: tuple[str, int], ground_amsl_m: float | None = None) -> None:
        self._address = address
        self._ground_amsl_m = ground_amsl_m
        self._telemetry = _Telemetry()
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="vehicle", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread within a few seconds."""
        self._stop.set()
        self._thread.join(CONNECT_TIMEOUT_S + 2 * READ_TIMEOUT_S)

    def now(self) -> CameraPose | None:
        """Return the last position, extrapolated with its speed.

        Return None if position or attitude are older than two seconds.
        """
        with self._lock:
            latest = replace(self._telemetry)
        now_s = time.monotonic()
        if latest.position is None or latest.attitude is None:
            return None
        if now_s - min(latest.position_s, latest.attitude_s) > STALE_S:
            return None
        mount = latest.mount if now_s - latest.mount_s < STALE_S else None
        ground_m = self._ground_amsl_m
        if ground_m is None:
            ground_m = (latest.position.real("alt") - latest.position.real("relative_alt")) / 1000.0
        return CameraPose(_pose(latest.position, latest.attitude, now_s - latest.position_s, ground_m), ground_m, mount)

    def _run(self) -> None:
        backoff = Backoff(FIRST_RETRY_S, MAX_RETRY_S)
        while not self._stop.is_set():
            try:
                with socket.create_connection(self._address, timeout=CONNECT_TIMEOUT_S) as link:
                    log.info("camera world: connected to the vehicle (address=%s:%d)", *self._address)
                    if self._follow(link):
                        backoff.succeeded()
            except OSError as error:
                log.info("camera world: cannot connect to the vehicle (address=%s:%d error=%s)", *self._address, error)
            self._stop.wait(backoff.delay_s())

    def _follow(self, link: socket.socket) -> bool:
        """Receive until the link fails. Return True if a message was received."""
        link.settimeout(READ_TIMEOUT_S)
        endpoint = Endpoint(SYSTEM, COMPONENT)
        autopilot: tuple[int, int] | None = None
        requested_s = -math.inf
        opened_s = time.monotonic()
        received_s = opened_s
        while not self._stop.is_set():
            data = None
            with contextlib.suppress(TimeoutError):
                data = link.recv(65536)
            now_s = time.monotonic()
            if data == b"" or now_s - received_s > SILENCE_S:
                break
            for message in endpoint.decode(data or b""):
                received_s = now_s
                if (
                    message.name == "HEARTBEAT"
                    and message.integer("autopilot") != mavlink.MAV_AUTOPILOT_INVALID
                    and autopilot is None
                ):
                    autopilot = (message.sysid, message.compid)
                if autopilot is not None and message.sysid == autopilot[0]:
                    self._store(message, now_s)
            if autopilot is not None and now_s - requested_s > REQUEST_INTERVAL_S:
                requested_s = now_s
                _request_streams(link, endpoint, autopilot)
        return received_s > opened_s

    def _store(self, message: Message, now_s: float) -> None:
        with self._lock:
            if message.name == "GLOBAL_POSITION_INT":
                # An autopilot without a fix reports zeros.
                if message.integer("lat") != 0 or message.integer("lon") != 0:
                    self._telemetry.position = message
                    self._telemetry.position_s = now_s
            elif message.name == "ATTITUDE":
                self._telemetry.attitude = message
                self._telemetry.attitude_s = now_s
            elif message.name == "GIMBAL_DEVICE_ATTITUDE_STATUS":
                self._telemetry.mount = _gimbal(message, self._telemetry.attitude)
                self._telemetry.mount_s = now_s


def _request_streams(link: socket.socket, endpoint: Endpoint, autopilot: tuple[int, int]) -> None:
    """Request the streams. The request is repeated, because a restart of the autopilot removes them."""
    for name, rate_hz in _STREAMS.items():
        values = {
            "target_system": autopilot[0],
            "target_component": autopilot[1],
            "command": mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
            "param1": message_id(name),
            "param2": 1e6 / rate_hz,
        }
        link.sendall(endpoint.encode("COMMAND_LONG", values))


def _pose(position: Message, attitude: Message, age_s: float, ground_amsl_m: float) -> Pose:
    """Return the pose, extrapolated by the age of the position."""
    north = position.real("vx") / 100.0 * age_s
    east = position.real("vy") / 100.0 * age_s
    lat = position.real("lat") * 1e-7
    shrink = max(math.cos(math.radians(lat)), 0.01)
    lon = position.real("lon") * 1e-7 + math.degrees(east / 6_378_137.0) / shrink
    above_m = position.real("alt") / 1000.0 - ground_amsl_m
    return Pose(
        min(max(lat + math.degrees(north / 6_371_000.0), -90.0), 90.0),
        (lon + 180.0) % 360.0 - 180.0,
        min(above_m - position.real("vz") / 100.0 * age_s, 50_000.0),
        math.degrees(attitude.real("roll")),
        math.degrees(attitude.real("pitch")),
        math.degrees(attitude.real("yaw")),
    )


def _gimbal(message: Message, attitude: Message | None) -> Mount | None:
    """Return the camera attitude that a gimbal reports. Return None if the length of its quaternion is not about 1."""
    w, x, y, z = (float(part) for part in message.array("q") if not isinstance(part, bytes))
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not 0.5 < norm < 2.0:
        return None
    pitch = math.degrees(math.asin(min(max(2 * (w * y - z * x) / norm**2, -1.0), 1.0)))
    yaw = math.degrees(math.atan2(2 * (w * z + x * y), norm**2 - 2 * (y * y + z * z)))
    flags = message.integer("flags")
    lock = flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK
    vehicle = flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME
    earth = flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME or (lock and not vehicle)
    if earth and attitude is not None:
        yaw -= math.degrees(attitude.real("yaw"))
    return Mount(pitch, (yaw + 180.0) % 360.0 - 180.0, stabilised=True)


def parse_address(text: str) -> tuple[str, int]:
    """Parse `tcp:HOST:PORT`.

    Raises:
        ValueError: The text has a different format.
    """
    kind, _, rest = text.partition(":")
    host, _, port = rest.rpartition(":")
    if kind != "tcp" or not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise ValueError(f"vehicle: {text!r} is not tcp:HOST:PORT, such as tcp:127.0.0.1:5762")
    return host.strip("[]"), int(port)
