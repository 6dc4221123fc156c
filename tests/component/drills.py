"""Drills: short attacks on the services in virtual time, each of which must be prevented.

The mobility drills fly the mobility service with a fake autopilot (`mobility_world`), and the camera drills take pictures
with a fake camera (`camera_world`). A drill raises AssertionError if the platform does not keep its promise. `drill_faults`
contains faults of the platform that the drills must find.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import sys
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from fractus_core.api import Grant
from fractus_core.api.model import API_VERSION
from fractus_core.control import Authority
from fractus_core.policy.decision_types import CaptureArgs, GotoArgs, SetSpeedArgs, TakeoffArgs, VelocityArgs, Verdict
from fractus_core.policy.grant_signatures import BadSignature
from fractus_services.camera.pixels import decode_image
from fractus_services.errors import AutopilotError, Refused
from fractus_services.grant_files import ActiveGrant
from fractus_services.grant_verifier import GrantVerifier
from fractus_services.mobility.flight import authorization
from mobility_world import LAND, LOITER, RTL, SMART_RTL, World, area, clearance_m, end, goto, spec, zone
from virtual_time import run

sys.path.insert(0, str(Path(__file__).parents[1] / "unit"))

import camera_world
import grant_signing

Drill = Callable[[Path], Awaitable[None]]
WALL = (-40.0, 25.0, 40.0, 40.0)
"""Box of a zone, in metres east and north of home."""

BORDER_M = 200.0
"""Distance from home to each border of the operation area."""

LOWEST_MARGIN_M = 0.9
"""Distance that a leg must keep from a border: the position error of 0.5 m, and a part of the tracking error."""


def limit(kind: str, *, action: str = "enforce", **limits: float) -> dict[str, Any]:
    policy = {"type": "LimitControl", "kind": kind, "action": action, "selector": {}, **limits}
    return {"name": f"limit-{kind}", "spec": policy, "zones": []}


def stay_inside(action: str, *box: float) -> dict[str, Any]:
    inside = zone("town", action, *box)
    inside["spec"] = {**inside["spec"], "kind": "inclusion"}
    return inside


async def refused(method: Callable[..., Any], *arguments: Any) -> Verdict:
    """Return the verdict on a call that must be refused."""
    try:
        call = method(*arguments)
        await (end(call) if hasattr(call, "__aiter__") else call)
    except Refused as error:
        return error.verdict
    raise AssertionError(f"{method.__name__} was not refused")


async def denied(method: Callable[..., Any], *arguments: Any) -> str:
    """Return the code of a call that the policy engine must deny."""
    verdict = await refused(method, *arguments)
    assert verdict.action == "deny", f"expected a denial, observed {verdict.action} {verdict.code}"
    return verdict.code


async def corrected(world: World, call: Any) -> Any:
    """Return the arguments of a motion that the policy engine must correct."""
    verdict = (await end(call)).verdict
    assert verdict.action == "correct", f"expected a correction, observed {verdict.action}"
    return verdict.args


def outside_m(world: World) -> float:
    """Return the smallest distance that the flown track kept from the border of the operation area."""
    return BORDER_M - max(max(abs(x), abs(y)) for x, y, _ in world.plane.trace)


# Fences


async def target_outside_the_area_is_refused(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.up(grant)
        assert await denied(world.service.goto, grant, goto(0, 230), 0) == "OutsideOperationArea"
        assert math.dist(world.plane.xy, (0, 0)) < 1, "the drone must not move"


async def target_at_the_border_is_refused(directory: Path) -> None:
    """The engine keeps the margin itself. The monitor would stop the drone only at the border."""
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.up(grant)
        assert await denied(world.service.goto, grant, goto(0, BORDER_M - LOWEST_MARGIN_M), 0) == "OutsideOperationArea"


async def leg_through_a_zone_is_refused(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec(zone("wall", "ignore", *WALL)))
        await world.up(grant)
        assert await denied(world.service.goto, grant, goto(0, 60), 0) == "LegThroughExclusionZone"
        assert await denied(world.service.goto, grant, goto(0, 30), 0) == "InsideExclusionZone"
        assert world.control.authority is Authority.DRIVER


async def leg_beside_a_zone_keeps_its_margin(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec(zone("wall", "ignore", *WALL)))
        await world.up(grant)
        assert await denied(world.service.goto, grant, goto(0, 25 - LOWEST_MARGIN_M), 0) == "TooCloseToExclusionZone"


async def velocities_do_not_press_through_a_border(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec(zone("wall", "adjust", *WALL)))
        await world.up(grant)
        for _ in range(150):
            with contextlib.suppress(Refused, AutopilotError):
                await world.service.set_velocity(grant, VelocityArgs(6.0, 0.0, 0.0))
            await asyncio.sleep(0.1)
        assert clearance_m(world, *WALL) > 0.5, "the drone must stop before the zone"
        verdicts = {entry["action"] for entry in world.kinds("call") if entry["method"] == "SetVelocity"}
        assert verdicts & {"correct", "deny"}, "the engine must judge the velocities, and not leave them to the monitor"
        assert world.control.authority is Authority.DRIVER


async def target_without_legal_return_is_refused(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec(zone("wall", "ignore", *WALL)))
        await world.up(grant)
        await end(world.service.goto(grant, goto(60, 0), 0))
        assert await denied(world.service.goto, grant, goto(60, 60), 0) == "WayHomeBlocked"


async def driver_waits_until_its_corrected_leg_ends(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec(stay_inside("adjust", -60, -60, 60, 60)))
        await world.up(grant)
        going = asyncio.ensure_future(end(world.service.goto(grant, goto(0, 90), 0)))
        await world.until(lambda: world.plane.xy[1] > 8)
        assert (await refused(world.service.goto, grant, goto(0, 0), 0)).code == "Suspended"
        await going


async def goto_on_the_ground_is_refused(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.drive(grant)
        await world.service.arm(grant)
        assert (await refused(world.service.goto, grant, goto(0, 20), 0)).action == "deny"
        assert world.plane.goal is None or math.dist(world.plane.goal, (0, 0)) < 1


async def failing_engine_denies_and_stops(directory: Path) -> None:
    def fail(*_: object) -> Verdict:
        raise ZeroDivisionError

    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.up(grant)
        judge = authorization.judge
        authorization.judge = fail  # type: ignore[assignment]
        try:
            assert await denied(world.service.goto, grant, goto(0, 20), 0) == "InternalError"
        finally:
            authorization.judge = judge


async def adjusted_leg_ends_before_the_border(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec(stay_inside("adjust", -60, -60, 60, 60)))
        await world.up(grant)
        flown = await corrected(world, world.service.goto(grant, goto(0, 90), 0))
        assert isinstance(flown, GotoArgs)
        assert 40 < world.plane.xy[1] < 60 - LOWEST_MARGIN_M


async def action_takes_the_drone(
    directory: Path, action: str, flight_s: float = 60.0, start: tuple[float, float] = (0.0, 0.0)
) -> World:
    """Request a leg through a zone from a position in metres east and north of home. The action must take the drone."""
    async with World(directory) as world:
        grant = world.grants.put(spec(zone("wall", action, *WALL)))
        await world.up(grant)
        if start != (0.0, 0.0):
            await end(world.service.goto(grant, goto(*start), 0))
        assert (await refused(world.service.goto, grant, goto(0, 60), 0)).action == "takeover"
        await asyncio.sleep(flight_s)
        assert clearance_m(world, *WALL) > 0.5
        return world


async def hover_action_takes_the_drone(directory: Path) -> None:
    world = await action_takes_the_drone(directory, "hover", 3.0)
    assert world.control.authority is Authority.SYSTEM
    assert world.plane.vehicle.armed


async def land_action_lands_the_drone(directory: Path) -> None:
    world = await action_takes_the_drone(directory, "land")
    assert not world.plane.vehicle.armed
    assert world.plane.vehicle.mode == LAND


async def return_action_brings_the_drone_home(directory: Path) -> None:
    world = await action_takes_the_drone(directory, "returnToLaunch", 120.0, start=(-40.0, 0.0))
    assert not world.plane.vehicle.armed
    assert math.dist(world.plane.xy, (0, 0)) < 2, "the drone must fly home before it lands"
    assert [entry["action"] for entry in world.kinds("takeover")] == ["returnToLaunch"]
    assert world.outcome() == "" or "revoked" not in world.outcome()


async def revoke_action_ends_the_mission(directory: Path) -> None:
    world = await action_takes_the_drone(directory, "revoke")
    assert world.outcome().startswith("revoked:")
    assert not world.plane.vehicle.armed


async def zone_added_in_flight_stops_the_leg(directory: Path) -> None:
    """An accelerating drone must brake at once. The stopping path alone would stop it later, closer to the zone."""
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.up(grant)
        going = asyncio.ensure_future(refused(world.service.goto, grant, goto(0, 90), 0))
        await world.until(lambda: world.plane.xy[1] > 8)
        world.grants.put(spec(zone("wall", "revoke", *WALL)))
        assert (await going).code == "ExclusionZoneAhead"
        await asyncio.sleep(20)
        assert world.control.authority is Authority.DRIVER, "a drone that can stop must not be taken"
        assert clearance_m(world, *WALL) > 5


async def drone_that_is_blown_into_a_zone_is_taken(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec(zone("wall", "returnToLaunch", *WALL)))
        await world.up(grant)
        world.plane.xy[1] = 30.0
        await asyncio.sleep(1)
        assert world.control.authority is Authority.SYSTEM


async def scheduled_zone_applies_when_it_begins(directory: Path) -> None:
    async with World(directory) as world:
        wall = zone("wall", "ignore", *WALL)
        wall["zones"][0]["schedule"] = [{"validFrom": "2026-09-21T00:00:00Z"}]
        grant = world.grants.put(spec(wall))
        await world.up(grant)
        assert await denied(world.service.goto, grant, goto(0, 60), 0) == "LegThroughExclusionZone"


# Limits


async def altitude_limit_is_kept(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec(limit("altitude", upperLimit=30.0)))
        await world.up(grant)
        await corrected(world, world.service.goto(grant, goto(0, 20, 50.0), 0))
        assert max(height for _, _, height in world.plane.trace) < 30.5
        await end(world.service.goto(grant, goto(0, 30, 29.0), 0))


async def takeoff_above_the_limit_is_corrected(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec(limit("altitude", upperLimit=15.0)))
        await world.drive(grant)
        await world.service.arm(grant)
        await corrected(world, world.service.take_off(grant, TakeoffArgs(40.0)))
        assert world.plane.height < 15.5


async def altitude_limit_with_refusal_refuses(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec(limit("altitude", action="refuse", upperLimit=30.0)))
        await world.up(grant)
        assert await denied(world.service.goto, grant, goto(0, 20, 50.0), 0) == "AltitudeAboveLimit"


async def altitude_of_the_drone_is_limited_without_policies(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.up(grant)
        flown = await corrected(world, world.service.goto(grant, goto(0, 20, 90.0), 0))
        assert flown.alt <= 60


async def speed_limit_is_kept(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec(limit("speed", upperLimit=4.0)))
        await world.up(grant)
        _, speed = await world.service.set_speed(grant, SetSpeedArgs(11.0))
        assert speed <= 4
        flown = await corrected(world, world.service.goto(grant, goto(0, 60, speed_mps=10.0), 0))
        assert flown.speed_mps <= 4.0, "the engine must limit the leg before the monitor has to slow it down"
        await world.service.set_velocity(grant, VelocityArgs(-8.0, 0.0, 0.0))
        setpoint = world.plane.velocity_setpoint
        assert setpoint is not None
        assert math.hypot(setpoint[0], setpoint[1]) <= 4.0


async def speed_above_a_new_limit_is_reduced_in_flight(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.up(grant)
        going = asyncio.ensure_future(end(world.service.goto(grant, goto(0, 150), 0)))
        await world.until(lambda: world.plane.velocity[1] > 7)
        world.grants.put(spec(limit("speed", upperLimit=3.0)))
        await asyncio.sleep(5)
        assert math.hypot(*world.plane.velocity) < 3.5
        going.cancel()
        await asyncio.gather(going, return_exceptions=True)


async def altitude_above_a_new_limit_is_reduced_in_flight(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.up(grant, 40.0)
        world.grants.put(spec(limit("altitude", upperLimit=20.0)))
        await asyncio.sleep(30)
        assert world.plane.height < 21


# Arguments and methods


async def wrong_numbers_are_refused(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.up(grant)
        for args in (
            GotoArgs(math.nan, 22.95, 10.0),
            GotoArgs(39.36, math.inf, 10.0),
            GotoArgs(393.6, 22.95, 10.0),
            GotoArgs(39.36, 22.95, math.nan),
            GotoArgs(39.36, 22.95, 10.0, speed_mps=-3.0),
        ):
            assert await denied(world.service.goto, grant, args, 0) == "InvalidArgument"
        assert await denied(world.service.set_velocity, grant, VelocityArgs(math.nan, 0.0, 0.0)) == "InvalidArgument"
        assert await denied(world.service.goto, grant, goto(0, 20, 0.3), 0) == "AltitudeTooLow"


async def method_that_is_not_granted_is_refused(directory: Path) -> None:
    async with World(directory) as world:
        methods = ["Arm", "Takeoff", "Land", "GetPosition", "ReturnToLaunch", "Hover"]
        grant = world.grants.put(spec(services=[{"service": "mobility", "methods": methods}]))
        await world.up(grant)
        assert await denied(world.service.goto, grant, goto(0, 20), 0) == "MethodNotGranted"


async def method_that_a_policy_denies_is_refused_in_its_zone(directory: Path) -> None:
    async with World(directory) as world:
        denial = zone("quiet", "ignore", -10, -10, 10, 10)
        denial["spec"] = {
            "type": "AccessControl", "kind": "denial", "methods": ["Land"],
            "selector": {"zones": ["quiet-zone"]},
        }  # fmt: skip
        grant = world.grants.put(spec(denial))
        await world.up(grant)
        assert await denied(world.service.land, grant) == "MethodDenied"


# Control


async def disarm_in_flight_is_refused(directory: Path) -> None:
    """The engine refuses it. An autopilot refuses it too, which this drill's autopilot does not."""
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.up(grant)
        assert await denied(world.service.disarm, grant) == "InAir"
        assert world.plane.vehicle.armed


async def call_without_control_is_refused(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec())
        assert (await refused(world.service.arm, grant)).code == "NotInControl"
        assert not world.plane.vehicle.armed
        stream = await world.up(grant)
        other = world.grants.put(spec(instance="app-other", component="Other", application=OTHER), key="m2")
        assert (await refused(world.service.goto, other, goto(0, 20), 0)).code == "NotInControl"
        assert (await refused(world.service.land, other)).code == "NotInControl"
        assert not stream.done()


OTHER = {"namespace": "default", "name": "other", "uid": "u2"}


async def passenger_cannot_fly(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.up(grant)
        viewer = world.grants.put(
            spec(instance="app-viewer", component="Viewer", control=None, controlPoints=[], **{"class": "passenger"}),
            key="m2",
        )
        assert (await refused(world.service.goto, viewer, goto(0, 20), 0)).code == "NotADriver"


async def second_application_does_not_get_the_drone(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.up(grant)
        other = world.grants.put(spec(instance="app-other", component="Other", application=OTHER), key="m2")
        asking = asyncio.ensure_future(world.drive(other))
        await asyncio.sleep(10)
        lease = world.control.lease
        assert lease is not None
        assert lease.key == grant.key
        asking.cancel()
        await asyncio.gather(asking, return_exceptions=True)


async def removed_grant_takes_the_drone_at_once(directory: Path) -> None:
    """The system must act itself. Without that, permits stop the leg, and the drone only hovers with its driver."""
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.up(grant)
        going = asyncio.ensure_future(refused(world.service.goto, grant, goto(0, 150), 0))
        await world.until(lambda: world.plane.xy[1] > 8)
        world.grants.remove(grant)
        await asyncio.sleep(2)
        assert world.control.authority is Authority.SYSTEM, "the system must take the drone"
        await going
        await world.until(lambda: not world.plane.vehicle.armed)
        assert math.dist(world.plane.xy, (0, 0)) < 2
        assert world.outcome().startswith("revoked")


async def call_with_a_removed_grant_is_refused(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.drive(grant)
        world.grants.remove(grant)
        await refused(world.service.arm, grant)
        assert not world.plane.vehicle.armed


async def replaced_grant_applies_to_the_next_call(directory: Path) -> None:
    async with World(directory) as world:
        old = world.grants.put(spec())
        await world.up(old)
        new = world.grants.put(spec(operationArea=[area(-30, -30, 30, 30)]))
        assert world.control.latest(old) is new
        assert await denied(world.service.goto, world.control.latest(old), goto(0, 60), 0) == "OutsideOperationArea"
        lease = world.control.lease
        assert lease is not None
        assert lease.grant is new, "the monitor must use the latest Grant"


async def lost_driver_is_followed_by_a_return(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec())
        stream = await world.up(grant)
        await end(world.service.goto(grant, goto(0, 40), 0))
        stream.cancel()
        await world.until(lambda: not world.plane.vehicle.armed, 120)
        assert math.dist(world.plane.xy, (0, 0)) < 2
        assert world.plane.vehicle.mode in {RTL, SMART_RTL, LAND}
        codes = {entry["code"] for entry in world.kinds("takeover")}
        assert codes == {"DriverLost"}, "the drone must not be without control authority in between"


async def ended_mission_does_not_begin_again(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.up(grant)
        await end(world.service.goto(grant, goto(0, 70, 12.0), 0))
        assert await world.control.return_control(grant)
        await world.until(lambda: not world.plane.vehicle.armed)
        assert world.outcome().startswith("complete"), world.outcome()
        try:
            await world.drive(grant)
        except Refused:
            return
        raise AssertionError("a mission that has ended got control again")


async def unknown_position_stops_the_drone(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.up(grant)
        going = asyncio.ensure_future(refused(world.service.goto, grant, goto(0, 150), 0))
        await world.until(lambda: world.plane.xy[1] > 8)
        report_state = world.plane._report_state
        begun = world.plane.now

        def blind() -> None:
            report_state()
            world.plane.vehicle.position_at = begun

        world.plane._report_state = blind  # type: ignore[method-assign]
        await asyncio.sleep(8)
        assert math.hypot(*world.plane.velocity) < 0.5, "the drone must stop"
        code = (await going).code
        assert code in {"PositionUnknown", "AutopilotUnavailable"}, code


async def pilot_keeps_the_drone(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.up(grant)
        world.plane.set_to(LOITER)
        world.observer.heartbeat()
        await world.until(lambda: world.control.authority is Authority.PILOT, 10)
        assert (await refused(world.service.goto, grant, goto(0, 20), 0)).code == "NotInControl"
        await asyncio.sleep(5)
        assert world.plane.vehicle.mode == LOITER


async def drone_is_not_armed_without_its_failsafes(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.drive(grant)
        assert world.control.failsafe_status is not None
        world.control.failsafe_status = replace(world.control.failsafe_status, problem="FS_GCS_ENABLE is 0")
        assert (await refused(world.service.arm, grant)).code == "FailsafesNotVerified"
        assert not world.plane.vehicle.armed


async def drone_is_not_armed_without_its_fence(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.drive(grant)
        world.fence.problem = AutopilotError("no fence")
        assert (await refused(world.service.arm, grant)).code == "FenceNotRaised"
        assert not world.plane.vehicle.armed


async def drone_is_not_armed_without_its_audit_log(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec())
        await world.drive(grant)
        world.audit.failure = "the disk is full"
        assert (await refused(world.service.arm, grant)).code == "AuditUnavailable"


async def verdicts_are_in_the_audit_log(directory: Path) -> None:
    async with World(directory) as world:
        grant = world.grants.put(spec(zone("wall", "ignore", *WALL)))
        await world.up(grant)
        await refused(world.service.goto, grant, goto(0, 60), 0)
        entries = world.kinds("call")[-1:]
        observed = [(entry["caller"], entry["method"], entry["action"], entry["policies"]) for entry in entries]
        assert observed == [(grant.identity, "Goto", "deny", ["wall"])]


async def drone_far_from_its_home_does_not_arm(directory: Path) -> None:
    async with World(directory) as world:
        home = {"lat": 39.37, "lon": 22.95, "alt": 10.0, "altitudeReference": "amsl"}
        grant = world.grants.put(spec(home=home, operationArea=[area(-2000, -2000, 2000, 2000)]))
        await world.drive(grant)
        assert (await refused(world.service.arm, grant)).code == "NotAtHome"


# Grants


def _manifest(**changes: Any) -> dict[str, Any]:
    body = spec(**changes).to_dict()
    metadata = {"name": "g", "uid": "uid-g"}
    return {"apiVersion": API_VERSION, "kind": "Grant", "metadata": metadata, "spec": body}


def _verifier(directory: Path) -> GrantVerifier:
    (directory / "ca.crt").write_bytes(grant_signing.CA_PEM)
    verifier = GrantVerifier(directory, directory / "seen.json")
    verifier.reload_authorities()
    return verifier


def _rejected(verifier: GrantVerifier, manifest: Mapping[str, Any]) -> bool:
    try:
        verifier.verify(Grant.from_body(manifest))
    except BadSignature:
        return True
    return False


async def changed_grant_is_rejected(directory: Path) -> None:
    verifier = _verifier(directory)
    signed = grant_signing.signed(_manifest())
    forged = {**signed, "spec": {**signed["spec"], "limits": {"maxAltitude": 120, "maxSpeed": 15}}}
    assert _rejected(verifier, forged), "a Grant that was changed after its signature"
    assert _rejected(verifier, _manifest()), "a Grant without signature"
    assert not _rejected(verifier, signed)


async def replaced_and_revoked_grants_are_rejected(directory: Path) -> None:
    verifier = _verifier(directory)
    first, second = (grant_signing.signed(_manifest()) for _ in range(2))
    assert not _rejected(verifier, first)
    assert not _rejected(verifier, second)
    assert _rejected(verifier, first), "a Grant that a later one has replaced"
    digest = verifier.verify(Grant.from_body(second))
    verifier.revoke(spec().identity, digest)
    assert _rejected(verifier, second), "a revoked Grant"
    assert not verifier.is_latest(spec().identity, digest)


# Pictures. The camera uses threads, so these drills run in real time.


def _camera(directory: Path) -> camera_world.World:
    return camera_world.World(directory)


async def _taken(world: camera_world.World, grant: ActiveGrant) -> Any:
    _, record = await world.camera.capture(grant, CaptureArgs())
    *_, data = await world.stored_images.retrieve(grant, record.name)
    return decode_image(data.read_bytes() if isinstance(data, Path) else data)


async def picture_of_a_private_zone_is_refused(directory: Path) -> None:
    world = _camera(directory)
    world.drone.y = 0.0
    assert await camera_world.refusal(world.camera.capture(camera_world.active_grant(), CaptureArgs())) == "PrivacyZone"
    assert world.scene.taken == []


async def picture_is_judged_again_after_its_exposure(directory: Path) -> None:
    world = _camera(directory)
    world.scene.during = lambda: setattr(world.drone, "y", 0.0)
    assert await camera_world.refusal(world.camera.capture(camera_world.active_grant(), CaptureArgs())) == "PrivacyZone"


async def picture_beside_a_private_zone_is_judged_by_its_view(directory: Path) -> None:
    world = _camera(directory)
    world.drone.y = 24.0
    world.drone.alt = 30.0
    assert await camera_world.refusal(world.camera.capture(camera_world.active_grant(), CaptureArgs())) == "PrivacyZone"


async def filter_is_applied(directory: Path, action: str) -> float:
    """Return the standard deviation of a picture of noise."""
    world = _camera(directory)
    world.drone.y = 0.0
    grant = camera_world.active_grant(camera_world.private(action))
    return float(np.std(await _taken(world, grant)))


async def black_filter_is_applied(directory: Path) -> None:
    assert await filter_is_applied(directory, "black") < 1


async def blur_filter_is_applied(directory: Path) -> None:
    assert await filter_is_applied(directory, "blurAverage") < 40


async def strictest_of_two_filters_is_applied(directory: Path) -> None:
    world = _camera(directory)
    world.drone.y = 0.0
    policies = (camera_world.private("blurAverage"), camera_world.private("black", name="q"))
    assert float(np.std(await _taken(world, camera_world.active_grant(*policies)))) < 1


async def faces_are_hidden(directory: Path) -> None:
    world = _camera(directory)
    world.drone.y = 0.0
    world.drone.alt = 1.0
    world.finder.min_px = 0.0
    world.finder.boxes = [(16, 16, 32, 32)]
    picture = await _taken(world, camera_world.active_grant(camera_world.private("blurFaces")))
    face = np.asarray(picture)[24:40, 24:40]
    assert float(np.std(face)) < 45, "the face is visible"


async def small_faces_are_hidden_by_the_fallback(directory: Path) -> None:
    assert await filter_is_applied(directory, "blurFaces") < 40


async def new_policy_applies_to_a_stored_picture(directory: Path) -> None:
    world = _camera(directory)
    world.drone.y = 0.0
    free = camera_world.active_grant(_elsewhere())
    _, record = await world.camera.capture(free, CaptureArgs())
    private = camera_world.active_grant()
    world.drone.y = 80.0
    assert await camera_world.refusal(world.stored_images.retrieve(private, record.name)) == "PrivacyZone"


def _elsewhere() -> dict[str, Any]:
    from policy_world import box, policy
    from policy_world import zone as policy_zone

    area = [policy_zone("far", box(900, 900, 950, 950))]
    return policy("p", "PrivacyControl", "camera", area, action="refuse")


async def picture_of_another_owner_is_not_found(directory: Path) -> None:
    world = _camera(directory)
    own = camera_world.active_grant()
    _, record = await world.camera.capture(own, CaptureArgs())
    other = camera_world.active_grant(uid="u2", instance="other-viewer")
    assert await camera_world.refusal(world.stored_images.retrieve(other, record.name))
    assert (await world.stored_images.list(other))[1] == ()


MOBILITY_DRILLS: tuple[Drill, ...] = (
    target_outside_the_area_is_refused, target_at_the_border_is_refused, leg_through_a_zone_is_refused,
    leg_beside_a_zone_keeps_its_margin, target_without_legal_return_is_refused, driver_waits_until_its_corrected_leg_ends,
    goto_on_the_ground_is_refused, failing_engine_denies_and_stops, velocities_do_not_press_through_a_border, adjusted_leg_ends_before_the_border,
    hover_action_takes_the_drone, land_action_lands_the_drone, return_action_brings_the_drone_home,
    revoke_action_ends_the_mission, zone_added_in_flight_stops_the_leg, drone_that_is_blown_into_a_zone_is_taken,
    scheduled_zone_applies_when_it_begins, altitude_limit_is_kept, takeoff_above_the_limit_is_corrected,
    altitude_limit_with_refusal_refuses, altitude_of_the_drone_is_limited_without_policies, speed_limit_is_kept,
    speed_above_a_new_limit_is_reduced_in_flight, altitude_above_a_new_limit_is_reduced_in_flight,
    wrong_numbers_are_refused, method_that_is_not_granted_is_refused,
    method_that_a_policy_denies_is_refused_in_its_zone, disarm_in_flight_is_refused, call_without_control_is_refused,
    passenger_cannot_fly, second_application_does_not_get_the_drone, removed_grant_takes_the_drone_at_once,
    call_with_a_removed_grant_is_refused, replaced_grant_applies_to_the_next_call, lost_driver_is_followed_by_a_return,
    ended_mission_does_not_begin_again, unknown_position_stops_the_drone, pilot_keeps_the_drone,
    drone_is_not_armed_without_its_failsafes, drone_is_not_armed_without_its_fence,
    drone_is_not_armed_without_its_audit_log, verdicts_are_in_the_audit_log, drone_far_from_its_home_does_not_arm,
    changed_grant_is_rejected, replaced_and_revoked_grants_are_rejected,
)  # fmt: skip
CAMERA_DRILLS: tuple[Drill, ...] = (
    picture_of_a_private_zone_is_refused, picture_is_judged_again_after_its_exposure,
    picture_beside_a_private_zone_is_judged_by_its_view, black_filter_is_applied, blur_filter_is_applied,
    strictest_of_two_filters_is_applied,
    faces_are_hidden, small_faces_are_hidden_by_the_fallback, new_policy_applies_to_a_stored_picture,
    picture_of_another_owner_is_not_found,
)  # fmt: skip
DRILLS: Mapping[str, Drill] = {drill.__name__: drill for drill in (*MOBILITY_DRILLS, *CAMERA_DRILLS)}
DRILL_S = 60.0
"""Maximum real time of a camera drill, and ten times less than that of a mobility drill in virtual time."""


def perform(drill: Drill, directory: Path) -> None:
    """Run a drill.

    Raises:
        AssertionError: The platform did not keep its promise.
        TimeoutError: The flight did not end.
    """

    async def bounded() -> None:
        async with asyncio.timeout(DRILL_S if drill in CAMERA_DRILLS else 10 * DRILL_S):
            await drill(directory)

    if drill in CAMERA_DRILLS:
        asyncio.run(bounded())
    else:
        run(bounded())
