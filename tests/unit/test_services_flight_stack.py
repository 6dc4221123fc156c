"""Flight stacks: modes and failsafe texts of ArduCopter, and the stack of another firmware."""

from __future__ import annotations

import pytest
from fractus_core.control.state import FlightMode, ModeKind
from fractus_runtime.mavlink_codec import Message, enum_names, message
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER, ArduCopter
from fractus_services.mobility.mavlink.mavlink_autopilot import MavlinkAutopilot
from pymavlink.dialects.v20 import ardupilotmega as mavlink


def test_each_mode_maps_to_its_flight_state() -> None:
    kinds = {mode: ARDUCOPTER.mode(mode).kind for mode in enum_names("COPTER_MODE")}
    assert kinds.pop(mavlink.COPTER_MODE_GUIDED) is ModeKind.COMMANDED
    assert kinds.pop(mavlink.COPTER_MODE_LAND) is ModeKind.LANDING
    assert kinds.pop(mavlink.COPTER_MODE_BRAKE) is ModeKind.BRAKING
    for mode in (mavlink.COPTER_MODE_RTL, mavlink.COPTER_MODE_SMART_RTL, mavlink.COPTER_MODE_AUTO_RTL):
        assert kinds.pop(mode) is ModeKind.RETURNING
    assert set(kinds.values()) == {ModeKind.OTHER}, "all other modes are modes of a pilot"


def test_modes_are_requested_by_number() -> None:
    for mode in enum_names("COPTER_MODE"):
        assert ARDUCOPTER.mode_parameters(ARDUCOPTER.mode(mode)) == (float(mode),)
    assert ARDUCOPTER.mode(99) == FlightMode("MODE99"), "an unknown mode of a later release counts as a mode of a pilot"


@pytest.mark.parametrize(
    ("text", "is_failsafe"),
    [
        ("GCS Failsafe", True),
        ("Battery 1 is low 10.32V used 1200 mAh", False),
        ("Battery Failsafe", True),
        ("Polygon fence breached", True),
        ("GCS Failsafe Cleared", False),
        ("EKF Failsafe: changed to LAND Mode", True),
        ("Mission: 3 WP", False),
        ("Fence enabled", False),
        ("Radio Failsafe - Continuing Auto Mode", False),
    ],
)
def test_failsafe_statustexts_are_recognised(text: str, is_failsafe: bool) -> None:
    assert ARDUCOPTER.reports_failsafe(text) is is_failsafe


class TwoNumbers(ArduCopter):
    """Flight stack whose custom mode contains a main and a sub mode, like that of PX4."""

    land = FlightMode("AUTO.LAND", ModeKind.LANDING)

    def mode(self, custom_mode: int) -> FlightMode:
        return self.land if custom_mode == 4 << 16 | 6 << 24 else FlightMode()

    def mode_parameters(self, mode: FlightMode) -> tuple[float, ...]:
        return (4.0, 6.0)


async def test_other_firmware_needs_only_a_flight_stack() -> None:
    sent: list[Message] = []

    class Vehicle(MavlinkAutopilot):
        def send(self, outgoing: Message) -> None:
            sent.append(outgoing)
            self.take(message("COMMAND_ACK", command=outgoing.integer("command")))
            self.take(message("HEARTBEAT", custom_mode=4 << 16 | 6 << 24))

    stack = TwoNumbers()
    vehicle = Vehicle("tcp:nowhere:1", stack)
    vehicle.target = (1, 1)
    vehicle.vehicle.heartbeat_at = vehicle.now
    await vehicle.set_mode(stack.land)
    assert vehicle.vehicle.mode == stack.land
    (order,) = sent
    assert order.integer("command") == mavlink.MAV_CMD_DO_SET_MODE
    assert [order.real(f"param{at}") for at in (1, 2, 3, 4)] == [1.0, 4.0, 6.0, 0.0]
