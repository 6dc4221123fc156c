"""The policy engine: a call in a situation under a grant becomes a verdict that explains itself (thesis 8.7).

Deny by default; the most restrictive policy wins, and among equals the one of higher priority.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from fractus_core.api.methods import CONTROL_METHODS, Method
from fractus_core.exhaustive import exhaustive
from fractus_core.policy.access import judge_access
from fractus_core.policy.compiled import CompiledGrant
from fractus_core.policy.corrections import settled
from fractus_core.policy.legs import judge_goto
from fractus_core.policy.monitoring import must_rest
from fractus_core.policy.motion import moving
from fractus_core.policy.privacy import judge_privacy
from fractus_core.policy.values import (
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
)
from fractus_core.policy.velocities import judge_speed, judge_velocity
from fractus_core.policy.vertical import judge_arm, judge_disarm, judge_land, judge_takeoff

MAX_ALTITUDE_M = 20_000.0
MIN_SPEED_MPS = 0.1
MAX_SPEED_MPS = 100.0
MAX_PIXELS = 20_000
MIN_TAKEOFF_ALTITUDE_M = 0.5
"""A takeoff goes at least this high."""
MAX_CLIMB_MPS = 20.0
HOLD_S = (0.1, 2.0)
"""A velocity setpoint is held this long."""


def judge(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """Decide on a call.

    Args:
        call: method and arguments as the component gave them.
        now: state of drone and node.
        grant: what the component may do.

    Returns:
        The verdict; an internal error is the caller's to turn into refusal and hover.
    """
    if not now.sound:
        now = _unsound(now)
    verdict = _judge_once(call, now, grant)
    if verdict.action == "correct" and call.method in _ARGS:
        verdict = _settle(call, verdict, now, grant)
    return replace(verdict, brake_first=True) if _must_brake(call, verdict, now, grant) else verdict


def _settle(call: Call, correction: Verdict, now: Situation, grant: CompiledGrant) -> Verdict:
    """A correction that holds; apart from `judge`, which a closure would have to allocate for on every call."""
    return settled(call, correction, lambda again: _judge_once(again, now, grant))


def _judge_once(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """The verdict on a call; what it corrects is not judged again."""
    problem = _check_arguments(call) or judge_access(call, now, grant)
    if problem is not None:
        return problem
    if call.method not in _RULES:
        return deny("MethodUnknown", f"the policy engine has no rule for {call.method}")
    return _RULES[call.method](call, now, grant)


def _must_brake(call: Call, verdict: Verdict, now: Situation, grant: CompiledGrant) -> bool:
    """Whether a moving drone must stop before anything else: it is taken over, or on its way into a fence."""
    if verdict.brake_first or not moving(now):
        return verdict.brake_first
    if verdict.permits:
        return call.method in _COURSES and must_rest(now, grant)
    return verdict.action == "takeover"


def _unsound(now: Situation) -> Situation:
    """A state with a figure that is not a number: nothing is known of where the drone is and how it moves.

    Raises:
        ValueError: not even the time is known.
    """
    if not math.isfinite(now.time_s):
        raise ValueError("the time is not a number")
    return Situation(time_s=now.time_s, armed=now.armed, in_air=now.in_air, vertical=now.vertical)


# Arguments


def _check_arguments(call: Call) -> Verdict | None:
    expected = _ARGS.get(call.method)
    if expected is not None and not isinstance(call.args, expected):
        return deny("InvalidArgument", f"{call.method} needs its arguments")
    for what, value, lower, upper, unit in _figures(call):
        if value is not None and not (math.isfinite(value) and lower <= value <= upper):
            return deny("InvalidArgument", f"{what} must be {lower:g} to {upper:g} {unit}, not {value:g}")
    return None


_Figure = tuple[str, float | None, float, float, str]


def _figures(call: Call) -> tuple[_Figure, ...]:  # noqa: PLR0911 - one line a method
    """The figures among the arguments, each with its bounds and unit."""
    match call.args:
        case TakeoffArgs(altitude_m):
            return (("altitude", altitude_m, MIN_TAKEOFF_ALTITUDE_M, MAX_ALTITUDE_M, "m above home"),)
        case SetSpeedArgs(speed_mps):
            return (("speed", speed_mps, MIN_SPEED_MPS, MAX_SPEED_MPS, "m/s"),)
        case GotoArgs(lat, lon, alt, _, yaw_deg, speed_mps):
            return (
                ("latitude", lat, -90, 90, "degrees"),
                ("longitude", lon, -180, 180, "degrees"),
                ("altitude", alt, -1000, MAX_ALTITUDE_M, "m"),
                ("yaw", yaw_deg, -360, 360, "degrees"),
                ("speed", speed_mps, MIN_SPEED_MPS, MAX_SPEED_MPS, "m/s"),
            )
        case VelocityArgs(north_mps, east_mps, down_mps, yaw_deg, hold_s):
            return (
                ("north", north_mps, -MAX_SPEED_MPS, MAX_SPEED_MPS, "m/s"),
                ("east", east_mps, -MAX_SPEED_MPS, MAX_SPEED_MPS, "m/s"),
                ("down", down_mps, -MAX_CLIMB_MPS, MAX_CLIMB_MPS, "m/s"),
                ("yaw", yaw_deg, -360, 360, "degrees"),
                ("hold", hold_s, *HOLD_S, "s"),
            )
        case PointGimbalArgs(pitch_deg, yaw_deg):
            return (("pitch", pitch_deg, -90, 90, "degrees"), ("yaw", yaw_deg, -180, 180, "degrees"))
        case CaptureArgs(width, height):
            return (("width", width, 0, MAX_PIXELS, "pixels"), ("height", height, 0, MAX_PIXELS, "pixels"))
        case _:
            return ()


_COURSES = frozenset({"Goto", "SetVelocity"})
"""Methods that give a flying drone another course."""

# What of a picture is corrected is the picture, not the call.
_ARGS: dict[str, type] = {
    "Takeoff": TakeoffArgs,
    "Goto": GotoArgs,
    "SetSpeed": SetSpeedArgs,
    "SetVelocity": VelocityArgs,
    "PointGimbal": PointGimbalArgs,
}


# Pictures


def _judge_picture(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    if call.method == "CaptureImage" and (now.lat is None or now.lon is None):
        return deny("PositionUnknown", "what the camera sees is unknown while its position is unknown; wait for a fix")
    verdict = judge_privacy(now, grant)
    return verdict if verdict.action == "deny" else replace(verdict, args=call.args)


def _judge_access_only(call: Call, now: Situation, grant: CompiledGrant) -> Verdict:
    """A method that stops the drone, brings it home, or moves nothing of it: access to it is enough.

    Where a gimbal points is no matter of the call: pictures are judged by what it measures, no matter who moved it.
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
