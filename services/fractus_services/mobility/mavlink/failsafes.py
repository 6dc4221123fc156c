"""The autopilot as the last line: its own failsafes, set and read back before anything may arm."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace

from fractus_core.policy.values import Airframe

from fractus_services.mobility.mavlink.autopilot import ATTEMPTS, Autopilot
from fractus_services.mobility.mavlink.link import SYSTEM_ID

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
_USUAL_MPS = 5.0


@dataclass(frozen=True, slots=True)
class Checked:
    """What the autopilot will do by itself, and what it will not.

    Attributes:
        problem: why nothing may arm; empty when every needed failsafe was read back.
        missing: optional ones that the vehicle does not offer.
        remembers: whether the vehicle can go back the way it came; `airframe.retraces` says that its failsafes will.
        airframe: how it moves, from its own parameters.
        speed_mps: the speed it flies legs with.
        known: parameters of its movements that it has told.
    """

    problem: str
    missing: tuple[str, ...]
    airframe: Airframe
    speed_mps: float
    remembers: bool = False
    known: frozenset[str] = frozenset()


class _Reader:
    """Reads parameters of how the vehicle moves, and keeps what is wrong with them.

    Args:
        autopilot: the link.
        known: parameters that the vehicle has told before: they can only be lost, not missing.

    Attributes:
        known: those, and what it tells now.
        problems: which are not numbers, or lost.
    """

    def __init__(self, autopilot: Autopilot, known: frozenset[str] = frozenset()) -> None:
        self._autopilot = autopilot
        self.known = known
        self.problems: list[str] = []

    async def read(self, names: Names, default: float) -> float:
        """A parameter's value; the default when it has none that can be used."""
        told = [name for name, _ in names if name in self.known]
        for name, scale in names:
            value = await self._autopilot.read_parameter(name, attempts=ATTEMPTS if name in told else 2)
            if value is None:
                continue
            self.known |= {name}
            if math.isfinite(value):
                return value * scale
            self.problems.append(f"{name} is not a number")
            return default
        self.problems.extend(f"{name} cannot be read any more" for name in told)
        return default


async def configure(autopilot: Autopilot, *, flying: bool = False, before: Checked | None = None) -> Checked:
    """Set the failsafes, read each one back, and learn how the vehicle moves.

    In flight the way home stays as it was chosen when the drone was armed, and what cannot be read as it was.

    Args:
        autopilot: the link.
        flying: whether the motors run.
        before: what was known in this flight until now.

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
    before = before if flying else None
    points = await autopilot.read_parameter("SRTL_POINTS", attempts=2)
    remembers = before.remembers if before is not None and points is None else (points or 0.0) >= PATH_POINTS
    retrace = remembers and (not flying or await _chosen(autopilot, before))
    retraces, wrong = await _choose(autopilot, retrace=retrace)
    reader = _Reader(autopilot, before.known if before is not None else frozenset())
    airframe, speed = await _airframe(reader, before)
    problems += wrong + reader.problems
    airframe = replace(airframe, retraces=retraces)
    checked = Checked("; ".join(problems), tuple(missing), airframe, speed, remembers, reader.known)
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

    What was known and cannot be read now stays as it was, and is a problem.

    Raises:
        AutopilotError: the link broke.
    """
    reader = _Reader(autopilot, checked.known)
    height_m = await _return_altitude_m(reader, checked.airframe.return_altitude_m)
    problem = "; ".join(filter(None, [checked.problem, *reader.problems]))
    airframe = replace(checked.airframe, return_altitude_m=height_m)
    return replace(checked, problem=problem, airframe=airframe, known=reader.known)


async def _chosen(autopilot: Autopilot, before: Checked | None) -> bool:
    """Whether the path was chosen as the way home of the flight under way; the vehicle knows when nobody else does."""
    if before is not None:
        return before.airframe.retraces
    companion = RETRACING[0]
    value = await autopilot.read_parameter(companion.names[0])
    return value is not None and value in companion.accepted | {companion.value}


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


async def _airframe(reader: _Reader, before: Checked | None) -> tuple[Airframe, float]:
    """How the vehicle moves, and the speed of its legs."""
    read = reader.read
    standard, usual_mps = (before.airframe, before.speed_mps) if before is not None else (Airframe(), _USUAL_MPS)
    accel = await read((("WPNAV_ACCEL", 0.01), ("WP_ACC", 1.0)), standard.accel_mps2)
    gain = await read((("PSC_POSXY_P", 1.0), ("PSC_NE_POS_P", 1.0)), standard.position_gain)
    climb = await read((("WPNAV_ACCEL_Z", 0.01), ("WP_ACC_Z", 1.0)), standard.climb_accel_mps2)
    jerk = await read((("PSC_JERK_XY", 1.0), ("PSC_JERK_NE", 1.0)), standard.jerk_mps3)
    height = await _return_altitude_m(reader, standard.return_altitude_m)
    speed = await read((("WPNAV_SPEED", 0.01), ("WP_SPD", 1.0)), usual_mps)
    airframe = Airframe(
        accel_mps2=max(accel, 0.1),
        position_gain=max(gain, 0.1),
        climb_accel_mps2=max(climb, 0.1),
        jerk_mps3=max(jerk, 0.5),
        return_altitude_m=height,
    )
    return airframe, speed


async def _return_altitude_m(reader: _Reader, usual_m: float) -> float:
    """How high the autopilot climbs to fly home: never above its own fence's ceiling, less the fence's margin."""

    async def read(name: str, default: float) -> float:
        return await reader.read(((name, 1.0),), default)

    wrong = len(reader.problems)
    height_m = await reader.read(_RETURN_ALTITUDE, usual_m)
    fenced = await read("FENCE_ENABLE", 0.0) or await read("FENCE_AUTOENABLE", 0.0)
    if fenced and int(await read("FENCE_TYPE", _USUAL_FENCES)) & _CEILING:
        ceiling_m = await read("FENCE_ALT_MAX", math.inf)
        if math.isinf(ceiling_m) and len(reader.problems) == wrong:
            reader.problems.append("FENCE_ALT_MAX cannot be read")
        height_m = min(height_m, ceiling_m - await read("FENCE_MARGIN", _USUAL_MARGIN_M))
    return usual_m if len(reader.problems) > wrong else height_m
