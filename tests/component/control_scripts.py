"""Scripts of the golden flights, one function each."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

from control_flights import Flight, missions_of
from fractus_core.control.state import FlightMode
from fractus_core.policy.decision_types import SetSpeedArgs, TakeoffArgs, VelocityArgs
from mobility_world import GUIDED, LAND, LOITER, RTL, partial, spec, touring, zone

Script = Callable[[Flight], Coroutine[Any, Any, None]]

FLIGHTS: dict[str, Script] = {}


def script(function: Script) -> Script:
    """Register a golden flight under its name."""
    FLIGHTS[function.__name__] = function
    return function


WALL = (-40.0, 25.0, 40.0, 40.0)
AROUND_DRONE = (-30.0, 10.0, 30.0, 60.0)
CONTROL_POINTS = [{"navigation": "pathBased", "path": [{"lat": 39.3603, "lon": 22.95, "alt": 10.0}]}] * 2


@script
async def complete_mission(f: Flight) -> None:
    held = f.put(spec())
    await f.up(held)
    await f.goto(held, 0, 70)
    await f.give_back(held)
    await f.landed()
    f.follow(held, "late")
    await f.sleep(1)


@script
async def two_control_points(f: Flight) -> None:
    held = f.put(spec(controlPoints=CONTROL_POINTS))
    await f.up(held)
    await f.goto(held, 0, 33.4)
    await f.give_back(held)
    await f.sleep(2)
    await f.drive(held, "again")
    await f.goto(held, 20, 20)
    await f.give_back(held)
    await f.landed()


@script
async def second_control_point_unused(f: Flight) -> None:
    held = f.put(spec(controlPoints=CONTROL_POINTS))
    await f.up(held)
    await f.give_back(held)
    await f.landed()


@script
async def transit(f: Flight) -> None:
    held = f.put(
        partial(zone("wall", "ignore", *WALL), controlPoints=[*CONTROL_POINTS, *spec().model_dump()["control_points"]])
    )
    await f.drive(held)
    await f.give_back(held)
    await f.drive(held, "again")
    await f.give_back(held)
    await f.sleep(1)
    await f.drive(held, "third")
    await f.give_back(held)
    await f.landed()


@script
async def waiting_driver_leaves_transit(f: Flight) -> None:
    held = f.put(partial())
    stream = f.follow(held)
    await f.until(lambda: f.world.plane.xy[1] > 20)
    stream.cancel()
    await f.landed()


@script
async def waiting_driver_leaves_before_arming(f: Flight) -> None:
    held = f.put(partial())
    f.world.plane.vehicle.ready = False
    stream = f.follow(held)
    await f.sleep(2)
    stream.cancel()
    f.world.plane.vehicle.ready = True
    await f.sleep(10)
    await f.drive(held, "again")


@script
async def driver_reconnects(f: Flight) -> None:
    held = f.put(spec())
    stream = await f.up(held)
    f.start_goto(held, 0, 90)
    await f.sleep(5)
    stream.cancel()
    await f.sleep(3)
    await f.drive(held, "again")
    await f.goto(held, 0, 20)
    await f.give_back(held)
    await f.landed()


@script
async def driver_lost(f: Flight) -> None:
    held = f.put(spec(zone("wall", "ignore", *WALL)))
    stream = await f.up(held)
    await f.goto(held, 60, 30)
    await f.goto(held, 60, 70)
    f.start_goto(held, -60, 70)
    await f.sleep(4)
    stream.cancel()
    await f.landed()
    f.follow(held, "late")
    await f.sleep(1)


@script
async def driver_lost_while_landing(f: Flight) -> None:
    held = f.put(spec())
    stream = await f.up(held)
    f.call("Land", lambda: f.world.service.land(held))
    await f.sleep(1.5)
    stream.cancel()
    await f.landed()
    await f.sleep(10)


@script
async def driver_lost_during_return(f: Flight) -> None:
    held = f.put(spec())
    stream = await f.up(held)
    await f.goto(held, 0, 60)
    returning = f.call("ReturnToLaunch", lambda: f.world.service.return_to_launch(held))
    await f.until(lambda: f.world.plane.xy[1] < 40)
    returning.cancel()
    stream.cancel()
    await f.landed()


@script
async def driver_lost_above_home(f: Flight) -> None:
    held = f.put(spec())
    stream = await f.up(held)
    await f.goto(held, 0, 60)
    returning = f.call("ReturnToLaunch", lambda: f.world.service.return_to_launch(held))
    await f.until(lambda: f.world.plane.vehicle.mode == LAND)
    returning.cancel()
    stream.cancel()
    await f.landed()


@script
async def driver_lost_on_the_ground(f: Flight) -> None:
    held = f.put(spec())
    stream = await f.drive(held)
    stream.cancel()
    await f.sleep(10)
    stream = await f.drive(held, "again")
    await f.do("Arm", lambda: f.world.service.arm(held))
    stream.cancel()
    await f.landed()


@script
async def driver_lost_while_arming(f: Flight) -> None:
    held = f.put(spec())
    raise_around = f.world.fence.raise_around

    async def raise_slowly(*args: Any, **options: Any) -> None:
        await raise_around(*args, **options)
        await asyncio.sleep(3)

    f.world.fence.raise_around = raise_slowly  # type: ignore[method-assign]
    stream = await f.drive(held)
    f.call("Arm", lambda: f.world.service.arm(held))
    await f.sleep(1)
    stream.cancel()
    await f.sleep(10)


@script
async def driver_lands_and_flies_again(f: Flight) -> None:
    held = f.put(spec())
    await f.up(held)
    await f.do("Land", lambda: f.world.service.land(held))
    await f.sleep(10)
    await f.do("Arm", lambda: f.world.service.arm(held))
    await f.do("Takeoff", lambda: f.world.service.take_off(held, TakeoffArgs(5.0)))
    await f.do("ReturnToLaunch", lambda: f.world.service.return_to_launch(held))
    await f.give_back(held)
    await f.sleep(5)


@script
async def landed_driver_is_lost(f: Flight) -> None:
    held = f.put(spec())
    stream = await f.up(held)
    await f.do("Land", lambda: f.world.service.land(held))
    stream.cancel()
    await f.sleep(10)


@script
async def second_stream_is_refused(f: Flight) -> None:
    held = f.put(spec())
    await f.up(held)
    await f.drive(held, "second")
    await f.sleep(3)
    await f.give_back(held)
    await f.landed()


@script
async def second_stream_continues_after_first_ended(f: Flight) -> None:
    held = f.put(spec())
    first = await f.up(held)
    f.follow(held, "second")
    await f.sleep(3)
    first.cancel()
    await f.sleep(3)
    await f.give_back(held)
    await f.landed()


@script
async def driver_repeats_a_call_that_causes_takeovers(f: Flight) -> None:
    held = f.put(spec(zone("wall", "hover", *WALL)))
    await f.drive(held)
    await f.do("Arm", lambda: f.world.service.arm(held))
    await f.do("Takeoff", lambda: f.world.service.take_off(held, TakeoffArgs(10.0)))
    for attempt in range(4):
        await f.goto(held, 0, 33)
        await f.sleep(2)
        await f.drive(held, f"retry {attempt}")
    await f.landed()


@script
async def other_drivers_wait_or_are_refused(f: Flight) -> None:
    held = f.put(spec())
    other = f.put(spec(instance="other"), "m2")
    f.world.plane.vehicle.ready = False
    f.follow(other, "other")
    await f.sleep(1)
    f.follow(held, "early")
    await f.sleep(1)
    f.world.plane.vehicle.ready = True
    await f.sleep(2)
    await f.give_back(other)
    await f.sleep(1)
    await f.up(held)
    f.follow(other, "other again")
    await f.sleep(1)
    await f.give_back(held)
    await f.sleep(2)
    f.follow(other, "other on the way home")
    await f.landed()


@script
async def waiting_stream_yields_to_flying_mission(f: Flight) -> None:
    held = f.put(spec())
    other = f.put(spec(instance="other"), "m2")
    stream = await f.up(held)
    await f.do("Land", lambda: f.world.service.land(held))
    stream.cancel()
    await f.sleep(1)
    f.world.plane.vehicle.ready = False
    f.follow(other, "other")
    await f.sleep(1)
    f.world.plane.vehicle.ready = True
    await f.sleep(10)


def takeover(action: str) -> Callable[[Flight], Coroutine[Any, Any, None]]:
    async def script(f: Flight) -> None:
        held = f.put(spec())
        await f.up(held)
        f.start_goto(held, 0, 70)
        await f.sleep(6)
        f.put(spec(zone("around", action, *AROUND_DRONE)))
        await f.sleep(20)
        f.follow(held, "again")
        await f.sleep(3)
        await f.landed()

    return script


@script
async def zone_appears_in_transit(f: Flight) -> None:
    f.follow(f.put(partial()))
    await f.until(lambda: f.world.plane.xy[1] > 16)
    f.put(partial(zone("wall", "revoke", -40, 40, 40, 55)))
    await f.landed()


@script
async def grant_removed(f: Flight) -> None:
    held = f.put(spec(zone("wall", "ignore", *WALL)))
    await f.up(held)
    await f.goto(held, 60, 30)
    await f.goto(held, 60, 70)
    f.world.grants.remove(held)
    await f.landed()


@script
async def grant_removed_on_the_ground(f: Flight) -> None:
    held = f.put(spec())
    await f.drive(held)
    f.world.grants.remove(held)
    await f.sleep(5)
    held = f.put(spec(), "m2")
    await f.drive(held, "next")
    await f.give_back(held)
    await f.sleep(1)


@script
async def grant_removed_while_waiting(f: Flight) -> None:
    held = f.put(spec())
    f.world.plane.vehicle.ready = False
    f.follow(held)
    await f.sleep(1)
    f.world.grants.remove(held)
    await f.sleep(2)


@script
async def grant_removed_during_return(f: Flight) -> None:
    held = f.put(spec())
    await f.up(held)
    await f.goto(held, 0, 70)
    await f.give_back(held)
    await f.sleep(2)
    f.world.grants.remove(held)
    await f.landed()


@script
async def grant_changes(f: Flight) -> None:
    held = f.put(spec())
    await f.up(held)
    flying = f.start_goto(held, 0, 90)
    await f.sleep(3)
    f.put(spec(limits={"maxAltitude": 40, "maxSpeed": 3}))
    await flying
    await f.give_back(held)
    await f.landed()


@script
async def pilot_takes_over_and_hands_back(f: Flight) -> None:
    held = f.put(spec())
    await f.up(held)
    f.start_goto(held, 0, 70)
    await f.sleep(4)
    f.world.plane.set_to(LOITER)
    await f.sleep(8)
    f.follow(held, "while piloted")
    await f.sleep(2)
    f.world.plane.set_to(GUIDED)
    await f.sleep(3)
    await f.goto(held, 0, 20)
    await f.give_back(held)
    await f.landed()


@script
async def pilot_hands_back_a_mission_without_grant(f: Flight) -> None:
    held = f.put(spec())
    await f.up(held)
    f.world.plane.set_to(LOITER)
    await f.sleep(3)
    f.world.grants.remove(held)
    await f.sleep(2)
    f.world.plane.set_to(GUIDED)
    await f.landed()


@script
async def pilot_lands(f: Flight) -> None:
    held = f.put(spec())
    await f.up(held)
    await f.goto(held, 0, 20)
    f.world.plane.set_to(LAND)
    await f.landed()
    await f.sleep(5)


@script
async def pilot_takes_over_during_return(f: Flight) -> None:
    held = f.put(spec())
    await f.up(held)
    await f.goto(held, 0, 70)
    await f.give_back(held)
    await f.sleep(6)
    f.world.plane.set_to(LOITER)
    await f.sleep(5)
    f.world.plane.set_to(LAND)
    await f.landed()


@script
async def pilot_arms(f: Flight) -> None:
    held = f.put(spec())
    f.world.plane.vehicle.armed = True
    await f.sleep(2)
    f.follow(held)
    await f.sleep(2)
    f.world.plane.vehicle.armed = False
    await f.sleep(3)
    await f.give_back(held)
    await f.sleep(1)


@script
async def pilot_changes_modes_on_the_ground(f: Flight) -> None:
    held = f.put(spec())
    f.world.plane.set_to(LOITER)
    await f.sleep(2)
    await f.up(held)
    await f.give_back(held)
    await f.landed()


def failsafe(mode: FlightMode) -> Callable[[Flight], Coroutine[Any, Any, None]]:
    async def script(f: Flight) -> None:
        held = f.put(spec())
        await f.up(held)
        f.start_goto(held, 0, 70)
        await f.sleep(5)
        f.failsafe(mode)
        await f.sleep(2)
        f.follow(held, "again")
        await f.landed()

    return script


@script
async def failsafe_in_transit_then_pilot(f: Flight) -> None:
    f.follow(f.put(partial()))
    await f.until(lambda: f.world.plane.xy[1] > 20)
    f.failsafe(RTL)
    await f.sleep(2)
    f.world.plane.set_to(LOITER)
    await f.sleep(3)
    f.world.plane.set_to(GUIDED)
    await f.landed()


@script
async def link_reconnects(f: Flight) -> None:
    held = f.put(spec())
    await f.up(held)
    f.start_goto(held, 0, 70)
    await f.sleep(3)
    f.break_link()
    await f.sleep(8)
    f.restore_link()
    await f.sleep(3)
    await f.goto(held, 0, 20)
    await f.give_back(held)
    await f.landed()


@script
async def link_lost_during_return(f: Flight) -> None:
    held = f.put(spec(zone("wall", "ignore", *WALL)))
    await f.up(held)
    await f.goto(held, 60, 30)
    await f.goto(held, 60, 70)
    await f.goto(held, 0, 70)
    await f.give_back(held)
    await f.sleep(3)
    f.break_link()
    await f.sleep(8)
    f.restore_link()
    await f.landed()


@script
async def link_lost_during_grace(f: Flight) -> None:
    held = f.put(spec())
    stream = await f.up(held)
    stream.cancel()
    f.break_link()
    await f.sleep(7)
    f.restore_link()
    await f.landed()


@script
async def link_reconnects_during_autopilot_return(f: Flight) -> None:
    held = f.put(spec())
    stream = await f.up(held)
    await f.goto(held, 0, 70)
    stream.cancel()
    f.break_link()
    await f.sleep(1)
    f.world.plane.set_to(RTL)
    await f.sleep(7)
    f.restore_link()
    await f.landed()


@script
async def service_restarts(f: Flight) -> None:
    held = f.put(spec())
    await f.up(held)
    f.start_goto(held, 0, 70)
    await f.sleep(4)
    await f.restart()
    await f.sleep(2)
    await f.drive(held, "again")
    await f.give_back(held)
    await f.landed()


@script
async def service_restarts_without_driver(f: Flight) -> None:
    held = f.put(spec())
    await f.up(held)
    await f.restart()
    await f.landed()


@script
async def service_restarts_on_the_ground(f: Flight) -> None:
    held = f.put(spec())
    await f.up(held)
    await f.do("Land", lambda: f.world.service.land(held))
    await f.restart()
    await f.sleep(10)


def service_restarts_in(mode: FlightMode, removed: bool = False) -> Callable[[Flight], Coroutine[Any, Any, None]]:
    async def script(f: Flight) -> None:
        held = f.put(spec())
        await f.up(held)
        await f.goto(held, 0, 40)
        f.world.plane.set_to(mode)
        if removed:
            f._grants.clear()
        await f.restart()
        await f.sleep(3)
        if mode == LOITER:
            f.world.plane.set_to(GUIDED)
        await f.landed()

    return script


@script
async def service_starts_with_armed_drone(f: Flight) -> None:
    plane = f.world.plane
    plane.vehicle.armed = True
    plane.height = 12.0
    plane.xy = [10.0, 30.0]
    plane.set_to(GUIDED)
    await f.restart()
    await f.landed()


@script
async def poi_mission(f: Flight) -> None:
    held = f.put(touring(zone("wall", "ignore", *WALL), tour=((0, 70), (60, 70))))
    f.follow(held, "passenger")
    await f.until(lambda: all(m.outcome for m in missions_of(f.world)) and missions_of(f.world))
    await f.landed()


@script
async def poi_mission_leaves_operation_area(f: Flight) -> None:
    f.follow(f.put(touring(tour=((0, 30), (0, 500)))), "passenger")
    await f.until(lambda: f.world.plane.vehicle.armed)
    await f.landed()


@script
async def poi_mission_grant_removed(f: Flight) -> None:
    held = f.put(touring(tour=((0, 100),)))
    f.follow(held, "passenger")
    await f.until(lambda: f.world.plane.xy[1] > 30)
    f.world.grants.remove(held)
    await f.landed()


@script
async def poi_mission_pilot_takes_over(f: Flight) -> None:
    f.follow(f.put(touring(tour=((0, 100),))), "passenger")
    await f.until(lambda: f.world.plane.xy[1] > 30)
    f.world.plane.set_to(LOITER)
    await f.sleep(4)
    f.world.plane.set_to(GUIDED)
    await f.sleep(4)
    await f.landed()


@script
async def poi_mission_waits_for_link(f: Flight) -> None:
    f.follow(f.put(touring(tour=((0, 100),))), "passenger")
    await f.until(lambda: f.world.plane.xy[1] > 30)
    f.break_link()
    await f.sleep(5)
    f.restore_link()
    await f.sleep(2)
    await f.landed()


@script
async def poi_mission_service_restarts(f: Flight) -> None:
    f.put(touring(tour=((0, 40), (0, 80))))
    await f.until(lambda: f.world.plane.xy[1] > 50)
    await f.restart()
    await f.sleep(1)
    await f.landed()


@script
async def poi_mission_after_driver(f: Flight) -> None:
    held = f.put(spec())
    await f.up(held)
    f.follow(f.put(touring(tour=((0, 30),)), "m2"), "passenger")
    await f.sleep(5)
    await f.give_back(held)
    await f.landed()
    await f.until(lambda: f.world.plane.vehicle.armed)
    await f.landed()


@script
async def motions_replace_each_other(f: Flight) -> None:
    held = f.put(spec())
    await f.up(held)
    service = f.world.service
    first = f.start_goto(held, 0, 90)
    await f.sleep(3)
    await f.do("SetSpeed", lambda: service.set_speed(held, SetSpeedArgs(3.0)))
    await f.goto(held, 30, 30)
    await f.do("SetVelocity", lambda: service.set_velocity(held, VelocityArgs(2.0, 1.0, hold_s=1.0)))
    await f.sleep(4)
    second = f.start_goto(held, 0, 0)
    await f.sleep(2)
    second.cancel()
    await f.sleep(5)
    landing = f.call("Land", lambda: service.land(held))
    await f.sleep(1)
    landing.cancel()
    await f.sleep(5)
    await f.do("Hover", lambda: service.hover(held))
    await first
    f.world.plane.refuses.add(192)
    await f.goto(held, 20, 0)
    f.world.plane.refuses.clear()
    await f.sleep(3)
    await f.do("Disarm", lambda: service.disarm(held))
    await f.give_back(held)
    await f.landed()


@script
async def altitude_limit_added_in_flight(f: Flight) -> None:
    held = f.put(spec())
    await f.up(held, 25.0)
    f.start_goto(held, 0, 90)
    await f.sleep(4)
    limit = {"type": "LimitControl", "kind": "altitude", "upperLimit": 15.0, "action": "enforce"}
    f.put(spec({"name": "low", "spec": limit, "zones": []}))
    await f.sleep(15)
    await f.give_back(held)
    await f.landed()


@script
async def autopilot_refuses_modes(f: Flight) -> None:
    held = f.put(spec())
    await f.up(held)
    await f.goto(held, 0, 40)
    f.world.plane.refuses.add(176)
    await f.do("Land", lambda: f.world.service.land(held))
    await f.give_back(held)
    await f.sleep(8)
    f.world.plane.refuses.clear()
    await f.landed()


@script
async def takeover_by_denied_call(f: Flight) -> None:
    held = f.put(spec(zone("wall", "revoke", *WALL)))
    await f.up(held)
    await f.goto(held, 0, 33)
    await f.sleep(1)
    await f.landed()


FLIGHTS |= {
    "takeover_hovers": takeover("hover"),
    "takeover_lands": takeover("land"),
    "takeover_returns": takeover("returnToLaunch"),
    "takeover_revokes": takeover("revoke"),
    "failsafe_returns": failsafe(RTL),
    "failsafe_lands": failsafe(LAND),
    "service_restarts_during_return": service_restarts_in(RTL),
    "service_restarts_during_landing": service_restarts_in(LAND),
    "service_restarts_in_pilot_flight": service_restarts_in(LOITER),
    "service_restarts_without_grant": service_restarts_in(GUIDED, removed=True),
}
