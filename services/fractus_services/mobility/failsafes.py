"""The autopilot as the last line: its own failsafes, set and read back before anything may arm."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace

from fractus_core.policy.values import Airframe

from fractus_services.mobility.autopilot import SYSTEM_ID, Autopilot

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Setting:
    """One parameter that must hold.

    Attributes:
        names: its name, and older or newer spellings of it.
        value: what it is set to.
        accepted: values that may stay as they are.
        needed: whether arming is refused when the vehicle does not have it.
        why: what it does, for people.
    """

    names: tuple[str, ...]
    value: float
    accepted: frozenset[float]
    needed: bool
    why: str


_LISTENS = "listens for the companion's heartbeats, and takes no ground station for it"
_OLD_NAME, _NEW_NAME = "SYSID_MYGCS", "MAV_GCS_SYSID"

SETTINGS = (
    Setting((_OLD_NAME, _NEW_NAME), SYSTEM_ID, frozenset(), True, _LISTENS),
    Setting(("FS_GCS_TIMEOUT",), 5, frozenset(), False, "after five seconds of silence"),
    Setting(("GUID_TIMEOUT",), 1, frozenset(), False, "gives a velocity up after a second without another"),
    Setting(("BATT_FS_CRT_ACT",), 1, frozenset({1.0}), False, "lands on a critical battery"),
    Setting(("FS_EKF_ACTION",), 1, frozenset({1.0, 3.0}), False, "lands when it no longer knows where it is"),
)

STRAIGHT = (
    Setting(("FS_GCS_ENABLE",), 1, frozenset(), True, "returns to launch when the companion falls silent"),
    Setting(("BATT_FS_LOW_ACT",), 2, frozenset({1.0, 2.0}), False, "returns to launch on a low battery"),
)
RETRACING = (
    Setting(("FS_GCS_ENABLE",), 3, frozenset({4.0}), True, "goes back the way it came when the companion falls silent"),
    Setting(("BATT_FS_LOW_ACT",), 3, frozenset({1.0, 4.0}), False, "goes back the way it came on a low battery"),
)
"""The failsafes that bring the drone home, straight or on its own path (SmartRTL)."""

PATH_POINTS = 100.0
"""A vehicle that remembers fewer points of its path (SRTL_POINTS) is not relied on to find back on it."""

RANGE = Setting(("MAV_GCS_SYSID_HI",), 0, frozenset(float(n) for n in range(1, SYSTEM_ID + 1)), False, _LISTENS)
"""Releases that know the new name can take a whole range of systems for the companion."""


BEING_SET = "they are being set"
"""The problem of failsafes that are not read back yet."""

Names = tuple[tuple[str, float], ...]
"""A parameter's name, and older or newer spellings of it, each with what its values are multiplied by."""

_RETURN_ALTITUDE: Names = (("RTL_ALT", 0.01), ("RTL_ALT_M", 1.0))
_USUAL_FENCES, _USUAL_MARGIN_M, _CEILING = 7.0, 2.0, 1


@dataclass(frozen=True, slots=True)
class Checked:
    """What the autopilot will do by itself, and what it will not.

    Attributes:
        problem: why nothing may arm; empty when every needed failsafe was read back.
        missing: optional ones that the vehicle does not offer.
        remembers: whether the vehicle can go back the way it came; `airframe.retraces` says that its failsafes will.
        airframe: how it moves, from its own parameters.
        speed_mps: the speed it flies legs with.
    """

    problem: str
    missing: tuple[str, ...]
    airframe: Airframe
    speed_mps: float
    remembers: bool = False


async def configure(autopilot: Autopilot) -> Checked:
    """Set the failsafes, read each one back, and learn how the vehicle moves.

    Raises:
        AutopilotError: the link broke.
    """
    problems: list[str] = []
    missing: list[str] = []
    for setting in SETTINGS:
        name, problem = await _establish(autopilot, setting)
        if not name:
            missing.append(setting.names[0])
        problems.extend(filter(None, [problem]))
        if name == _NEW_NAME:
            problems.extend(filter(None, [(await _establish(autopilot, RANGE))[1]]))
    remembers = (await autopilot.read_parameter("SRTL_POINTS", attempts=2) or 0.0) >= PATH_POINTS
    retraces, wrong = await _choose(autopilot, retrace=remembers)
    problems += wrong
    airframe, speed, unsound = await _airframe(autopilot)
    problems.extend(_not_numbers(unsound))
    airframe = replace(airframe, retraces=retraces)
    checked = Checked("; ".join(problems), tuple(missing), airframe, speed, remembers)
    if checked.problem:
        log.error("failsafes are not verified, arming is refused: %s", checked.problem)
    else:
        log.info("failsafes are set and read back%s", f"; not offered: {', '.join(missing)}" if missing else "")
    return checked


async def choose_return(autopilot: Autopilot, checked: Checked, *, retrace: bool) -> Checked:
    """Let the failsafes bring the drone home straight, or, where the vehicle can, on the path that it came.

    Raises:
        AutopilotError: the link broke.
    """
    retrace = retrace and checked.remembers
    if retrace == checked.airframe.retraces or checked.problem:
        return checked
    retraces, problems = await _choose(autopilot, retrace=retrace)
    return replace(checked, problem="; ".join(problems), airframe=replace(checked.airframe, retraces=retraces))


async def learn_return(autopilot: Autopilot, checked: Checked) -> Checked:
    """Learn at which altitude the autopilot flies home by itself, under the fence that it has by now.

    Raises:
        AutopilotError: the link broke.
    """
    unsound: list[str] = []
    height_m = await _return_altitude_m(autopilot, unsound)
    problem = "; ".join(filter(None, [checked.problem, *_not_numbers(unsound)]))
    return replace(checked, problem=problem, airframe=replace(checked.airframe, return_altitude_m=height_m))


async def _choose(autopilot: Autopilot, *, retrace: bool) -> tuple[bool, list[str]]:
    """Whether the failsafes retrace the path now, and what does not hold."""
    if retrace:
        problems = [problem for setting in RETRACING if (problem := (await _establish(autopilot, setting))[1])]
        if not problems:
            return True, []
        log.warning("the drone will fly home straight: %s", "; ".join(problems))
    return False, [problem for setting in STRAIGHT if (problem := (await _establish(autopilot, setting))[1])]


async def _establish(autopilot: Autopilot, setting: Setting) -> tuple[str, str]:
    """The name under which the vehicle has the setting, empty when it has none, and a problem when it does not hold."""
    for name in setting.names:
        found = await autopilot.read_parameter(name, attempts=3)
        if found is None:
            continue
        if found == setting.value or found in setting.accepted:
            return name, ""
        after = await autopilot.write_parameter(name, setting.value)
        if after is not None and abs(after - setting.value) < 1e-6:
            log.info("set %s from %g to %g: the autopilot %s", name, found, setting.value, setting.why)
            return name, ""
        return name, f"{name} is {found:g} and cannot be set to {setting.value:g} (the autopilot {setting.why})"
    return "", f"the autopilot has no {' or '.join(setting.names)} ({setting.why})" if setting.needed else ""


async def _airframe(autopilot: Autopilot) -> tuple[Airframe, float, list[str]]:
    """How the vehicle moves, the speed of its legs, and the parameters that are not numbers."""
    unsound: list[str] = []

    async def read(names: Names, default: float) -> float:
        return await _read(autopilot, names, default, unsound)

    standard = Airframe()
    accel = await read((("WPNAV_ACCEL", 0.01), ("WP_ACC", 1.0)), standard.accel_mps2)
    gain = await read((("PSC_POSXY_P", 1.0), ("PSC_NE_POS_P", 1.0)), standard.position_gain)
    climb = await read((("WPNAV_ACCEL_Z", 0.01), ("WP_ACC_Z", 1.0)), standard.climb_accel_mps2)
    jerk = await read((("PSC_JERK_XY", 1.0), ("PSC_JERK_NE", 1.0)), standard.jerk_mps3)
    height = await _return_altitude_m(autopilot, unsound)
    speed = await read((("WPNAV_SPEED", 0.01), ("WP_SPD", 1.0)), 5.0)
    airframe = Airframe(
        accel_mps2=max(accel, 0.1),
        position_gain=max(gain, 0.1),
        climb_accel_mps2=max(climb, 0.1),
        jerk_mps3=max(jerk, 0.5),
        return_altitude_m=height,
    )
    return airframe, speed, unsound


async def _read(autopilot: Autopilot, names: Names, default: float, unsound: list[str]) -> float:
    for name, scale in names:
        value = await autopilot.read_parameter(name, attempts=2)
        if value is not None and math.isfinite(value):
            return value * scale
        if value is not None:
            unsound.append(name)
            return default
    return default


async def _return_altitude_m(autopilot: Autopilot, unsound: list[str]) -> float:
    """How high the autopilot climbs to fly home: never above its own fence's ceiling, less the fence's margin."""

    async def read(name: str, default: float) -> float:
        return await _read(autopilot, ((name, 1.0),), default, unsound)

    height_m = await _read(autopilot, _RETURN_ALTITUDE, Airframe().return_altitude_m, unsound)
    fenced = await read("FENCE_ENABLE", 0.0) or await read("FENCE_AUTOENABLE", 0.0)
    if not fenced or not int(await read("FENCE_TYPE", _USUAL_FENCES)) & _CEILING:
        return height_m
    return min(height_m, await read("FENCE_ALT_MAX", math.inf) - await read("FENCE_MARGIN", _USUAL_MARGIN_M))


def _not_numbers(names: list[str]) -> list[str]:
    return [f"{name} is not a number" for name in names]
