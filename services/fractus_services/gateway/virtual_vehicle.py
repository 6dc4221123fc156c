"""The vehicle as a program sees it: virtual mode, and the latest messages of the real vehicle."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from fractus_runtime.mavlink_codec import Message, Value
from pymavlink.dialects.v20 import ardupilotmega as mavlink

SILENT_S = 3.0
"""Age of the vehicle's last HEARTBEAT above which programs receive no heartbeats."""

MAX_POSITION_AGE_S = 1.0
"""Age above which a position counts as unknown."""

DESCENTS = frozenset({mavlink.COPTER_MODE_RTL, mavlink.COPTER_MODE_LAND})
"""Virtual modes that end when the vehicle has landed."""


@dataclass(frozen=True, slots=True)
class Pose:
    """Position and heading: degrees, and metres above home and above mean sea level."""

    lat: float
    lon: float
    altitude_m: float
    amsl_m: float
    heading_deg: float


@dataclass(slots=True)
class VirtualVehicle:
    """State of the vehicle for the sessions of one instance. Times are monotonic seconds.

    Attributes:
        granted: True while the instance may command the drone.
        waiting_reason: Reason why control is not granted.
        flying_mode: Mode of the motion that the instance requested: GUIDED, AUTO, BRAKE, RTL or LAND.
        target: Latest target of a Goto: latitude, longitude in degrees, and metres above home.
        latest: Latest message of the vehicle by name.
        received_at: Time of arrival of the latest messages.
        flown: True if the vehicle was armed while the instance had control.
    """

    granted: bool = False
    waiting_reason: str = "the drone is not connected yet"
    flying_mode: int = mavlink.COPTER_MODE_GUIDED
    target: tuple[float, float, float] | None = None
    latest: dict[str, Message] = field(default_factory=dict)
    received_at: dict[str, float] = field(default_factory=dict)
    flown: bool = False

    def take(self, message: Message, now: float) -> None:
        """Store a message of the vehicle."""
        was_armed = self.armed
        self.latest[message.name] = message
        self.received_at[message.name] = now
        if message.name == "HEARTBEAT" and self.granted:
            if self.armed:
                self.flown = True
            elif self.flying_mode in DESCENTS or (was_armed and self.in_mission):
                self.flying_mode = mavlink.COPTER_MODE_GUIDED

    def connected(self, now: float) -> bool:
        """Return True while heartbeats of the vehicle arrive."""
        return now - self.received_at.get("HEARTBEAT", -math.inf) < SILENT_S

    @property
    def armed(self) -> bool:
        """True if the motors of the vehicle are armed."""
        heartbeat = self.latest.get("HEARTBEAT")
        return heartbeat is not None and bool(heartbeat.integer("base_mode") & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    @property
    def on_ground(self) -> bool:
        """True if the vehicle is disarmed, or reports that it stands on the ground."""
        state = self.latest.get("EXTENDED_SYS_STATE")
        reported = state is not None and state.integer("landed_state") == mavlink.MAV_LANDED_STATE_ON_GROUND
        return reported or not self.armed

    @property
    def in_mission(self) -> bool:
        """True in the virtual mode AUTO: the instance flies, has paused or has completed its mission."""
        return self.granted and self.flying_mode == mavlink.COPTER_MODE_AUTO

    @property
    def mode(self) -> int:
        """Custom mode that the program sees. It is never GUIDED while the instance has no control."""
        if self.granted:
            return self.flying_mode
        heartbeat = self.latest.get("HEARTBEAT")
        real = heartbeat.integer("custom_mode") if heartbeat is not None else mavlink.COPTER_MODE_BRAKE
        return mavlink.COPTER_MODE_BRAKE if real == mavlink.COPTER_MODE_GUIDED else real

    def heartbeat(self) -> Mapping[str, Value]:
        """Return the fields of the HEARTBEAT for programs."""
        heartbeat = self.latest.get("HEARTBEAT")
        status = heartbeat.integer("system_status") if heartbeat is not None else mavlink.MAV_STATE_BOOT
        base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
        if self.mode == mavlink.COPTER_MODE_GUIDED:
            base |= mavlink.MAV_MODE_FLAG_GUIDED_ENABLED
        if self.armed:
            base |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        return {
            "type": mavlink.MAV_TYPE_QUADROTOR,
            "autopilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
            "base_mode": base,
            "custom_mode": self.mode,
            "system_status": status,
            "mavlink_version": 3,
        }

    def pose(self, now: float) -> Pose | None:
        """Return the present position and heading; None if they are unknown or too old."""
        position = self.latest.get("GLOBAL_POSITION_INT")
        if position is None or now - self.received_at["GLOBAL_POSITION_INT"] > MAX_POSITION_AGE_S:
            return None
        heading = position.integer("hdg")
        return Pose(
            position.integer("lat") / 1e7,
            position.integer("lon") / 1e7,
            position.integer("relative_alt") / 1e3,
            position.integer("alt") / 1e3,
            heading / 100.0 if heading < 36_000 else 0.0,
        )

    @property
    def speed_mps(self) -> float:
        """Speed of the latest position report in m/s; 0 if there is none."""
        position = self.latest.get("GLOBAL_POSITION_INT")
        if position is None:
            return 0.0
        return math.hypot(*(position.integer(axis) for axis in ("vx", "vy", "vz"))) / 100.0

    def origin(self) -> tuple[float, float, float] | None:
        """Return latitude, longitude and altitude above sea level of the origin of MAV_FRAME_LOCAL_NED; None if unknown."""
        return self._place("GPS_GLOBAL_ORIGIN")

    def home(self) -> tuple[float, float, float] | None:
        """Return latitude, longitude and altitude above sea level of home; None if unknown."""
        return self._place("HOME_POSITION")

    def _place(self, name: str) -> tuple[float, float, float] | None:
        message = self.latest.get(name)
        if message is None:
            return None
        return message.integer("latitude") / 1e7, message.integer("longitude") / 1e7, message.integer("altitude") / 1e3
