"""Gimbal attitude reported by the autopilot.

If the attitude may be a target instead of a measurement, it is unknown.
"""

from __future__ import annotations

import math
from typing import Any

import pytest
from depth import examples
from fractus_core.policy.decision_types import Attitude, Lens
from fractus_core.policy.footprint import camera_axes
from fractus_runtime.mavlink_codec import message
from fractus_services.errors import AutopilotError, PreconditionFailed
from fractus_services.mobility.autopilot import Permit, always
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.gimbal import attitude_of, point
from fractus_services.mobility.mavlink.vehicle import Vehicle
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

CAMERA = Lens(1.0, 1.0, pitch_deg=0.0)
ROLL_AND_PITCH_LOCK = mavlink.GIMBAL_DEVICE_FLAGS_ROLL_LOCK | mavlink.GIMBAL_DEVICE_FLAGS_PITCH_LOCK
ARDUPILOT_4_4 = ROLL_AND_PITCH_LOCK
ARDUPILOT_4_6 = ROLL_AND_PITCH_LOCK | mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME
NORTH = ROLL_AND_PITCH_LOCK | mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME
SIYI = 8.0
SERVO = 1.0


def quaternion(roll_deg: float, pitch_deg: float, yaw_deg: float) -> tuple[float, ...]:
    """Return the quaternion of a rotation about z, then y, then x. It is the product of three quaternions."""

    def times(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, ...]:
        return (
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        )

    r, p, y = (math.radians(v) / 2 for v in (roll_deg, pitch_deg, yaw_deg))
    about = (math.cos(y), 0, 0, math.sin(y)), (math.cos(p), 0, math.sin(p), 0), (math.cos(r), math.sin(r), 0, 0)
    return times(times(about[0], about[1]), about[2])


def vehicle(kind: float | None = SIYI, heading_deg: float = 0.0) -> Vehicle:
    reporting = Vehicle(stack=ARDUCOPTER)
    reporting.take(message("ATTITUDE", yaw=math.radians(heading_deg)), 10.0)
    if kind is not None:
        reporting.take(message("PARAM_VALUE", param_id=b"MNT1_TYPE", param_value=kind), 10.0)
    return reporting


def report(reporting: Vehicle, now: float = 10.0, flags: int = ARDUPILOT_4_6, **more: Any) -> Attitude | None:
    values = {"q": quaternion(0.0, -45.0, 30.0), "flags": flags, "gimbal_device_id": 1} | more
    reporting.take(message("GIMBAL_DEVICE_ATTITUDE_STATUS", **values), now)
    return reporting.gimbal


@settings(max_examples=examples(300), deadline=None, derandomize=True)
@given(
    roll=st.floats(-40, 40),
    pitch=st.one_of(st.floats(-90, 90), st.sampled_from([-90.0, -89.95, 90.0])),
    yaw=st.floats(-180, 180),
    heading=st.floats(0, 359),
)
def test_attitude_matches_the_quaternion(roll: float, pitch: float, yaw: float, heading: float) -> None:
    status = message("GIMBAL_DEVICE_ATTITUDE_STATUS", q=quaternion(roll, pitch, yaw), flags=ARDUPILOT_4_6)
    attitude = attitude_of(status, heading)
    assert attitude is not None
    expected = camera_axes(CAMERA, Attitude(roll, pitch, yaw + heading))
    for axis, expected_axis in zip(camera_axes(CAMERA, attitude), expected, strict=True):
        assert axis == pytest.approx(expected_axis, abs=0.01)


@pytest.mark.parametrize(
    ("flags", "yaw_deg"),
    [
        (ARDUPILOT_4_4, 120.0),
        (ARDUPILOT_4_6, 120.0),
        (NORTH, 30.0),
        (NORTH | mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK, 30.0),
    ],
)
def test_yaw_reference_follows_the_flags(flags: int, yaw_deg: float) -> None:
    attitude = report(vehicle(heading_deg=90.0), flags=flags)
    assert attitude is not None
    assert (attitude.pitch_deg, attitude.yaw_deg) == (pytest.approx(-45.0), pytest.approx(yaw_deg))


@pytest.mark.parametrize(
    "report_fields",
    [
        {"flags": ARDUPILOT_4_6 | mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK},
        {"flags": ROLL_AND_PITCH_LOCK | mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK},
        {"flags": ARDUPILOT_4_6 | mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME},
        {"flags": ARDUPILOT_4_6 | mavlink.GIMBAL_DEVICE_FLAGS_RETRACT},
        {"flags": mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME | mavlink.GIMBAL_DEVICE_FLAGS_ROLL_LOCK},
        {"flags": 0},
        {"failure_flags": 4},
        {"q": (math.nan,) * 4},
        {"q": (1.0, 0.0, 0.0, math.nan)},
        {"q": (math.inf, 0.0, 0.0, 0.0)},
        {"q": (0.0, 0.0, 0.0, 0.0)},
        {"q": (0.9, 0.0, 0.0, 0.0)},
        {"q": (1.1, 0.0, 0.0, 0.0)},
    ],
)  # fmt: skip
def test_ambiguous_attitude_is_unknown(report_fields: dict[str, Any]) -> None:
    drone = vehicle()
    assert report(drone) is not None
    assert report(drone, 10.1, **report_fields) is None


@pytest.mark.parametrize("kind", [None, 0.0, SERVO, 2.0, 4.0, 7.0, 9.0, 13.0, 99.0])
def test_attitude_of_a_gimbal_that_reports_its_target_is_unknown(kind: float | None) -> None:
    assert report(vehicle(kind)) is None


def test_changed_gimbal_type_takes_effect_after_a_restart() -> None:
    drone = vehicle(SERVO)
    drone.take(message("PARAM_VALUE", param_id=b"MNT1_TYPE", param_value=SIYI), 10.0)
    assert report(drone) is None, "the autopilot still uses the servo gimbal, because it reads the type at startup"
    drone.gimbal_measured = None  # state after a reconnect
    drone.take(message("PARAM_VALUE", param_id=b"MNT1_TYPE", param_value=SIYI), 11.0)
    assert report(drone) is not None


def test_second_gimbal_is_ignored() -> None:
    drone = vehicle()
    first = report(drone)
    assert report(drone, 10.2, gimbal_device_id=2, q=quaternion(0, 0, 0)) == first
    assert drone.gimbal_at == 10.0


def test_gimbal_attitude_is_as_old_as_the_heading() -> None:
    drone = vehicle()
    report(drone, 10.8)
    assert drone.gimbal_at == 10.0
    drone.take(message("ATTITUDE"), 11.0)
    report(drone, 11.05)
    assert drone.gimbal_at == 11.0


class Commanded:
    """Fake autopilot for gimbal commands.

    Commands raise `error`, if given. Gimbal limits are reported only if `limits` is given.
    """

    def __init__(self, error: AutopilotError | None = None, limits: dict[str, float] | None = None) -> None:
        self.vehicle = vehicle()
        self.sent: list[tuple[float, ...]] = []
        self._error = error
        self._limits = limits

    async def command(self, command: int, *params: float, permit: Permit = always, attempts: int = 4) -> None:
        del attempts
        permit()
        if command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            if self._limits is not None:
                fields = {end: math.radians(deg) for end, deg in self._limits.items()}
                self.vehicle.take(message("GIMBAL_MANAGER_INFORMATION", gimbal_device_id=1, **fields), 10.0)
            return
        if self._error is not None:
            raise self._error
        self.sent.append((command, *params))


LIMITS = {"pitch_min": -90.0, "pitch_max": 20.0, "yaw_min": -180.0, "yaw_max": 180.0}


@pytest.mark.parametrize("limits", [None, LIMITS])
async def test_point_sends_no_rates(limits: dict[str, float] | None) -> None:
    autopilot = Commanded(limits=limits)
    await point(autopilot, -90.0, 180.0, always)
    assert autopilot.sent[0][:3] == (mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW, -90.0, 180.0)
    assert all(math.isnan(rate) for rate in autopilot.sent[0][3:])


async def test_point_refuses_angles_outside_of_the_limits() -> None:
    autopilot = Commanded(limits=LIMITS)
    with pytest.raises(PreconditionFailed, match="pitch is limited to -90 to 20 degrees; 45 was requested"):
        await point(autopilot, 45.0, 0.0, always)
    assert autopilot.sent == []


@pytest.mark.parametrize(
    ("error", "raised", "message_text"),
    [
        (AutopilotError("failed", refused=True), PreconditionFailed, "no gimbal"),
        (AutopilotError("no answer", link=True), AutopilotError, "no answer"),
    ],
)
async def test_point_raises_the_reason_of_a_failure(
    error: AutopilotError, raised: type[Exception], message_text: str
) -> None:
    with pytest.raises(raised, match=message_text):
        await point(Commanded(error), -45.0, 0.0, always)


async def test_point_sends_nothing_without_permit() -> None:
    def refused() -> None:
        raise PreconditionFailed("ControlLost", "gone")

    autopilot = Commanded(limits=LIMITS)
    with pytest.raises(PreconditionFailed, match="gone"):
        await point(autopilot, -45.0, 0.0, refused)
    assert autopilot.sent == []
