"""Policy engine: judges a call in a situation under a grant and returns a verdict with its reason (thesis 8.7).

Calls are denied by default. The most restrictive policy wins. Among equally restrictive policies the one of higher
priority wins.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import shapely

from fractus_core.api.methods import CONTROL_METHODS, Method
from fractus_core.api.names import component_name
from fractus_core.exhaustive import exhaustive
from fractus_core.policy.compiled_grant import (
    OPERATION_AREA,
    AirVolume,
    CompiledGrant,
    PolicyIndex,
    Rule,
    band_surely_contains,
)
from fractus_core.policy.decision_types import (
    DENY_NO_ARGUMENTS,
    Call,
    CaptureArgs,
    GotoArgs,
    PointGimbalArgs,
    SetSpeedArgs,
    Situation,
    TakeoffArgs,
    VelocityArgs,
    Verdict,
    deny,
    format_distance,
)
from fractus_core.policy.goto_rules import judge_goto
from fractus_core.policy.limits import settle_correction
from fractus_core.policy.monitoring import must_stop_first
from fractus_core.policy.picture_rules import by_priority, judge_privacy, rule_names, rules_in_view
from fractus_core.policy.takeoff_landing_rules import judge_arm, judge_disarm, judge_land, judge_takeoff
from fractus_core.policy.velocity_rules import judge_speed, judge_velocity

MAX_ALTITUDE_M = 20_000.0
MIN_SPEED_MPS = 0.1
MAX_SPEED_MPS = 100.0
MAX_PIXELS = 20_000
MIN_TAKEOFF_ALTITUDE_M = 0.5
"""Lowest permitted takeoff altitude above home."""
MAX_CLIMB_MPS = 20.0
HOLD_S = (0.1, 2.0)
"""Shortest and longest hold time of a velocity setpoint."""


def judge(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """Decide on a call.

    Exceptions propagate. The caller must deny the call and hover.

    Args:
        call: Method and arguments as requested by the component.
        now: State of drone and node.
        grant: Permissions and restrictions of the component.
    """
    if not now.is_plausible:
        now = _with_unknown_motion(now)
    verdict = _judge_once(call, now, grant)
    if verdict.action == "correct" and call.method in _ARGUMENT_TYPES:
        verdict = settle_correction(call, verdict, lambda corrected: _judge_once(corrected, now, grant))
    if verdict.brake_first or not now.is_moving:
        return verdict
    # A moving drone stops before the result is carried out if the drone is taken over or is on its way into a fence.
    changes_course = verdict.permits and call.method in _COURSE_METHODS
    must_brake = verdict.action == "takeover" or (changes_course and must_stop_first(now, grant))
    return replace(verdict, brake_first=True) if must_brake else verdict


def _judge_once(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """Judge a call without judging its correction again."""
    expected = _ARGUMENT_TYPES.get(call.method)
    if expected is not None and not isinstance(call.args, expected):
        return DENY_NO_ARGUMENTS
    for field, name, lower, upper, unit in _ARGUMENT_BOUNDS.get(type(call.args), ()):
        value = getattr(call.args, field)
        if value is not None and not (math.isfinite(value) and lower <= value <= upper):
            return deny("InvalidArgument", f"{name} must be {lower:g} to {upper:g} {unit}, not {value:g}")
    problem = judge_access(call, now, grant)
    if problem is not None:
        return problem
    if call.method not in _RULES:
        return deny("MethodUnknown", f"the policy engine has no rule for {call.method}")
    return _RULES[call.method](call, now, grant)


def _with_unknown_motion(now: Situation) -> Situation:
    """Return a situation with unknown position and motion, which replaces a situation with implausible numbers.

    Raises:
        ValueError: The time is not a number.
    """
    if not math.isfinite(now.time_s):
        raise ValueError("the time is not a number")
    return Situation(time_s=now.time_s, armed=now.armed, in_air=now.in_air, vertical=now.vertical)


# Access to methods

PICTURE_METHODS = frozenset({"CaptureImage", "RetrieveImage"})
"""Methods that return pictures. A policy that denies such a method applies if the picture may show one of the policy's
zones. The methods are permitted only inside the operation area."""


def judge_access(call: Call, now: Situation, grant: CompiledGrant) -> Verdict | None:
    """Return the denial of a method that is not permitted at the present place and time, or None."""
    method = call.method
    if method not in grant.methods:
        return deny(
            "MethodNotGranted",
            f"the Grant of {component_name(grant.identity)} does not include {method}; add it to the component's services",
        )
    denied = judge_denials(method, now, grant)
    if denied is not None:
        return denied
    allowances = grant.allowances.get(method)
    if allowances is not None and not _is_allowed(allowances, now, grant):
        rules = by_priority(
            {p.rule.name: p.rule for p in allowances.zones} | {r.name: r for r in allowances.everywhere}
        )
        return deny("MethodNotGrantedHere", f"{method} is granted elsewhere or at other times only", rule_names(rules))
    if method in PICTURE_METHODS and grant.operation_area is not None:
        return _outside_operation_area(method, now, grant)
    return None


def judge_denials(method: str, now: Situation, grant: CompiledGrant) -> Verdict | None:
    """Return the denial of a method by a policy at the drone's position, or None.

    Methods of `PICTURE_METHODS` are judged by what a picture from this position may show.
    """
    denials = grant.denials.get(method)
    if denials is None:
        return None
    forbidding = rules_in_view(denials, now, grant) if method in PICTURE_METHODS else _rules_here(denials, now, grant)
    if not forbidding:
        return None
    return deny("MethodDenied", f"policy {forbidding[0].name} denies {method} here", rule_names(forbidding))


def _outside_operation_area(method: str, now: Situation, grant: CompiledGrant) -> Verdict | None:
    if now.lat is None or now.lon is None:
        return deny("PositionUnknown", f"{method} needs a known position; wait for a fix")
    position = shapely.points(grant.frame.xy(now.lat, now.lon))
    if grant.operation_area is None or grant.operation_area.covers(position):
        return None
    distance_m = grant.operation_area.distance(position)
    return deny(
        "OutsideOperationArea",
        f"{method} is granted inside the operation area, which is {format_distance(distance_m)} away",
        (OPERATION_AREA,),
    )


def _is_allowed(index: PolicyIndex, now: Situation, grant: CompiledGrant) -> bool:
    """Return True if at least one policy of an index permits its methods at the present position.

    A zone whose altitudes have an unknown datum permits nothing. At an uncertain time, one policy and one of its zones
    must be in force at all times between the readings.
    """
    if any(rule.surely_in_force(now.time_s) for rule in index.everywhere):
        return True
    position = grant.locate(now)
    if position is None:
        return False
    air = AirVolume(shapely.points(position), 0.0, now.altitude_m, now.altitude_m)
    return any(
        zone.surely_in_force(now.time_s)
        and band_surely_contains(zone.band, now.altitude_m, now.altitude_m, now.home, grant.flat_terrain)
        for zone in index.near(air, now, grant.flat_terrain)
    )


def _rules_here(index: PolicyIndex, now: Situation, grant: CompiledGrant) -> list[Rule]:
    """Return the policies of an index that may apply at the present position, by priority.

    While the position is unknown, the result contains every policy in force.
    """
    rules = {rule.name: rule for rule in index.everywhere if rule.in_force(now.time_s)}
    position = grant.locate(now)
    if position is None:
        return by_priority(rules | {p.rule.name: p.rule for p in index.zones if p.in_force(now.time_s)})
    lower_m = now.altitude_m - now.altitude_error_m
    upper_m = now.altitude_m + now.altitude_error_m
    air = AirVolume(shapely.points(position), now.position_error_m, lower_m, upper_m)
    for zone in index.near(air, now, grant.flat_terrain):
        rules[zone.rule.name] = zone.rule
    return by_priority(rules)


# Arguments


_ARGUMENT_BOUNDS: dict[type, tuple[tuple[str, str, float, float, str], ...]] = {
    TakeoffArgs: (("altitude_m", "altitude", MIN_TAKEOFF_ALTITUDE_M, MAX_ALTITUDE_M, "m above home"),),
    SetSpeedArgs: (("speed_mps", "speed", MIN_SPEED_MPS, MAX_SPEED_MPS, "m/s"),),
    GotoArgs: (
        ("lat", "latitude", -90, 90, "degrees"),
        ("lon", "longitude", -180, 180, "degrees"),
        ("alt", "altitude", -1000, MAX_ALTITUDE_M, "m"),
        ("yaw_deg", "yaw", -360, 360, "degrees"),
        ("speed_mps", "speed", MIN_SPEED_MPS, MAX_SPEED_MPS, "m/s"),
    ),
    VelocityArgs: (
        ("north_mps", "north", -MAX_SPEED_MPS, MAX_SPEED_MPS, "m/s"),
        ("east_mps", "east", -MAX_SPEED_MPS, MAX_SPEED_MPS, "m/s"),
        ("down_mps", "down", -MAX_CLIMB_MPS, MAX_CLIMB_MPS, "m/s"),
        ("yaw_deg", "yaw", -360, 360, "degrees"),
        ("hold_s", "hold", *HOLD_S, "s"),
    ),
    PointGimbalArgs: (
        ("pitch_deg", "pitch", -90, 90, "degrees"),
        ("yaw_deg", "yaw", -180, 180, "degrees"),
    ),
    CaptureArgs: (
        ("width", "width", 0, MAX_PIXELS, "pixels"),
        ("height", "height", 0, MAX_PIXELS, "pixels"),
    ),
}
"""Numbers among the arguments of each method: field, name in messages, lowest and highest value, and unit."""

_COURSE_METHODS = frozenset({"Goto", "SetVelocity"})
"""Methods that change the course of a flying drone."""

# Picture methods are missing here because their correction changes the picture, not the arguments.
_ARGUMENT_TYPES: dict[str, type] = {
    "Takeoff": TakeoffArgs,
    "Goto": GotoArgs,
    "SetSpeed": SetSpeedArgs,
    "SetVelocity": VelocityArgs,
    "PointGimbal": PointGimbalArgs,
}


# Pictures


def _judge_picture(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    if call.method == "CaptureImage" and (now.lat is None or now.lon is None):
        return deny("PositionUnknown", "the camera footprint is unknown while the position is unknown; wait for a fix")
    verdict = judge_privacy(now, grant)
    return verdict if verdict.action == "deny" else replace(verdict, args=call.args)


def _judge_access_only(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """Allow a method that needs only the access check, because it stops the drone, brings it home, or does not move it.

    PointGimbal belongs here because pictures are judged by the measured camera direction.
    """
    return Verdict("allow", call.args)


_RULES: dict[str, Callable[[Call, Situation, CompiledGrant], Verdict]] = exhaustive(
    Method,
    {
        "Arm": judge_arm,
        "Disarm": judge_disarm,
        "Takeoff": judge_takeoff,
        "Land": judge_land,
        "Goto": judge_goto,
        "SetSpeed": judge_speed,
        "SetVelocity": judge_velocity,
        "CaptureImage": _judge_picture,
        "RetrieveImage": _judge_picture,
        **dict.fromkeys(
            (
                "Hover",
                "GetSpeed",
                "GetPosition",
                "ReturnToLaunch",
                "ListImages",
                "DeleteImage",
                "PointGimbal",
                *CONTROL_METHODS,
            ),
            _judge_access_only,
        ),
    },
)
