"""An existing vehicle with the settings of its owner: parameters, a fence of twelve items, and rally points."""

from __future__ import annotations

import math
from collections.abc import Sequence

from fractus_core.geo import LocalFrame
from fractus_sim.testbeds.vehicle_settings import AutopilotConnection, VehicleSettings
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

OWNED = {
    "WPNAV_SPEED": 450.0, "GUID_TIMEOUT": 2.5, "RALLY_LIMIT_KM": 0.3, "RTL_ALT": 1300.0, "RTL_CLIMB_MIN": 200.0, "RTL_ALT_FINAL": 300.0,
    "FENCE_ENABLE": 1.0, "FENCE_TYPE": 5.0, "FENCE_ALT_MAX": 90.0, "FENCE_ACTION": 2.0, "FENCE_OPTIONS": 3.0,
    "FS_GCS_ENABLE": 0.0, "BATT_FS_LOW_ACT": 1.0, "SYSID_MYGCS": 255.0,
}  # fmt: skip
"""Values that a mission replaces, and values of failsafes."""

INCLUSION = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
EXCLUSION = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION
Item = tuple[int, float, float, float, float]
"""Command, first parameter, metres east and north of home, altitude."""


def _ring(command: int, corners: int, radius_m: float, east_m: float) -> list[Item]:
    angles = [math.tau * corner / corners for corner in range(corners)]
    return [
        (command, corners, east_m + radius_m * math.sin(angle), radius_m * math.cos(angle), 0.0) for angle in angles
    ]


FENCE = [*_ring(INCLUSION, 8, 800.0, 0.0), *_ring(EXCLUSION, 4, 20.0, -600.0)]
RALLY: list[Item] = [(mavlink.MAV_CMD_NAV_RALLY_POINT, 0.0, -30.0, 10.0, 15.0)]


def parameter_arguments() -> list[str]:
    """Return the arguments of the simulated vehicle that set the owner's parameters."""
    return [part for name, value in OWNED.items() for part in ("--param", f"{name}={value:g}")]


def upload_lists(link: str, home: tuple[float, float]) -> None:
    """Store the owner's fence and rally points in a vehicle.

    Args:
        link: `tcp:HOST:PORT`.
        home: Latitude and longitude.
    """
    connection = mavutil.mavlink_connection(link, source_system=255)
    try:
        connection.wait_heartbeat(timeout=10)
        _upload(connection, mavlink.MAV_MISSION_TYPE_FENCE, FENCE, home)
        _upload(connection, mavlink.MAV_MISSION_TYPE_RALLY, RALLY, home)
    finally:
        connection.close()


def _upload(connection: mavutil.mavfile, kind: int, items: Sequence[Item], home: tuple[float, float]) -> None:
    connection.mav.mission_count_send(connection.target_system, 1, len(items), kind)
    frame = LocalFrame(*home)
    while True:
        message = connection.recv_match(
            type=["MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ACK"], blocking=True, timeout=5
        )
        assert message is not None
        if message.get_type() == "MISSION_ACK":
            assert message.type == mavlink.MAV_MISSION_ACCEPTED
            return
        command, param1, east_m, north_m, altitude_m = items[message.seq]
        lat, lon = frame.latlon(east_m, north_m)
        coordinates = 3 if kind == mavlink.MAV_MISSION_TYPE_RALLY else 0
        connection.mav.mission_item_int_send(
            connection.target_system, 1, message.seq, coordinates, command, 0, 1, param1, 0, 0, 0, round(lat * 1e7), round(lon * 1e7),
            altitude_m, kind,
        )  # fmt: skip


def read_settings(link: str) -> VehicleSettings:
    """Read all settings of a vehicle."""
    with AutopilotConnection.open(link) as connection:
        return connection.read_settings()


def assert_owned(link: str, owner: VehicleSettings) -> None:
    """Check that a vehicle has exactly the settings of its owner."""
    now = read_settings(link)
    counted = [name for name in owner.parameters if name.startswith("STAT_")]
    changed = {
        name: (value, now.parameters.get(name))
        for name, value in owner.parameters.items()
        if name not in counted and now.parameters.get(name) != value
    }
    assert not changed
    assert now.parameters.keys() == owner.parameters.keys()
    assert len(now.fence) == len(FENCE)
    assert now.fence == owner.fence
    assert now.rally == owner.rally
