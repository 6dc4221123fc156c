"""ArduCopter 4.5 to 4.7: modes, parameters, failsafes, fence and status texts."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

from fractus_core.control.state import FlightMode, ModeKind
from fractus_core.policy.decision_types import Airframe
from fractus_core.policy.geofences import RTL_CONE_SLOPE
from fractus_core.policy.return_route import ReturnBounds
from fractus_runtime.mavlink_codec import enum_names
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.mobility.mavlink.companion import SYSTEM_ID
from fractus_services.mobility.mavlink.flight_stack import Names, ParameterReader, Setting

_KINDS = {
    mavlink.COPTER_MODE_GUIDED: ModeKind.COMMANDED,
    mavlink.COPTER_MODE_RTL: ModeKind.RETURNING,
    mavlink.COPTER_MODE_SMART_RTL: ModeKind.RETURNING,
    mavlink.COPTER_MODE_AUTO_RTL: ModeKind.RETURNING,
    mavlink.COPTER_MODE_LAND: ModeKind.LANDING,
    mavlink.COPTER_MODE_BRAKE: ModeKind.BRAKING,
}
_MODES = {mode: FlightMode(name, _KINDS.get(mode, ModeKind.OTHER)) for mode, name in enum_names("COPTER_MODE").items()}
_COPTERS = frozenset(
    {
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_TYPE_COAXIAL, mavlink.MAV_TYPE_HELICOPTER, mavlink.MAV_TYPE_HEXAROTOR, mavlink.MAV_TYPE_OCTOROTOR,
        mavlink.MAV_TYPE_TRICOPTER, mavlink.MAV_TYPE_DODECAROTOR, mavlink.MAV_TYPE_DECAROTOR, mavlink.MAV_TYPE_GENERIC_MULTIROTOR,
    }
)  # fmt: skip
_NUMBERS = {mode: number for number, mode in _MODES.items()}

_ACCEPTS_COMPANION = "accepts heartbeats of the companion, and not those of a ground station"
# Releases that have MAV_GCS_SYSID_HI can accept a range of system ids as the companion.
_ACCEPTS_ONE_SYSTEM = Setting(
    ("MAV_GCS_SYSID_HI",), 0, frozenset(float(n) for n in range(1, SYSTEM_ID + 1)), False, _ACCEPTS_COMPANION
)

_REFUSALS: dict[int, tuple[str, ...]] = {
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: ("Arm:", "PreArm:"),
    mavlink.MAV_CMD_DO_SET_MODE: ("Mode change to ", "No such mode"),
    mavlink.MAV_CMD_NAV_TAKEOFF: ("Takeoff ",),
}
"""Beginnings of the texts that state why a command was refused."""

_UNSTEERED = 1 << 4 | 1 << 5 | 1 << 6
"""Bits of GUID_OPTIONS that are not allowed.

With bits 4 and 5, the autopilot corrects neither position nor velocity and does not stop on command. With bit 6, it
flies to positions as in a mission: at WPNAV_SPEED regardless of the commanded speed, and with its own detours around
obstacles.
"""
_STEERED = frozenset(float(options) for options in range(256) if not options & _UNSTEERED)

# Values of FS_GCS_ENABLE and FENCE_ACTION for RTL and for SmartRTL. BATT_FS_LOW_ACT has other values for them.
_RETURN = 1.0
_RETRACE = 3.0

_COMES_DOWN = frozenset({1.0, 2.0, 3.0, 5.0})
"""Values of FENCE_ACTION that bring the drone down.

With other values the autopilot only reports a breach, or hovers until the battery is low.
"""

ENABLE = "FENCE_ENABLE"
TYPE = "FENCE_TYPE"
ALTITUDE = "FENCE_ALT_MAX"
ACTION = "FENCE_ACTION"
OPTIONS = "FENCE_OPTIONS"
AUTOENABLE = "FENCE_AUTOENABLE"
MARGIN = "FENCE_MARGIN"
_UNION = 2
"""Bit of FENCE_OPTIONS. If the bit is set, it is sufficient that the vehicle is inside one of several polygons."""
_DEFAULT_FENCES = float(mavlink.FENCE_TYPE_ALT_MAX | mavlink.FENCE_TYPE_CIRCLE | mavlink.FENCE_TYPE_POLYGON)
_DEFAULT_MARGIN_M = 2.0

_ACCEL: Names = (("WPNAV_ACCEL", 0.01), ("WP_ACC", 1.0))
_GAIN: Names = (("PSC_POSXY_P", 1.0), ("PSC_NE_POS_P", 1.0))
_CLIMB: Names = (("WPNAV_ACCEL_Z", 0.01), ("WP_ACC_Z", 1.0))
# The names differ between releases, even between 4.7.0 and 4.7.1.
_JERK: Names = (("PSC_JERK_XY", 1.0), ("PSC_NE_JERK", 1.0), ("PSC_JERK_NE", 1.0))
# Maximum lean angles in degrees: _OWN_LEAN of the position controller (0 if unset), _LEAN of the vehicle.
_OWN_LEAN: Names = (("PSC_ANGLE_MAX", 1.0),)
_LEAN: Names = (("ANGLE_MAX", 0.01), ("ATC_ANGLE_MAX", 1.0))
_MAX_LEAN_DEG = 80.0
_GRAVITY_MPS2 = 9.81
_WIND_LEAN_DEG = 4.0
"""Lean angle that compensates 6 m/s of wind and is not available for braking."""
_RETURN_ALTITUDE: Names = (("RTL_ALT", 0.01), ("RTL_ALT_M", 1.0))
_SPEED: Names = (("WPNAV_SPEED", 0.01), ("WP_SPD", 1.0))
_MOVEMENT = (_ACCEL, _GAIN, _CLIMB, _JERK, _OWN_LEAN, _LEAN, _RETURN_ALTITUDE, _SPEED)
_RETURN_SPEED: Names = (("RTL_SPEED", 0.01), ("RTL_SPEED_MS", 1.0))
_RETURN_CLIMB: Names = (("RTL_CLIMB_MIN", 0.01), ("RTL_CLIMB_MIN_M", 1.0))
_FINAL_ALTITUDE: Names = (("RTL_ALT_FINAL", 0.01), ("RTL_ALT_FINAL_M", 1.0))
_RESTORED = (_RETURN_ALTITUDE, _RETURN_SPEED, _SPEED, _RETURN_CLIMB, _FINAL_ALTITUDE)
_MIN_SPEED_MPS = 0.2
_MIN_ACCEL_MPS2 = 0.1
_NO_RALLY_KM = 2.0**-10
"""Distance in kilometres beyond which the autopilot ignores rally points (about one metre).

With 0, the autopilot would use every rally point. The value is exact in float32.
"""


class ArduCopter:
    """Implementation of `FlightStack` for ArduCopter."""

    guided = _MODES[mavlink.COPTER_MODE_GUIDED]
    land = _MODES[mavlink.COPTER_MODE_LAND]
    return_straight = _MODES[mavlink.COPTER_MODE_RTL]
    return_retracing = _MODES[mavlink.COPTER_MODE_SMART_RTL]

    probe_parameter = "FS_GCS_ENABLE"
    failsafes: tuple[Setting, ...] = (
        Setting(
            ("SYSID_MYGCS", "MAV_GCS_SYSID"),
            SYSTEM_ID,
            frozenset(),
            True,
            _ACCEPTS_COMPANION,
            {"MAV_GCS_SYSID": _ACCEPTS_ONE_SYSTEM},
        ),
        Setting(("FS_GCS_TIMEOUT",), 5, frozenset(), False, "reacts after five seconds without heartbeats"),
        Setting(("BATT_FS_CRT_ACT",), 1, frozenset({1.0}), False, "lands on a critical battery"),
        Setting(("FS_EKF_ACTION",), 1, frozenset({1.0, 3.0}), False, "lands when its position estimate is lost"),
        # 0 disables this failsafe.
        Setting(
            ("FS_EKF_THRESH",), 0.75, frozenset(), False, "detects that its position estimate is lost", span=(0.0, 1.0)
        ),
    )
    mission_settings: tuple[Setting, ...] = (
        Setting(("GUID_TIMEOUT",), 1, frozenset(), False, "stops one second after the last velocity setpoint"),
        Setting(("GUID_OPTIONS",), 0, _STEERED, False, "flies at the commanded speed and stops on command"),
        Setting(
            ("RTL_ALT_TYPE",), 0, frozenset(), False, "returns at an altitude above home, not above the ground below"
        ),
        # Near home, the drone climbs at most to its distance from home times RTL_CONE_SLOPE. 0 disables this limit.
        # With 0 or a larger slope, the drone only climbs higher than the policies assume.
        Setting(
            ("RTL_CONE_SLOPE",),
            RTL_CONE_SLOPE,
            frozenset({0.0}),
            False,
            "climbs far enough before it returns",
            span=(RTL_CONE_SLOPE, 10.0),
        ),
        Setting(("RTL_ALT_FINAL", "RTL_ALT_FINAL_M"), 0, frozenset(), False, "lands when it has returned"),
        Setting(("RALLY_LIMIT_KM",), _NO_RALLY_KM, frozenset(), False, "returns to home and not to a rally point"),
    )
    straight_return: tuple[Setting, ...] = (
        Setting(
            ("FS_GCS_ENABLE",), _RETURN, frozenset(), True, "returns to launch when the companion sends no heartbeats"
        ),
        Setting(("BATT_FS_LOW_ACT",), 2, frozenset({1.0, 2.0}), False, "returns to launch on a low battery"),
    )
    path_return: tuple[Setting, ...] = (
        Setting(
            ("FS_GCS_ENABLE",), _RETRACE, frozenset({4.0}), True, "returns along its path when the companion sends no heartbeats"
        ),
        Setting(("BATT_FS_LOW_ACT",), 3, frozenset({1.0, 4.0}), False, "returns along its path on a low battery"),
    )  # fmt: skip
    path_memory = ("SRTL_POINTS", 100.0)
    movement: tuple[tuple[str, ...], ...] = (
        *(tuple(name for name, _ in names) for names in _MOVEMENT),
        *((name,) for name in (ENABLE, AUTOENABLE, TYPE, ALTITUDE, MARGIN)),
    )

    leg_speed = tuple(name for name, _ in _SPEED)
    returning: tuple[tuple[str, ...], ...] = tuple(
        tuple(name for name, _ in names) for names in (_RETURN_ALTITUDE, _RETURN_SPEED, _SPEED, _RETURN_CLIMB)
    )

    fence_switch = ENABLE
    fence_total = "FENCE_TOTAL"
    fence_parameters: tuple[str, ...] = (TYPE, ALTITUDE, ACTION, OPTIONS, ENABLE)

    variance_limit = "FS_EKF_THRESH"

    gimbal_type = "MNT1_TYPE"
    # Alexmos, serial SToRM32, MAVLink (Gremsy), Siyi, Xacti, Viewpro and Topotek report a measured attitude. Servos,
    # MAVLink SToRM32 and CADDX report their target instead. The reports of gimbals that a script controls are not
    # trusted.
    measured_gimbals = frozenset({3.0, 5.0, 6.0, 8.0, 10.0, 11.0, 12.0})

    def unsupported(self, vehicle_type: int, autopilot: int) -> str:
        """Return why a vehicle is not supported. Modes and parameters of rovers, planes and other firmware have other meanings."""
        if autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA and vehicle_type in _COPTERS:
            return ""
        return f"the vehicle is no ArduCopter (MAV_AUTOPILOT {autopilot}, MAV_TYPE {vehicle_type})"

    def mode(self, custom_mode: int) -> FlightMode:
        """Return the mode of a number. A mode of a later release is named by its number and counts as a pilot's mode."""
        return _MODES.get(custom_mode) or FlightMode(f"MODE{custom_mode}")

    def mode_parameters(self, mode: FlightMode) -> tuple[float, ...]:
        """Return the number of a mode."""
        return (float(_NUMBERS[mode]),)

    def explains_refusal(self, command: int, text: str) -> bool:
        """Recognise texts of failed arming checks and mode changes, but not `Arming motors` or `Mission: 1 Takeoff`."""
        return text.startswith(_REFUSALS.get(command, ()))

    def probable_refusal(self, command: int) -> str:
        """Return the probable reason. DO_REPOSITION to a point outside the fence fails without a text."""
        return "the target is outside the vehicle's fence" if command == mavlink.MAV_CMD_DO_REPOSITION else ""

    def reports_failsafe(self, text: str) -> bool:
        """Recognise active failsafes.

        Matches `GCS Failsafe`, `Battery 1 is low ... failsafe` and `Fence breached`, but not `Failsafe Cleared`, `Failsafe - Continuing`
        or `Fence enabled`.
        """
        lower = text.lower()
        acts = "failsafe" in lower or ("fence" in lower and "breach" in lower)
        return acts and "cleared" not in lower and "continuing" not in lower

    def reports_path_lost(self, text: str) -> bool:
        """Recognise that SmartRTL exceeded its memory or its time limit."""
        return text.startswith("SmartRTL deactivated")

    def reports_estimator_switch(self, text: str) -> bool:
        """Recognise that the EKF uses another lane."""
        return text.startswith(("EKF3 lane switch", "EKF2 lane switch", "EKF primary changed"))

    def return_values(self, owned: Mapping[str, float], bounds: ReturnBounds) -> dict[str, float]:
        """Return limited values of the return parameters.

        RTL_ALT and RTL_SPEED apply to RTL. WPNAV_SPEED applies to SmartRTL, and to RTL if RTL_SPEED is 0. RTL_CLIMB_MIN
        becomes 0, so that the drone does not climb above the altitude for which return flights are judged.
        """
        speed_mps = max(bounds.speed_mps, _MIN_SPEED_MPS)
        limited = {}
        for names, maximum in (
            (_RETURN_ALTITUDE, bounds.height_m), (_RETURN_SPEED, speed_mps), (_SPEED, speed_mps), (_RETURN_CLIMB, 0.0),
        ):  # fmt: skip
            for name, scale in names:
                if name in owned:
                    # Parameters in centimetres are integers.
                    limit = maximum if scale == 1.0 or math.isinf(maximum) else math.floor(round(maximum / scale, 3))
                    limited[name] = min(owned[name], float(limit))
        return limited

    def under_names_of(self, present: Collection[str], values: Mapping[str, float]) -> dict[str, float]:
        """Return parameters under the names that the vehicle has. Release 4.7 renamed some and changed their unit."""
        renamed = {}
        for names in _RESTORED:
            for stored, stored_scale in names:
                for name, scale in names:
                    if stored in values and stored not in present and name in present:
                        renamed[name] = round(values[stored] * stored_scale / scale, 6)
        return renamed | {name: value for name, value in values.items() if name in present}

    def airframe(self, reader: ParameterReader, known: Airframe, speed_mps: float) -> tuple[Airframe, float]:
        """Return the dynamics of the vehicle, and the speed of its legs.

        The horizontal acceleration is limited by the maximum lean angle. Releases before 4.7 use centimetres, and later
        releases use metres.
        """
        read = reader.read
        airframe = Airframe(
            accel_mps2=max(min(read(_ACCEL, known.accel_mps2), _leant_mps2(reader)), _MIN_ACCEL_MPS2),
            position_gain=max(read(_GAIN, known.position_gain), 0.1),
            climb_accel_mps2=max(read(_CLIMB, known.climb_accel_mps2), 0.1),
            jerk_mps3=max(read(_JERK, known.jerk_mps3), 0.5),
            return_altitude_m=self.return_altitude_m(reader, known.return_altitude_m),
        )
        return airframe, read(_SPEED, speed_mps)

    def return_altitude_m(self, reader: ParameterReader, known_m: float) -> float:
        """Return RTL_ALT, limited by the fence's ceiling minus its margin."""

        def read(name: str, default: float, *, needed: bool = False) -> float:
            return reader.read(((name, 1.0),), default, needed=needed)

        problems_before = len(reader.problems)
        height_m = reader.read(_RETURN_ALTITUDE, known_m)
        fenced = read(ENABLE, 0.0) or read(AUTOENABLE, 0.0)
        if fenced and int(read(TYPE, _DEFAULT_FENCES)) & mavlink.FENCE_TYPE_ALT_MAX:
            height_m = min(height_m, read(ALTITUDE, known_m, needed=True) - read(MARGIN, _DEFAULT_MARGIN_M))
        return known_m if len(reader.problems) > problems_before else height_m

    def fence_values(
        self, owned: Mapping[str, float], *, ceiling_m: float | None, polygon: bool, retraces: bool
    ) -> dict[str, float]:
        """Return the parameters of the mission's fence.

        If a fence of the owner is active, the lower of the two ceilings applies, and the fence types of the owner stay
        enabled in addition to those of the mission. The owner's action stays if it brings the drone down. The drone
        must be inside every polygon.
        """
        action = _RETRACE if retraces else _RETURN
        kinds = (mavlink.FENCE_TYPE_ALT_MAX if ceiling_m is not None else 0) | (
            mavlink.FENCE_TYPE_POLYGON if polygon else 0
        )
        values = {ENABLE: 1.0, TYPE: float(kinds), ACTION: action}
        if owned.get(ENABLE, 0.0) != 0.0:
            before = int(owned.get(TYPE, 0))
            values[TYPE] = float(before | kinds)
            values[ACTION] = owned[ACTION] if owned.get(ACTION) in _COMES_DOWN else action
            if before & mavlink.FENCE_TYPE_ALT_MAX and ALTITUDE in owned:
                ceiling_m = owned[ALTITUDE] if ceiling_m is None else min(ceiling_m, owned[ALTITUDE])
        if ceiling_m is not None:
            values[ALTITUDE] = ceiling_m
        if int(owned.get(OPTIONS, 0)) & _UNION:
            values[OPTIONS] = float(int(owned[OPTIONS]) & ~_UNION)
        return {name: value for name, value in values.items() if name in owned or name == ENABLE}


def _leant_mps2(reader: ParameterReader) -> float:
    """Return the horizontal acceleration that the vehicle reaches within its lean angle, with a reserve for wind."""
    lean_deg = reader.read(_OWN_LEAN, 0.0, needed=False)
    if lean_deg <= 0.0:
        lean_deg = reader.read(_LEAN, _MAX_LEAN_DEG, needed=False)
    return _GRAVITY_MPS2 * math.tan(math.radians(min(lean_deg, _MAX_LEAN_DEG) - _WIND_LEAN_DEG))


ARDUCOPTER = ArduCopter()
