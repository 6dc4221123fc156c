"""ArduCopter's dialect of MAVLink: modes, frames, capabilities, magic numbers and version."""

from __future__ import annotations

from dataclasses import dataclass

from fractus_runtime.mavlink_codec import enum_name
from pymavlink.dialects.v20 import ardupilotmega as mavlink


@dataclass(frozen=True, slots=True)
class ModeTraits:
    """Properties of a mode.

    Attributes:
        needs_position: True if the mode needs a position estimate.
        manual_throttle: True if the throttle stick controls the motors directly.
        arms: True if the vehicle may be armed in the mode.
    """

    needs_position: bool = True
    manual_throttle: bool = False
    arms: bool = False


TRAITS = {
    mavlink.COPTER_MODE_STABILIZE: ModeTraits(needs_position=False, manual_throttle=True, arms=True),
    mavlink.COPTER_MODE_ACRO: ModeTraits(needs_position=False, manual_throttle=True, arms=True),
    mavlink.COPTER_MODE_ALT_HOLD: ModeTraits(needs_position=False, arms=True),
    mavlink.COPTER_MODE_AUTO: ModeTraits(),
    mavlink.COPTER_MODE_GUIDED: ModeTraits(arms=True),
    mavlink.COPTER_MODE_LOITER: ModeTraits(arms=True),
    mavlink.COPTER_MODE_RTL: ModeTraits(),
    mavlink.COPTER_MODE_CIRCLE: ModeTraits(),
    mavlink.COPTER_MODE_LAND: ModeTraits(needs_position=False),
    mavlink.COPTER_MODE_DRIFT: ModeTraits(arms=True),
    mavlink.COPTER_MODE_POSHOLD: ModeTraits(arms=True),
    mavlink.COPTER_MODE_BRAKE: ModeTraits(),
    mavlink.COPTER_MODE_THROW: ModeTraits(arms=True),
    mavlink.COPTER_MODE_AVOID_ADSB: ModeTraits(),
    mavlink.COPTER_MODE_GUIDED_NOGPS: ModeTraits(needs_position=False, arms=True),
    mavlink.COPTER_MODE_SMART_RTL: ModeTraits(),
    mavlink.COPTER_MODE_ZIGZAG: ModeTraits(arms=True),
}
SUPPORTED_MODES = frozenset(TRAITS)
# GUIDED_MODES accept targets of a companion computer. TAKEOFF_MODES accept NAV_TAKEOFF.
GUIDED_MODES = frozenset({mavlink.COPTER_MODE_GUIDED, mavlink.COPTER_MODE_GUIDED_NOGPS, mavlink.COPTER_MODE_AVOID_ADSB})
TAKEOFF_MODES = GUIDED_MODES | {mavlink.COPTER_MODE_LOITER, mavlink.COPTER_MODE_POSHOLD, mavlink.COPTER_MODE_ZIGZAG}
# Modes that this vehicle cannot enter, because they need a pilot, a sensor or a setting. The values are the STATUSTEXTs
# and the reason of the refusal.
UNAVAILABLE: dict[int, tuple[tuple[str, ...], str]] = {
    mavlink.COPTER_MODE_FLIP: ((), "init failed"),
    mavlink.COPTER_MODE_AUTOTUNE: ((), "init failed"),
    mavlink.COPTER_MODE_FLOWHOLD: ((), "init failed"),
    mavlink.COPTER_MODE_FOLLOW: (("Set FOLL_ENABLE = 1",), "init failed"),
    mavlink.COPTER_MODE_SYSTEMID: (("No axis selected, SID_AXIS = 0",), "init failed"),
    mavlink.COPTER_MODE_AUTO_RTL: (("Unable to start landing sequence",), "No return path or landing sequence found"),
    mavlink.COPTER_MODE_TURTLE: ((), "init failed"),
}


def mode_title(mode: int) -> str:
    """Return ArduPilot's name of a mode in STATUSTEXTs."""
    return _TITLES.get(mode) or enum_name("COPTER_MODE", mode)


_TITLES = {mavlink.COPTER_MODE_SMART_RTL: "SMARTRTL", mavlink.COPTER_MODE_AUTO_RTL: "AUTO RTL"}


# Second parameter of MAV_CMD_COMPONENT_ARM_DISARM: disarm in flight, and arm despite failed checks.
FORCE_MAGIC = 21196
FORCE_ARM_MAGIC = 2989

IGNORE_POSITION = (
    mavlink.POSITION_TARGET_TYPEMASK_X_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_Y_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_Z_IGNORE
)
IGNORE_VELOCITY = (
    mavlink.POSITION_TARGET_TYPEMASK_VX_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VY_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VZ_IGNORE
)
IGNORE_ACCELERATION = (
    mavlink.POSITION_TARGET_TYPEMASK_AX_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_AY_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_AZ_IGNORE
)
IGNORE_HEADING = mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE | mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
POSITION_ONLY = IGNORE_VELOCITY | IGNORE_ACCELERATION | IGNORE_HEADING
# POSITION_TARGET_GLOBAL_INT also sets the unused bits.
GLOBAL_TARGET_ONLY = 0xF000 | POSITION_ONLY
VELOCITY_ONLY = IGNORE_POSITION | IGNORE_ACCELERATION | IGNORE_HEADING

CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FLOAT
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_GLOBAL_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_TERRAIN
    | mavlink.MAV_PROTOCOL_CAPABILITY_FLIGHT_TERMINATION
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMPASS_CALIBRATION
    | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_RALLY
)
# Flight software version 4.6.3, release type official (255).
FLIGHT_VERSION = 4 << 24 | 6 << 16 | 3 << 8 | 255
VERSION_TEXT = "ArduCopter V4.6.3 (fractus)"
