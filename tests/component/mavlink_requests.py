"""Random MAVLink messages that move a drone, in all frames and masks, as requests of the oracle.

Each message passes through a connection of the gateway and the conversion of the mobility service. The resulting request
is compared with the meaning of the message, which this module derives on its own from the definition of the message, on
the flat Earth of the oracle.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from fractus_core.policy.decision_types import Call, GotoArgs, SetSpeedArgs, Situation, VelocityArgs
from fractus_runtime.mavlink_codec import Endpoint, Parser, Value
from fractus_services.gateway.missions import MissionLists
from fractus_services.gateway.parameters import ParameterView
from fractus_services.gateway.session import Session
from fractus_services.gateway.virtual_vehicle import VirtualVehicle
from fractus_services.mobility.rpc.proto_conversion import goto_args, velocity_args
from policy_flights import EAST_M, NORTH_M, Scene
from policy_world import HOME
from pymavlink.dialects.v20 import ardupilotmega as mavlink

FRAMES = tuple(range(22))
AMSL = frozenset({0, 5})
RELATIVE = frozenset({3, 6})
BODY = frozenset({8, 9})
OFFSET = frozenset({7, 8, 9})
LOCAL = frozenset({1, 7, 8, 9})
"""Values of MAV_FRAME by the meaning of their coordinates."""

POSITION = 0b111
VELOCITY = 0b111000
ORIGIN_M = (6.0, -4.0, 97.0)
"""Origin of MAV_FRAME_LOCAL_NED: metres east and north of home, and above mean sea level."""

UNUSUAL = (math.nan, math.inf, -math.inf, 1e30, -1e30)
TOLERANCE_M = 0.15
"""Difference between the flat Earth of the oracle and the local frame of the gateway, and resolution of positions."""

SPEED_TOLERANCE_MPS = 1e-3

Target = tuple[float, float, float]


@dataclass(frozen=True)
class Meaning:
    """Meaning of a message: a target in metres east, north and above home, or a velocity north, east and down, or a speed."""

    target: Target | None = None
    velocity: Target | None = None
    speed_mps: float | None = None


@dataclass(frozen=True)
class Sent:
    """A message and its meaning; None if it must be refused."""

    name: str
    values: Mapping[str, Value]
    meaning: Meaning | None


class MavlinkRequests:
    """Source of requests for the oracle.

    Attributes:
        wrong: Messages whose request differs from their meaning.
        messages: Number of messages.
        refused: Number of messages that the gateway refused.
    """

    def __init__(self) -> None:
        self.wrong: list[str] = []
        self.messages = 0
        self.refused = 0
        self._now = 100.0
        self._program = Endpoint(255, 190)
        self._drone = Endpoint(1, 1)
        self._parser = Parser()

    def request(self, rng: np.random.Generator, place: Scene, now: Situation) -> Call | None:
        """Send a random message to a connection of a drone. Return the request, or None if the message was refused."""
        heading_deg = float(rng.uniform(0, 360))
        vehicle = self._vehicle(now, heading_deg)
        sent = _message(rng, place, _pose(vehicle, self._now), math.radians(heading_deg))
        session = Session(vehicle, ParameterView(), MissionLists(vehicle))
        calls = session.receive(self._program.encode(sent.name, sent.values), self._now)
        self.messages += 1
        requests = [call.request for call in calls]
        converted = [_call(request.method, request.message) for request in requests]
        problem = _difference(sent.meaning, converted)
        if problem:
            self.wrong.append(f"{problem}: {sent} -> {converted}, heading {heading_deg:.1f}")
        if not converted:
            self.refused += 1
            return None
        return converted[0]

    def _vehicle(self, now: Situation, heading_deg: float) -> VirtualVehicle:
        """Return the vehicle as the gateway sees it: messages with the resolution of MAVLink."""
        assert now.lat is not None
        assert now.lon is not None
        self._now += 0.1
        vehicle = VirtualVehicle(granted=True)
        position: dict[str, Value] = {
            "lat": round(now.lat * 1e7),
            "lon": round(now.lon * 1e7),
            "alt": round((now.altitude_m + HOME.amsl_m) * 1e3),
            "relative_alt": round(now.altitude_m * 1e3),
            "hdg": round(heading_deg * 100) % 36_000,
        }
        lat, lon = _geographic(ORIGIN_M[0], ORIGIN_M[1])
        origin: dict[str, Value] = {
            "latitude": round(lat * 1e7),
            "longitude": round(lon * 1e7),
            "altitude": round(ORIGIN_M[2] * 1e3),
        }
        for name, values in (("GLOBAL_POSITION_INT", position), ("GPS_GLOBAL_ORIGIN", origin)):
            for message in self._parser.feed(self._drone.encode(name, values)):
                vehicle.take(message, self._now)
        return vehicle


def _pose(vehicle: VirtualVehicle, now: float) -> Target:
    """Return the position that the gateway knows, in metres east, north and above home."""
    pose = vehicle.pose(now)
    assert pose is not None
    return (pose.lon - HOME.lon) * EAST_M, (pose.lat - HOME.lat) * NORTH_M, pose.altitude_m


def _geographic(east_m: float, north_m: float) -> tuple[float, float]:
    return HOME.lat + north_m / NORTH_M, HOME.lon + east_m / EAST_M


def _single(number: float) -> float:
    """Return a number as a MAVLink float contains it."""
    try:
        return float(struct.unpack("<f", struct.pack("<f", number))[0])
    except OverflowError:
        return math.copysign(math.inf, number)


def _message(rng: np.random.Generator, place: Scene, here: Target, heading: float) -> Sent:
    builders = (_local_target, _local_target, _global_target, _global_target, _item, _reposition, _speed)
    return builders[int(rng.integers(len(builders)))](rng, place, here, heading)


def _local_target(rng: np.random.Generator, place: Scene, here: Target, heading: float) -> Sent:
    frame = _frame(rng, sorted(LOCAL))
    mask, masked = _mask(rng)
    offset = frame in OFFSET
    x, y, z = _coordinates(rng, place, here if offset else (0.0, 0.0, 0.0))
    north, east, down = _single(y), _single(x), _single(-z)
    values, velocity = _motion(rng, frame in BODY, heading)
    values |= {"coordinate_frame": frame, "type_mask": mask, "x": north, "y": east, "z": down}
    meaning = None
    if frame in LOCAL and _has_yaw(mask, values):
        if masked == "position" and all(map(math.isfinite, (north, east, down))) and math.hypot(north, east) < 50_000:
            if frame in BODY:
                north, east = _turned(north, east, heading)
            start = here if offset else (ORIGIN_M[0], ORIGIN_M[1], ORIGIN_M[2] - HOME.amsl_m)
            meaning = Meaning(target=(start[0] + east, start[1] + north, start[2] - down))
        elif masked == "velocity" and velocity is not None:
            meaning = Meaning(velocity=velocity)
    return Sent("SET_POSITION_TARGET_LOCAL_NED", values, meaning)


def _global_target(rng: np.random.Generator, place: Scene, _here: Target, _heading: float) -> Sent:
    frame = _frame(rng, sorted(AMSL | RELATIVE))
    mask, masked = _mask(rng)
    x, y, z = _coordinates(rng, place, (0.0, 0.0, 0.0))
    lat_e7, lon_e7, outside = _degrees(rng, x, y)
    altitude_m = _single(z + (HOME.amsl_m if frame in AMSL else 0.0))
    values, velocity = _motion(rng, turned=False, heading=0.0)
    values |= {"coordinate_frame": frame, "type_mask": mask, "lat_int": lat_e7, "lon_int": lon_e7, "alt": altitude_m}
    meaning = None
    if _has_yaw(mask, values):
        if masked == "position" and not outside:
            meaning = _place(frame, lat_e7, lon_e7, altitude_m)
        elif masked == "velocity" and velocity is not None:
            # The velocity is relative to north in every frame, as in ArduCopter.
            meaning = Meaning(velocity=velocity)
    return Sent("SET_POSITION_TARGET_GLOBAL_INT", values, meaning)


def _item(rng: np.random.Generator, place: Scene, here: Target, _heading: float) -> Sent:
    """Return a guided MISSION_ITEM: a target (current 2), or an altitude at the present position (current 3)."""
    frame = _frame(rng, sorted(AMSL | RELATIVE))
    current = int(rng.choice([2, 2, 2, 3, 0, 1, 4]))
    x, y, z = _coordinates(rng, place, (0.0, 0.0, 0.0))
    lat_e7, lon_e7, outside = _degrees(rng, x, y)
    altitude_m = _single(z + (HOME.amsl_m if frame in AMSL else 0.0))
    integers = bool(rng.random() < 0.5)
    command = 16 if rng.random() < 0.9 else int(rng.integers(100))
    values: dict[str, Value] = {"frame": frame, "current": current, "command": command, "z": altitude_m}
    if integers:
        values |= {"x": lat_e7, "y": lon_e7}
    else:
        lat, lon = _single(lat_e7 / 1e7), _single(lon_e7 / 1e7)
        if rng.random() < 0.1:
            lat = float(rng.choice(UNUSUAL))
        lat_e7, lon_e7 = (round(v * 1e7) if math.isfinite(v) else 2**31 for v in (_single(lat), lon))
        outside = abs(lat_e7) > 900_000_000 or abs(lon_e7) > 1_800_000_000
        values |= {"x": lat, "y": lon}
    meaning = None
    if command == 16 and current == 2 and not outside:
        meaning = _place(frame, lat_e7, lon_e7, altitude_m)
    elif command == 16 and current == 3:
        placed = _place(frame, 0, 0, altitude_m)
        if placed is not None and placed.target is not None:
            meaning = Meaning(target=(here[0], here[1], placed.target[2]))
    return Sent("MISSION_ITEM_INT" if integers else "MISSION_ITEM", values, meaning)


def _reposition(rng: np.random.Generator, place: Scene, _here: Target, _heading: float) -> Sent:
    frame = _frame(rng, sorted(AMSL | RELATIVE))
    x, y, z = _coordinates(rng, place, (0.0, 0.0, 0.0))
    lat_e7, lon_e7, outside = _degrees(rng, x, y)
    altitude_m = _single(z + (HOME.amsl_m if frame in AMSL else 0.0))
    speed_mps = float(rng.choice([-1.0, 0.0, 3.0, 9.0, math.nan]))
    values: dict[str, Value] = {"frame": frame, "command": mavlink.MAV_CMD_DO_REPOSITION, "param1": speed_mps}
    values |= {"x": lat_e7, "y": lon_e7, "z": altitude_m}
    meaning = None if outside else _place(frame, lat_e7, lon_e7, altitude_m)
    if meaning is not None and speed_mps > 0.0:
        meaning = Meaning(target=meaning.target, speed_mps=speed_mps)
    return Sent("COMMAND_INT", values, meaning)


def _speed(rng: np.random.Generator, _place: Scene, _here: Target, _heading: float) -> Sent:
    speed_mps = _single(float(rng.uniform(0.5, 14)) if rng.random() < 0.7 else float(rng.choice([*UNUSUAL, 0.0, -3.0])))
    kind = float(rng.choice([0.0, 1.0, 1.0, 2.0, math.nan]))
    values: dict[str, Value] = {"command": mavlink.MAV_CMD_DO_CHANGE_SPEED, "param1": kind, "param2": speed_mps}
    good = kind in {0.0, 1.0} and math.isfinite(speed_mps) and speed_mps > 0.0
    return Sent("COMMAND_LONG", values, Meaning(speed_mps=speed_mps) if good else None)


def _frame(rng: np.random.Generator, usual: list[int]) -> int:
    return int(rng.choice(usual)) if rng.random() < 0.85 else int(rng.choice(FRAMES))


def _coordinates(rng: np.random.Generator, place: Scene, start: Target) -> Target:
    """Return coordinates near home relative to a start, in metres east, north and up. Some are no usable numbers."""
    altitude_m = place.altitude_near_edge(rng) if rng.random() < 0.4 else None
    if altitude_m is None:
        altitude_m = float(rng.uniform(1, 60))
    east, north = (float(v) for v in rng.uniform(-85, 85, 2))
    point = [east - start[0], north - start[1], altitude_m - start[2]]
    if rng.random() < 0.08:
        point[int(rng.integers(3))] = float(rng.choice(UNUSUAL))
    return point[0], point[1], point[2]


def _degrees(rng: np.random.Generator, x: float, y: float) -> tuple[int, int, bool]:
    """Return latitude and longitude in 1e-7 degrees, and True if they are out of range."""
    if not (math.isfinite(x) and math.isfinite(y)) or abs(x) > 1e6 or abs(y) > 1e6:
        return int(rng.choice([900_000_001, -2_000_000_000])), 0, True
    lat, lon = _geographic(x, y)
    return round(lat * 1e7), round(lon * 1e7), False


def _place(frame: int, lat_e7: int, lon_e7: int, altitude_m: float) -> Meaning | None:
    if frame not in AMSL | RELATIVE or not math.isfinite(altitude_m):
        return None
    up_m = altitude_m - (HOME.amsl_m if frame in AMSL else 0.0)
    return Meaning(target=((lon_e7 / 1e7 - HOME.lon) * EAST_M, (lat_e7 / 1e7 - HOME.lat) * NORTH_M, up_m))


def _mask(rng: np.random.Generator) -> tuple[int, str]:
    """Return a type_mask, and what it selects: position, velocity, or an empty string for neither."""
    mask = (
        int(rng.choice([VELOCITY, POSITION, 0, POSITION | VELOCITY])) if rng.random() < 0.85 else int(rng.integers(64))
    )
    mask |= int(rng.choice([0b111000000, 0, int(rng.integers(8)) << 6]))
    mask |= int(rng.choice([0b110000000000, 0b110000000000, 0b010000000000, 0b100000000000, 0]))
    if not mask & POSITION:
        return mask, "position"
    if mask & POSITION == POSITION and not mask & VELOCITY:
        return mask, "velocity"
    return mask, ""


def _motion(rng: np.random.Generator, turned: bool, heading: float) -> tuple[dict[str, Value], Target | None]:
    """Return the fields of velocity, acceleration and yaw, and the velocity north, east and down; None if one is not a number."""
    forward, right = (_single(float(v)) for v in rng.uniform(-9, 9, 2))
    down = _single(float(rng.uniform(-2.5, 2.0))) if rng.random() < 0.5 else 0.0
    if rng.random() < 0.08:
        right = float(rng.choice([math.nan, math.inf, -math.inf]))
    acceleration = float(rng.choice([0.0, 2.0, math.nan]))
    values: dict[str, Value] = {"vx": forward, "vy": right, "vz": down, "afx": acceleration, "afy": acceleration}
    values |= {
        "yaw": _single(float(rng.choice([0.0, 1.0, -3.0, math.nan]))),
        "yaw_rate": float(rng.choice([0.0, 0.0, 0.5, math.nan])),
    }
    if not all(map(math.isfinite, (forward, right, down))):
        return values, None
    north, east = _turned(forward, right, heading) if turned else (forward, right)
    return values, (north, east, down)


def _has_yaw(mask: int, values: Mapping[str, Value]) -> bool:
    """Return True unless the mask selects a yaw that is not a number, or a yaw rate."""
    yaw = values["yaw"]
    rate = values["yaw_rate"]
    assert isinstance(yaw, float)
    return bool(mask & 1024 or math.isfinite(yaw)) and bool(mask & 2048 or rate == 0.0)


def _turned(forward: float, right: float, heading: float) -> tuple[float, float]:
    """Return north and east of a vector relative to a heading in radians."""
    vector = complex(forward, right) * complex(math.cos(heading), math.sin(heading))
    return vector.real, vector.imag


def _call(method: str, message: object) -> Call:
    """Return the call as the mobility service converts it from the request of the gateway."""
    match method:
        case "Goto":
            return Call("Goto", goto_args(message))  # type: ignore[arg-type]
        case "SetVelocity":
            return Call("SetVelocity", velocity_args(message))  # type: ignore[arg-type]
        case "SetSpeed":
            return Call("SetSpeed", SetSpeedArgs(message.speed_mps))  # type: ignore[attr-defined]
        case _:
            raise AssertionError(method)


def _difference(meaning: Meaning | None, calls: list[Call]) -> str:
    """Return how calls differ from the meaning of their message, or an empty string."""
    if meaning is None:
        return "a message without meaning is translated" if calls else ""
    if len(calls) != 1:
        return "a message with a meaning is refused"
    args = calls[0].args
    same = False
    if isinstance(args, GotoArgs) and meaning.target is not None and args.alt is not None:
        up_m = args.alt - (HOME.amsl_m if args.reference == "amsl" else 0.0)
        flown = ((args.lon - HOME.lon) * EAST_M, (args.lat - HOME.lat) * NORTH_M, up_m)
        same = math.dist(flown, meaning.target) < TOLERANCE_M and args.speed_mps == meaning.speed_mps
    elif isinstance(args, VelocityArgs) and meaning.velocity is not None:
        velocity = (args.north_mps, args.east_mps, args.down_mps)
        same = math.dist(velocity, meaning.velocity) < SPEED_TOLERANCE_MPS
    elif isinstance(args, SetSpeedArgs) and meaning.target is None and meaning.speed_mps is not None:
        same = abs(args.speed_mps - meaning.speed_mps) < SPEED_TOLERANCE_MPS
    return "" if same else "another request"
