"""What ArduCopter adds to MAVLink, or leaves out of it: modes, frames, capabilities, magic numbers, its version."""

from __future__ import annotations

from dataclasses import dataclass

from fractus_mavlink.enums import COPTER_MODE, MAV_FRAME, MAV_PROTOCOL_CAPABILITY, POSITION_TARGET_TYPEMASK


@dataclass(frozen=True, slots=True)
class ModeTraits:
    """What a mode asks for: a position, a throttle stick that is handed through; and whether the motors start in it."""

    needs_position: bool = True
    manual_throttle: bool = False
    arms: bool = False


TRAITS = {
    COPTER_MODE.STABILIZE: ModeTraits(needs_position=False, manual_throttle=True, arms=True),
    COPTER_MODE.ACRO: ModeTraits(needs_position=False, manual_throttle=True, arms=True),
    COPTER_MODE.ALT_HOLD: ModeTraits(needs_position=False, arms=True),
    COPTER_MODE.AUTO: ModeTraits(),
    COPTER_MODE.GUIDED: ModeTraits(arms=True),
    COPTER_MODE.LOITER: ModeTraits(arms=True),
    COPTER_MODE.RTL: ModeTraits(),
    COPTER_MODE.CIRCLE: ModeTraits(),
    COPTER_MODE.LAND: ModeTraits(needs_position=False),
    COPTER_MODE.DRIFT: ModeTraits(arms=True),
    COPTER_MODE.POSHOLD: ModeTraits(arms=True),
    COPTER_MODE.BRAKE: ModeTraits(),
    COPTER_MODE.THROW: ModeTraits(arms=True),
    COPTER_MODE.AVOID_ADSB: ModeTraits(),
    COPTER_MODE.GUIDED_NOGPS: ModeTraits(needs_position=False, arms=True),
    COPTER_MODE.SMART_RTL: ModeTraits(),
    COPTER_MODE.ZIGZAG: ModeTraits(arms=True),
}
SUPPORTED_MODES = frozenset(TRAITS)
# The modes that take targets from a companion, and those that a command makes take off.
GUIDED_MODES = frozenset({COPTER_MODE.GUIDED, COPTER_MODE.GUIDED_NOGPS, COPTER_MODE.AVOID_ADSB})
TAKES_OFF = GUIDED_MODES | {COPTER_MODE.LOITER, COPTER_MODE.POSHOLD, COPTER_MODE.ZIGZAG}
# The modes that it has, but cannot enter without a pilot, a sensor or a setting: what it says before it refuses, and why.
UNAVAILABLE: dict[COPTER_MODE, tuple[tuple[str, ...], str]] = {
    COPTER_MODE.FLIP: ((), "init failed"),
    COPTER_MODE.AUTOTUNE: ((), "init failed"),
    COPTER_MODE.FLOWHOLD: ((), "init failed"),
    COPTER_MODE.FOLLOW: (("Set FOLL_ENABLE = 1",), "init failed"),
    COPTER_MODE.SYSTEMID: (("No axis selected, SID_AXIS = 0",), "init failed"),
    COPTER_MODE.AUTO_RTL: (("Unable to start landing sequence",), "No return path or landing sequence found"),
    COPTER_MODE.TURTLE: ((), "init failed"),
}


def mode_title(mode: COPTER_MODE) -> str:
    """What the autopilot calls a mode in its texts."""
    return _TITLES.get(mode, mode.name)


_TITLES = {COPTER_MODE.SMART_RTL: "SMARTRTL", COPTER_MODE.AUTO_RTL: "AUTO RTL"}


# Altitudes of the sea, of home, and of the ground; the deprecated *_INT frames mean the same.
ABSOLUTE_FRAMES = frozenset({MAV_FRAME.GLOBAL, MAV_FRAME.GLOBAL_INT})
TERRAIN_FRAMES = frozenset({MAV_FRAME.GLOBAL_TERRAIN_ALT, MAV_FRAME.GLOBAL_TERRAIN_ALT_INT})
GLOBAL_FRAMES = ABSOLUTE_FRAMES | TERRAIN_FRAMES | {MAV_FRAME.GLOBAL_RELATIVE_ALT, MAV_FRAME.GLOBAL_RELATIVE_ALT_INT}

# The second parameter of MAV_CMD_COMPONENT_ARM_DISARM: disarm in flight, and arm in spite of the checks.
FORCE_MAGIC = 21196
FORCE_ARM_MAGIC = 2989

_MASK = POSITION_TARGET_TYPEMASK
IGNORE_POSITION = _MASK.X_IGNORE | _MASK.Y_IGNORE | _MASK.Z_IGNORE
IGNORE_VELOCITY = _MASK.VX_IGNORE | _MASK.VY_IGNORE | _MASK.VZ_IGNORE
IGNORE_ACCELERATION = _MASK.AX_IGNORE | _MASK.AY_IGNORE | _MASK.AZ_IGNORE
IGNORE_HEADING = _MASK.YAW_IGNORE | _MASK.YAW_RATE_IGNORE
POSITION_ONLY = IGNORE_VELOCITY | IGNORE_ACCELERATION | IGNORE_HEADING
# POSITION_TARGET_GLOBAL_INT sets the unused bits, too.
GLOBAL_TARGET_ONLY = 0xF000 | POSITION_ONLY
VELOCITY_ONLY = IGNORE_POSITION | IGNORE_ACCELERATION | IGNORE_HEADING

_CAN = MAV_PROTOCOL_CAPABILITY
CAPABILITIES = (
    _CAN.MISSION_FLOAT
    | _CAN.PARAM_FLOAT
    | _CAN.MISSION_INT
    | _CAN.COMMAND_INT
    | _CAN.SET_ATTITUDE_TARGET
    | _CAN.SET_POSITION_TARGET_LOCAL_NED
    | _CAN.SET_POSITION_TARGET_GLOBAL_INT
    | _CAN.TERRAIN
    | _CAN.FLIGHT_TERMINATION
    | _CAN.COMPASS_CALIBRATION
    | _CAN.MAVLINK2
    | _CAN.MISSION_FENCE
    | _CAN.MISSION_RALLY
)
# Flight software version 4.6.3, release type official (255).
FLIGHT_VERSION = 4 << 24 | 6 << 16 | 3 << 8 | 255
VERSION_TEXT = "ArduCopter V4.6.3 (fractus)"
