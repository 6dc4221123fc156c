"""ArduCopter: its modes, parameters, failsafes, fence and texts, from 4.5 to the names of 4.7."""

from __future__ import annotations

import math
from collections.abc import Mapping

from fractus_core.control.values import FlightMode, ModeKind
from fractus_core.policy.values import Airframe
from fractus_mavlink.enums import COPTER_MODE, FENCE_TYPE

from fractus_services.mobility.mavlink.flight_stack import ParameterReader, Setting
from fractus_services.mobility.mavlink.link import SYSTEM_ID

_KINDS = {
    COPTER_MODE.GUIDED: ModeKind.COMMANDED,
    COPTER_MODE.RTL: ModeKind.RETURNING,
    COPTER_MODE.SMART_RTL: ModeKind.RETURNING,
    COPTER_MODE.AUTO_RTL: ModeKind.RETURNING,
    COPTER_MODE.LAND: ModeKind.LANDING,
}
_MODES = {int(mode): FlightMode(mode.name, _KINDS.get(mode, ModeKind.OTHER)) for mode in COPTER_MODE}
_NUMBERS = {mode: number for number, mode in _MODES.items()}

_LISTENS = "listens for the companion's heartbeats, and takes no ground station for it"
# Releases that know the new name can take a whole range of systems for the companion.
_LISTENS_TO_ONE = Setting(
    ("MAV_GCS_SYSID_HI",), 0, frozenset(float(n) for n in range(1, SYSTEM_ID + 1)), False, _LISTENS
)

# FS_GCS_ENABLE and FENCE_ACTION: returns, or goes back on its path. BATT_FS_LOW_ACT numbers them otherwise.
_RETURN, _RETRACE = 1.0, 3.0

ENABLE, TYPE, ALTITUDE, ACTION, OPTIONS = "FENCE_ENABLE", "FENCE_TYPE", "FENCE_ALT_MAX", "FENCE_ACTION", "FENCE_OPTIONS"
_UNION = 2
"""Bit of FENCE_OPTIONS: it is enough to be inside one of the polygons."""
_DEFAULT_FENCES = float(FENCE_TYPE.ALT_MAX | FENCE_TYPE.CIRCLE | FENCE_TYPE.POLYGON)
_DEFAULT_MARGIN_M = 2.0


class ArduCopter:
    """The seam's side of ArduCopter, see `FlightStack`."""

    guided = _MODES[COPTER_MODE.GUIDED]
    land = _MODES[COPTER_MODE.LAND]
    return_straight = _MODES[COPTER_MODE.RTL]
    return_retracing = _MODES[COPTER_MODE.SMART_RTL]

    witness = "FS_GCS_ENABLE"
    failsafes: tuple[Setting, ...] = (
        Setting(
            ("SYSID_MYGCS", "MAV_GCS_SYSID"), SYSTEM_ID, frozenset(), True, _LISTENS, {"MAV_GCS_SYSID": _LISTENS_TO_ONE}
        ),
        Setting(("FS_GCS_TIMEOUT",), 5, frozenset(), False, "after five seconds of silence"),
        Setting(("GUID_TIMEOUT",), 1, frozenset(), False, "gives a velocity up after a second without another"),
        Setting(("BATT_FS_CRT_ACT",), 1, frozenset({1.0}), False, "lands on a critical battery"),
        Setting(("FS_EKF_ACTION",), 1, frozenset({1.0, 3.0}), False, "lands when it no longer knows where it is"),
    )
    straight: tuple[Setting, ...] = (
        Setting(("FS_GCS_ENABLE",), _RETURN, frozenset(), True, "returns to launch when the companion falls silent"),
        Setting(("BATT_FS_LOW_ACT",), 2, frozenset({1.0, 2.0}), False, "returns to launch on a low battery"),
    )
    retracing: tuple[Setting, ...] = (
        Setting(
            ("FS_GCS_ENABLE",), _RETRACE, frozenset({4.0}), True, "goes back the way it came when the companion falls silent"
        ),
        Setting(("BATT_FS_LOW_ACT",), 3, frozenset({1.0, 4.0}), False, "goes back the way it came on a low battery"),
    )  # fmt: skip
    path_memory = ("SRTL_POINTS", 100.0)

    fence_switch = ENABLE
    fence_parameters: tuple[str, ...] = (TYPE, ALTITUDE, ACTION, OPTIONS, ENABLE)

    def mode(self, custom_mode: int) -> FlightMode:
        """The mode of a number; one of a later release has only that for its name, and is a pilot's."""
        return _MODES.get(custom_mode) or FlightMode(f"MODE{custom_mode}")

    def mode_parameters(self, mode: FlightMode) -> tuple[float, ...]:
        """Its number."""
        return (float(_NUMBERS[mode]),)

    def explains_refusal(self, text: str) -> bool:
        """Texts of the checks before arming, modes and takeoff."""
        return text.startswith(("Arm", "PreArm", "Mode", "Takeoff"))

    def tells_failsafe(self, text: str) -> bool:
        """`GCS Failsafe`, `Battery 1 is low ... failsafe`, `Fence breached`; not `Failsafe Cleared`."""
        return ("ailsafe" in text or "fence" in text.lower()) and "leared" not in text

    def tells_path_lost(self, text: str) -> bool:
        """SmartRTL ran out of memory, or of time to simplify the path."""
        return text.startswith("SmartRTL deactivated")

    async def airframe(self, reader: ParameterReader, known: Airframe, speed_mps: float) -> tuple[Airframe, float]:
        """Accelerations and gains of its position controller; releases before 4.7 have centimetres, later ones metres."""
        read = reader.read
        accel = await read((("WPNAV_ACCEL", 0.01), ("WP_ACC", 1.0)), known.accel_mps2)
        gain = await read((("PSC_POSXY_P", 1.0), ("PSC_NE_POS_P", 1.0)), known.position_gain)
        climb = await read((("WPNAV_ACCEL_Z", 0.01), ("WP_ACC_Z", 1.0)), known.climb_accel_mps2)
        jerk = await read((("PSC_JERK_XY", 1.0), ("PSC_JERK_NE", 1.0)), known.jerk_mps3)
        height_m = await self.return_altitude_m(reader, known.return_altitude_m)
        speed = await read((("WPNAV_SPEED", 0.01), ("WP_SPD", 1.0)), speed_mps)
        airframe = Airframe(
            accel_mps2=max(accel, 0.1),
            position_gain=max(gain, 0.1),
            climb_accel_mps2=max(climb, 0.1),
            jerk_mps3=max(jerk, 0.5),
            return_altitude_m=height_m,
        )
        return airframe, speed

    async def return_altitude_m(self, reader: ParameterReader, known_m: float) -> float:
        """RTL_ALT, but never above its own fence's ceiling, less the fence's margin."""

        async def read(name: str, default: float) -> float:
            return await reader.read(((name, 1.0),), default)

        wrong = len(reader.problems)
        height_m = await reader.read((("RTL_ALT", 0.01), ("RTL_ALT_M", 1.0)), known_m)
        fenced = await read(ENABLE, 0.0) or await read("FENCE_AUTOENABLE", 0.0)
        if fenced and int(await read(TYPE, _DEFAULT_FENCES)) & FENCE_TYPE.ALT_MAX:
            ceiling_m = await read(ALTITUDE, math.inf)
            if math.isinf(ceiling_m) and len(reader.problems) == wrong:
                reader.problems.append(f"{ALTITUDE} cannot be read")
            height_m = min(height_m, ceiling_m - await read("FENCE_MARGIN", _DEFAULT_MARGIN_M))
        return known_m if len(reader.problems) > wrong else height_m

    def fence_values(
        self, owned: Mapping[str, float], *, ceiling_m: float | None, polygon: bool, retraces: bool
    ) -> dict[str, float]:
        """The lower ceiling, both kinds of fence, the owner's action; and inside every polygon, not only inside one."""
        action = _RETRACE if retraces else _RETURN
        kinds = (FENCE_TYPE.ALT_MAX if ceiling_m is not None else 0) | (FENCE_TYPE.POLYGON if polygon else 0)
        values = {ENABLE: 1.0, TYPE: float(kinds), ACTION: action}
        if owned.get(ENABLE, 0.0) != 0.0:
            before = int(owned.get(TYPE, 0))
            values[TYPE] = float(before | kinds)
            values[ACTION] = owned.get(ACTION, 0.0) or action
            if before & FENCE_TYPE.ALT_MAX and ALTITUDE in owned:
                ceiling_m = owned[ALTITUDE] if ceiling_m is None else min(ceiling_m, owned[ALTITUDE])
        if ceiling_m is not None:
            values[ALTITUDE] = ceiling_m
        if int(owned.get(OPTIONS, 0)) & _UNION:
            values[OPTIONS] = float(int(owned[OPTIONS]) & ~_UNION)
        return {name: value for name, value in values.items() if name in owned or name == ENABLE}


ARDUCOPTER = ArduCopter()
