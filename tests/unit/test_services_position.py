"""Validity of the position of the vehicle, and telemetry of the service."""

from __future__ import annotations

import asyncio
import math
from types import SimpleNamespace
from typing import Any

import pytest
from fractus_core.control import ControlState, Mission, Outcome, OutcomeKind
from fractus_proto.v1.mobility_pb2 import MissionOutcome
from fractus_runtime.mavlink_codec import Message, Value, message
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.mavlink_autopilot import MavlinkAutopilot
from fractus_services.mobility.mavlink.vehicle import Vehicle
from fractus_services.mobility.rpc.telemetry import telemetry_of
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from virtual_time import Loop

HEALTHY = 831
"""Flags of EKF_STATUS_REPORT of a real ArduCopter that has a position."""


def place(vehicle: Vehicle, lat: float, now: float) -> None:
    vehicle.take(message("EKF_STATUS_REPORT", flags=HEALTHY), now)
    report_position(vehicle, lat, now)


def report_position(vehicle: Vehicle, lat: float, now: float) -> None:
    vehicle.take(message("GLOBAL_POSITION_INT", lat=round(lat * 1e7), lon=229500000, relative_alt=20_000, vx=300), now)


def fix(vehicle: Vehicle, fix_type: int, h_acc: int = 600) -> None:
    vehicle.take(message("GPS_RAW_INT", fix_type=fix_type, h_acc=h_acc), 0.0)


@pytest.mark.parametrize(("fix_type", "h_acc"), [(0, 0), (1, 600), (2, 600), (3, 10_001), (6, 80_000)])
def test_position_is_unknown_without_good_fix(fix_type: int, h_acc: int) -> None:
    vehicle = Vehicle(stack=ARDUCOPTER)
    place(vehicle, 39.0, 1.0)
    assert vehicle.lat is None
    fix(vehicle, 3)
    place(vehicle, 39.1, 2.0)
    fix(vehicle, fix_type, h_acc)
    place(vehicle, 39.2, 3.0)
    assert (vehicle.lat, vehicle.position_at) == (39.1, 2.0)


@pytest.mark.parametrize(("lat_e7", "lon_e7"), [(0, 0), (2**31 - 1, 229500000), (393600000, -(2**31)), (900000001, 0)])
def test_invalid_coordinates_are_ignored(lat_e7: int, lon_e7: int) -> None:
    vehicle = Vehicle(stack=ARDUCOPTER)
    fix(vehicle, 3)
    vehicle.take(message("GLOBAL_POSITION_INT", lat=lat_e7, lon=lon_e7), 1.0)
    vehicle.take(message("HOME_POSITION", latitude=lat_e7, longitude=lon_e7), 1.0)
    assert (vehicle.lat, vehicle.home, vehicle.position_at) == (None, None, -math.inf)


def test_position_is_unknown_until_estimator_has_reported() -> None:
    vehicle = Vehicle(stack=ARDUCOPTER)
    fix(vehicle, 3)
    report_position(vehicle, 39.0, 1.0)
    assert vehicle.lat is None
    vehicle.take(message("EKF_STATUS_REPORT", flags=HEALTHY), 1.1)
    report_position(vehicle, 39.0, 1.2)
    assert vehicle.lat == 39.0


def test_position_is_trusted_again_only_when_a_new_position_arrives() -> None:
    def estimator(flags: int, now: float) -> None:
        vehicle.take(message("EKF_STATUS_REPORT", flags=flags), now)

    vehicle = Vehicle(stack=ARDUCOPTER)
    fix(vehicle, 3)
    place(vehicle, 39.0, 0.5)
    estimator(HEALTHY | mavlink.EKF_GPS_GLITCHING, 1.0)
    assert "GPS glitch" in vehicle.position_problem
    for second in range(2, 9):
        estimator(HEALTHY, float(second))
    assert vehicle.position_problem, "the latest known position is older than the glitch"
    vehicle.take(message("GPS_RAW_INT", fix_type=3, h_acc=600), 9.0)
    estimator(HEALTHY, 9.0)
    report_position(vehicle, 39.0, 9.1)
    assert (vehicle.position_problem, vehicle.position_at) == ("", 9.1)


def test_position_accuracy_expires_when_no_longer_reported() -> None:
    vehicle = Vehicle(stack=ARDUCOPTER)
    fix(vehicle, 3, 9_000)
    assert vehicle.position_error_m == 9.0
    fix(vehicle, 3, 0)
    assert vehicle.position_error_m == 1.5


def telemetry(
    vehicle: Vehicle, now: float, missions: bool = False, last_text: int = 0, downlink_latency_s: float = 0.0
) -> Any:
    autopilot = SimpleNamespace(vehicle=vehicle, now=now, connected=True, downlink_latency_s=downlink_latency_s)
    ended = Mission("uid", "identity", outcome=Outcome(OutcomeKind.REVOKED, "why"))
    state = ControlState(missions={"uid": ended, "other": Mission("other", "identity")})
    control: Any = SimpleNamespace(
        autopilot=autopilot,
        state=state,
        home_altitude_inconsistent=False,
        effects=SimpleNamespace(takeover_reason="a pilot took it"),
    )
    return telemetry_of(control, 0.0, missions=missions, not_ready_reason="", last_text=last_text)


def test_telemetry_contains_no_stale_position() -> None:
    vehicle = Vehicle(stack=ARDUCOPTER)
    fix(vehicle, 3)
    place(vehicle, 39.0, 10.0)
    fresh = telemetry(vehicle, 10.5)
    assert fresh.HasField("position")
    assert fresh.position_error_m == pytest.approx(0.6 + 3.0 * 0.5)
    assert fresh.position_age_s == pytest.approx(0.5)
    stale = telemetry(vehicle, 11.1)
    assert not stale.HasField("position")
    assert not stale.HasField("velocity")
    assert not telemetry(Vehicle(stack=ARDUCOPTER), math.inf).HasField("position")


def test_telemetry_reports_age_of_attitude() -> None:
    vehicle = Vehicle(stack=ARDUCOPTER)
    vehicle.take(message("ATTITUDE", roll=0.1, pitch=0.0, yaw=1.0), 10.0)
    fresh = telemetry(vehicle, 10.4)
    assert fresh.attitude_age_s == pytest.approx(0.4)
    stale = telemetry(vehicle, 11.1)
    assert not stale.HasField("attitude")
    assert not stale.HasField("attitude_age_s")


@pytest.mark.parametrize("delay_s", [0.3, math.inf])
def test_telemetry_ages_include_link_latency(delay_s: float) -> None:
    vehicle = Vehicle(stack=ARDUCOPTER)
    fix(vehicle, 3)
    place(vehicle, 39.0, 10.0)
    vehicle.take(message("ATTITUDE", yaw=1.0), 10.1)
    fresh = telemetry(vehicle, 10.2, downlink_latency_s=delay_s)
    assert fresh.position_age_s == pytest.approx(0.2 + delay_s)
    assert fresh.attitude_age_s == pytest.approx(0.1 + delay_s)
    assert fresh.position_error_m == pytest.approx(0.6 + 3.0 * 0.2)


def timed_message(name: str, boot_s: float, **values: float) -> Message:
    fields: dict[str, Value] = {"time_boot_ms": round(boot_s * 1e3), **values}
    return message(name, **fields)


def test_attitude_age_follows_its_timestamp() -> None:
    async def receive_late_attitude() -> None:
        autopilot = MavlinkAutopilot("tcp:127.0.0.1:1", ARDUCOPTER)
        for boot_s in (100.0, 100.5):
            autopilot.take(timed_message("GLOBAL_POSITION_INT", boot_s))
            await asyncio.sleep(0.5)
        vehicle = autopilot.vehicle
        now = autopilot.now
        autopilot.take(timed_message("ATTITUDE", 100.6, yaw=0.5))  # delayed by 0.4 s
        assert vehicle.attitude_at == pytest.approx(now - 0.4, abs=1e-3)
        autopilot.take(timed_message("ATTITUDE", 100.2, yaw=2.0))  # overtaken by the previous message
        assert vehicle.attitude_at == pytest.approx(now - 0.4, abs=1e-3)
        assert vehicle.heading_deg == pytest.approx(math.degrees(0.5))

    with asyncio.Runner(loop_factory=Loop) as runner:
        runner.run(receive_late_attitude())


def test_mission_outcomes_are_reported_to_the_node_only() -> None:
    for_node, for_others = (telemetry(Vehicle(stack=ARDUCOPTER), 0.0, missions=node) for node in (True, False))
    assert dict(for_node.missions) == {"uid": MissionOutcome(kind=MissionOutcome.KIND_REVOKED, reason="why")}
    assert for_node.controller_reason == "a pilot took it"
    assert (dict(for_others.missions), for_others.controller_reason) == ({}, "")


def test_telemetry_reports_satellites_wind_and_new_statustexts() -> None:
    vehicle = Vehicle(stack=ARDUCOPTER)
    empty = telemetry(vehicle, 10.0)
    assert not empty.HasField("gps")
    assert not empty.HasField("wind")
    vehicle.take(message("GPS_RAW_INT", fix_type=4, satellites_visible=12), 10.0)
    vehicle.take(message("WIND", direction=90.0, speed=5.0), 10.0)
    for text in (b"PreArm: a", b"PreArm: b"):
        vehicle.take(message("STATUSTEXT", severity=2, text=text), 10.0)
    full = telemetry(vehicle, 11.0)
    assert (full.gps.fix_type, full.gps.satellites) == (4, 12)
    assert (full.wind.from_deg, full.wind.speed_mps) == (90.0, 5.0)
    assert [(text.number, text.text) for text in full.texts] == [(1, "PreArm: a"), (2, "PreArm: b")]
    assert [text.time.ToNanoseconds() for text in full.texts] == [-1e9, -1e9]
    assert [text.text for text in telemetry(vehicle, 11.0, last_text=1).texts] == ["PreArm: b"]
    assert not telemetry(vehicle, 21.0).HasField("wind")
