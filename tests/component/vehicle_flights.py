"""Deterministic flights of the simulated vehicle and digests of their messages."""

from __future__ import annotations

import contextlib
import hashlib
import random
from collections.abc import Callable
from dataclasses import replace

from fractus_runtime.mavlink_codec import Message, Value, message_class
from fractus_vehicle.copter import SUPPORTED_MODES
from fractus_vehicle.simulation import Simulation
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_pilot import Pilot, PilotTimeoutError
from vehicle_world import CONFIG, START, upload

TARGET = {"target_system": 1, "target_component": 1}
GLOBAL_RELATIVE_ALT = 3
MISSION = 0
FENCE = 1
RALLY = 2


class RecordingPilot(Pilot):
    """A pilot that hashes the messages it receives.

    Floats are rounded before, because the last bit of a sine depends on the C library.
    """

    def __init__(self, simulation: Simulation) -> None:
        super().__init__(simulation, simulation.crafts[0])
        self.digest = hashlib.sha256()

    def read(self) -> list[Message]:
        messages = super().read()
        for message in messages:
            kind = message_class(message.name)
            lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
            values = [_hashed(value, lengths[name]) for name, value in message.values.items()]
            self.digest.update(f"{message.name}{values}".encode())
        return messages


def _hashed(value: Value, length: int) -> Value:
    """Return a value in the form used by the digests: rounded, and text padded with NULs to the field length."""
    if isinstance(value, bytes):
        return value.ljust(length, b"\0")
    return round(value, 3) + 0.0 if isinstance(value, float) else value


def pilot_of(seed: int, **parameters: float) -> RecordingPilot:
    """Return a pilot that receives every stream of a new vehicle at 10 Hz."""
    pilot = RecordingPilot(Simulation([replace(CONFIG, seed=seed, parameters=parameters)]))
    pilot.send("REQUEST_DATA_STREAM", TARGET | {"req_stream_id": 0, "req_message_rate": 10, "start_stop": 1})
    for number in (31, 83, 85, 87, 141, 245):  # messages that belong to no stream
        pilot.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, 200_000)
    return pilot


def _item(command: int, north: float = 0.0, east: float = 0.0, alt: float = 0.0, *params: float) -> dict[str, float]:
    place = START.offset(north, east) if north or east else replace(START, lat_e7=0, lon_e7=0)
    values = {f"param{at}": value for at, value in enumerate(params, start=1)}
    return values | {"command": command, "frame": GLOBAL_RELATIVE_ALT, "x": place.lat_e7, "y": place.lon_e7, "z": alt}


def _sticks(pilot: Pilot, roll: int = 1500, pitch: int = 1500, throttle: int = 1500, yaw: int = 1500) -> None:
    sticks = zip(range(1, 5), (roll, pitch, throttle, yaw), strict=True)
    pilot.send("RC_CHANNELS_OVERRIDE", TARGET | {f"chan{at}_raw": value for at, value in sticks})


def mission(pilot: Pilot) -> None:
    """AUTO with splines, a circle, delays, a jump, a yaw command and a landing item."""
    upload(
        pilot,
        MISSION,
        [
            _item(mavlink.MAV_CMD_NAV_WAYPOINT),
            _item(mavlink.MAV_CMD_NAV_TAKEOFF, alt=12.0),
            _item(mavlink.MAV_CMD_DO_CHANGE_SPEED, 0.0, 0.0, 0.0, 1.0, 6.0),
            _item(mavlink.MAV_CMD_NAV_WAYPOINT, 20.0, 0.0, 15.0),
            _item(mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT, 30.0, 15.0, 12.0),
            _item(mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT, 15.0, 25.0, 10.0, 1.0),
            _item(mavlink.MAV_CMD_DO_SET_ROI_LOCATION, 5.0, 5.0),
            _item(mavlink.MAV_CMD_NAV_LOITER_TURNS, 10.0, 10.0, 10.0, 1.0, 0.0, -8.0),
            _item(mavlink.MAV_CMD_CONDITION_YAW, 0.0, 0.0, 0.0, 90.0, 60.0, 1.0),
            _item(mavlink.MAV_CMD_DO_JUMP, 0.0, 0.0, 0.0, 7.0, 1.0),
            _item(mavlink.MAV_CMD_NAV_DELAY, 0.0, 0.0, 0.0, 2.0),
            _item(mavlink.MAV_CMD_NAV_LAND, 4.0, 2.0),
        ],
    )
    pilot.take_off(3.0)
    pilot.command(mavlink.MAV_CMD_MISSION_START)
    pilot.fly_on(20.0)
    pilot.command(mavlink.MAV_CMD_DO_PAUSE_CONTINUE, 0.0)
    pilot.fly_on(2.0)
    pilot.command(mavlink.MAV_CMD_DO_PAUSE_CONTINUE, 1.0)
    pilot.fly_on(60.0)


def by_hand(pilot: Pilot) -> None:
    """STABILIZE, ALT_HOLD, LOITER, BRAKE and LAND, flown with RC overrides in gusts."""
    pilot.mode(mavlink.COPTER_MODE_LOITER)
    pilot.fly_on(3.0)
    pilot.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
    pilot.fly_on(2.5)
    sticks = {
        mavlink.COPTER_MODE_LOITER: ((1500, 1500, 1900, 1500), (1600, 1300, 1500, 1700)),
        mavlink.COPTER_MODE_ALT_HOLD: ((1550, 1450, 1600, 1400), (1500, 1500, 1450, 1500)),
        mavlink.COPTER_MODE_STABILIZE: ((1520, 1480, 1560, 1500), (1500, 1500, 1540, 1600)),
        mavlink.COPTER_MODE_BRAKE: ((1500, 1500, 1500, 1500),),
        mavlink.COPTER_MODE_LAND: ((1500, 1500, 1500, 1500),),
    }
    for mode, positions in sticks.items():
        pilot.mode(mode)
        for position in positions:
            for _ in range(8):
                _sticks(pilot, *position)
                pilot.fly_on(0.5)
    pilot.fly_on(10.0)


def smart_return(pilot: Pilot) -> None:
    """SMART_RTL along a path with corners and a loop, and landing at the start."""
    pilot.parameter("RTL_ALT_FINAL", 0.0)
    pilot.take_off(8.0)
    for north, east in ((15.0, 0.0), (15.0, 15.0), (-3.0, 15.0), (-3.0, -8.0), (5.0, -8.0)):
        pilot.go_to(north, east, 10.0)
        pilot.fly_on(6.0)
    pilot.mode(mavlink.COPTER_MODE_SMART_RTL)
    pilot.wait(lambda: "Disarming motors" in pilot.texts, 90.0)


def breaches(pilot: Pilot) -> None:
    """Target outside the fence, fence breach by a velocity, return to a rally point, and position loss."""
    corners = ((-40.0, -40.0), (-40.0, 40.0), (40.0, 40.0), (40.0, -40.0))
    upload(pilot, FENCE, [_item(5001, north, east, 0.0, 4.0) for north, east in corners])
    upload(pilot, RALLY, [_item(mavlink.MAV_CMD_NAV_RALLY_POINT, 12.0, -6.0, 8.0)])
    pilot.parameter("FENCE_ENABLE", 1.0)
    pilot.take_off(10.0)
    pilot.go_to(60.0, 0.0, 10.0)  # the vehicle ignores a target outside its fence
    pilot.fly_on(3.0)
    for _ in range(6):
        pilot.send(
            "SET_POSITION_TARGET_LOCAL_NED",
            TARGET | {"coordinate_frame": 1, "type_mask": 0xDC7, "vx": 8.0, "vy": 1.0, "vz": -0.3},
        )
        pilot.fly_on(1.0)
    pilot.wait(lambda: "Polygon fence breached" in pilot.texts, 10.0)
    pilot.fly_on(15.0)
    pilot.parameter("SIM_GPS_DISABLE", 1.0)
    pilot.fly_on(9.0)
    pilot.parameter("SIM_GPS_DISABLE", 0.0)
    pilot.fly_on(20.0)


def failing(pilot: Pilot) -> None:
    """Consecutive failures of radio, ground station, battery and motor."""
    pilot.parameter("FS_GCS_ENABLE", 4.0)
    pilot.take_off(15.0)
    pilot.go_to(20.0, 10.0, 15.0)
    pilot.fly_on(5.0)
    pilot.parameter("SIM_RC_FAIL", 1.0)
    pilot.fly_on(4.0)
    pilot.parameter("SIM_RC_FAIL", 0.0)
    pilot.fly_on(2.0)
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    pilot.heartbeats = False
    pilot.fly_on(9.0)
    pilot.heartbeats = True
    pilot.fly_on(2.0)
    pilot.mode(mavlink.COPTER_MODE_GUIDED)
    pilot.parameter("BATT_LOW_TIMER", 1.0)
    pilot.parameter("BATT_FS_LOW_ACT", 2.0)
    pilot.parameter("SIM_BATT_VOLTAGE", 10.4)
    pilot.fly_on(6.0)
    pilot.parameter("SIM_ENGINE_MUL", 0.3)
    pilot.parameter("SIM_ENGINE_FAIL", 1.0)
    pilot.fly_on(12.0)


_RANDOM_ORDERS: tuple[Callable[[Pilot, random.Random], object], ...] = (
    lambda p, r: p.mode(r.choice(sorted(SUPPORTED_MODES))),
    lambda p, r: p.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, float(r.random() < 0.9)),
    lambda p, r: p.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, r.uniform(1.0, 20.0)),
    lambda p, r: p.go_to(r.uniform(-60.0, 60.0), r.uniform(-60.0, 60.0), r.uniform(2.0, 30.0)),
    lambda p, r: p.send(
        "SET_POSITION_TARGET_LOCAL_NED",
        TARGET
        | {"coordinate_frame": r.choice((1, 7, 8, 9)), "type_mask": r.choice((0xDF8, 0xDC7, 0xDC0, 0x9C7, 0xC3F, 0x5C7))}
        | {name: r.uniform(-8.0, 8.0) for name in ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz", "yaw")},
    ),
    lambda p, r: p.send(
        "SET_ATTITUDE_TARGET", TARGET | {"type_mask": 0, "q": (1.0, r.uniform(-0.2, 0.2), r.uniform(-0.2, 0.2), 0.1)}
    ),
    lambda p, r: _sticks(p, *(r.randrange(1000, 2000) for _ in range(4))),
    lambda p, r: p.command(mavlink.MAV_CMD_DO_CHANGE_SPEED, r.choice((0, 1, 2, 3)), r.uniform(-1.0, 12.0)),
    lambda p, r: p.command(mavlink.MAV_CMD_CONDITION_YAW, r.uniform(0.0, 360.0), r.uniform(0.0, 90.0), r.choice((-1, 1)), r.choice((0, 1))),
    lambda p, r: p.command(mavlink.MAV_CMD_DO_PAUSE_CONTINUE, r.choice((0, 1))),
    lambda p, r: p.command(mavlink.MAV_CMD_DO_SET_ROI_LOCATION, 0, 0, 0, 0, 48.2 + r.uniform(-1e-3, 1e-3), 16.37, 0),
    lambda p, r: p.command_int(
        mavlink.MAV_CMD_DO_REPOSITION,
        {"param2": 1.0, "frame": r.choice((0, 3, 10)), "x": START.lat_e7 + r.randrange(3000), "y": START.lon_e7, "z": 20.0},
    ),
    lambda p, r: p.command(mavlink.MAV_CMD_DO_SET_HOME, 1.0),
    lambda p, r: p.command(mavlink.MAV_CMD_MISSION_START),
    lambda p, r: p.command(mavlink.MAV_CMD_DO_SET_MISSION_CURRENT, r.randrange(8)),
    lambda p, r: p.command(mavlink.MAV_CMD_REQUEST_MESSAGE, r.choice((24, 30, 148, 242, 49))),
    lambda p, r: p.command(mavlink.MAV_CMD_RUN_PREARM_CHECKS),
    lambda p, r: p.parameter(
        *r.choice(
            (
                ("SIM_WIND_SPD", 6.0), ("SIM_WIND_TURB", 2.0), ("SIM_GPS_DISABLE", 1.0), ("SIM_GPS_DISABLE", 0.0),
                ("FENCE_ENABLE", 1.0), ("FENCE_ENABLE", 0.0), ("WPNAV_SPEED", 400.0), ("FS_GCS_ENABLE", 1.0),
                ("SIM_RC_FAIL", 1.0), ("SIM_RC_FAIL", 0.0), ("RTL_ALT_FINAL", 300.0), ("TERRAIN_ENABLE", 0.0),
                ("BATT_FS_LOW_ACT", 2.0), ("SIM_BATT_VOLTAGE", 10.2), ("SIM_BATT_VOLTAGE", 12.6), ("GUID_TIMEOUT", 1.0),
            )
        )
    ),
    lambda p, r: setattr(p, "heartbeats", r.random() < 0.8),
)  # fmt: skip


def at_random(pilot: Pilot, orders: int = 60) -> None:
    """Random commands and targets, determined by a seed.

    Occasional takeoffs are added, because the vehicle refuses most commands on the ground.
    """
    chance = random.Random(pilot.craft.config.seed)
    upload(
        pilot,
        MISSION,
        [
            _item(mavlink.MAV_CMD_NAV_WAYPOINT),
            _item(mavlink.MAV_CMD_NAV_TAKEOFF, alt=8.0),
            _item(mavlink.MAV_CMD_NAV_WAYPOINT, 10.0, 5.0, 9.0),
            _item(mavlink.MAV_CMD_CONDITION_DELAY, 0.0, 0.0, 0.0, 1.0),
            _item(mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT, 20.0, -5.0, 14.0),
            _item(mavlink.MAV_CMD_NAV_LOITER_TIME, 3.0, -9.0, 6.0, 3.0),
            _item(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH),
        ],
    )
    for number in range(orders):
        if number % 30 == 0:
            with contextlib.suppress(PilotTimeoutError):
                pilot.mode(mavlink.COPTER_MODE_GUIDED)
                pilot.take_off(6.0, 20.0)
        with contextlib.suppress(PilotTimeoutError):
            chance.choice(_RANDOM_ORDERS)(pilot, chance)
        pilot.fly_on(chance.choice((0.1, 0.3, 1.0, 2.0)))
