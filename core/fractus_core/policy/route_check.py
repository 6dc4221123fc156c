"""State of the drone after permitted calls, for the judgement of a route that has not begun."""

from __future__ import annotations

from dataclasses import replace

from fractus_core.policy.compiled_grant import CompiledGrant, altitude_above_home_m
from fractus_core.policy.decision_types import Call, GotoArgs, SetSpeedArgs, Situation, TakeoffArgs, Verdict


def at_rest(now: Situation) -> Situation:
    """Return the state of an armed drone that does not move."""
    return replace(
        now, armed=True, north_mps=0.0, east_mps=0.0, down_mps=0.0, forward_mps2=None, pending=(), vertical=False
    )


def arrived(flown: GotoArgs, now: Situation, grant: CompiledGrant) -> Situation:
    """Return the state at the target of a leg. Without a usable altitude, the drone keeps its altitude."""
    altitude_m = None
    if flown.alt is not None:
        altitude_m = altitude_above_home_m(flown.alt, flown.reference, now.home, grant.flat_terrain)
    return replace(now, lat=flown.lat, lon=flown.lon, altitude_m=now.altitude_m if altitude_m is None else altitude_m)


def after(call: Call, verdict: Verdict, now: Situation, grant: CompiledGrant) -> Situation:
    """Return the state when the motion of a permitted call is complete.

    Args:
        call: The call.
        verdict: Its verdict, with the corrected arguments.
        now: State in which the call was judged.
        grant: Grant of the caller.
    """
    match verdict.args or call.args:
        case TakeoffArgs() as args:
            return replace(now, altitude_m=max(args.altitude_m, now.altitude_m), in_air=True)
        case GotoArgs() as args:
            return arrived(args, now, grant)
        case SetSpeedArgs() as args:
            return replace(now, speed_setpoint_mps=args.speed_mps)
    if call.method == "ReturnToLaunch" and now.home is not None:
        now = replace(now, lat=now.home.lat, lon=now.home.lon)
    if call.method in {"ReturnToLaunch", "Land"}:
        return replace(now, altitude_m=0.0, in_air=False)
    return now
