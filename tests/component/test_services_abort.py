"""The repair action `abort`: the mission ends, and the system lands the drone at the agreed place."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import Any

import pytest
from fractus_services.mobility.authority.flown_grant import FlownGrantFile
from mobility_world import GUIDED, LOITER, World, area, at, clearance_m, end, goto, refusal, spec, touring, zone
from virtual_time import fly

WALL = (-40.0, 60.0, 40.0, 80.0)
PLACE = (80.0, -50.0)


def aborting(
    name: str = "wall", box: tuple[float, ...] = WALL, place: tuple[float, float] | None = PLACE
) -> dict[str, Any]:
    """Return an exclusion policy with the action `abort` and a landing place in metres around home."""
    policy = zone(name, "abort", *box)
    if place is not None:
        policy["spec"]["landAt"] = dict(zip(("lat", "lon"), at(*place), strict=True))
    return policy


async def landed(world: World) -> tuple[float, float]:
    """Wait until the motors stop, and return the place in metres around home."""
    await world.until(lambda: not world.plane.vehicle.armed, 200)
    return world.plane.xy[0], world.plane.xy[1]


async def violate(world: World, *policies: dict[str, Any]) -> None:
    """Take off, and request a leg into the wall."""
    grant = world.grants.put(spec(*policies))
    await world.up(grant)
    assert (await refusal(end_of(world, grant))).verdict.takeover == "abort"


async def end_of(world: World, grant: Any) -> Any:
    return await end(world.service.goto(grant, goto(0, 70), 0))


def test_aborted_drone_lands_at_its_place(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            await violate(world, aborting())
            (takeover,) = world.kinds("takeover")
            assert (takeover["action"], takeover["policies"]) == ("landAt", ["wall"])
            assert math.dist(await landed(world), PLACE) < 1.5
            assert world.outcome().startswith("revoked:")
            assert "policy wall" in world.outcome()
            assert (
                await refusal(world.drive(world.control.last_grant or next(iter(world.grants.active.values()))))
            ).verdict.code == "MissionEnded"

    fly(flight)


def test_monitor_aborts_flight_into_zone_that_appears(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            grant = world.grants.put(spec())
            await world.up(grant)
            leg = asyncio.ensure_future(end_of(world, grant))
            await world.until(lambda: world.plane.velocity[1] > 3)
            world.grants.put(spec(aborting()))
            assert (await refusal(leg)).verdict.code == "ControlLost"
            assert math.dist(await landed(world), PLACE) < 1.5
            assert clearance_m(world, *WALL) > 0

    fly(flight)


def test_aborted_drone_flies_around_zones(tmp_path: Path) -> None:
    barrier = (40.0, -70.0, 60.0, 30.0)

    async def flight() -> None:
        async with World(tmp_path) as world:
            await violate(world, aborting(), zone("barrier", "ignore", *barrier))
            assert math.dist(await landed(world), PLACE) < 1.5
            assert clearance_m(world, *barrier) > 1

    fly(flight)


def test_aborted_tour_lands_at_its_place(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.grants.put(touring(tour=((0, 120),)))
            await world.until(lambda: world.plane.velocity[1] > 3)
            world.grants.put(touring(aborting(box=(-200, 70, 200, 80)), tour=((0, 120),)))
            assert math.dist(await landed(world), PLACE) < 1.5

    fly(flight)


@pytest.mark.parametrize(
    "place",
    [
        pytest.param(None, id="unspecified"),
        pytest.param((0.0, 70.0), id="inside a zone"),
        pytest.param((300.0, 0.0), id="outside the operation area"),
        pytest.param((199.0, 0.0), id="at the border of the operation area"),
        pytest.param((150.0, 150.0), id="surrounded by zones"),
    ],
)
def test_aborted_drone_returns_home_without_legal_landing_place(
    tmp_path: Path, place: tuple[float, float] | None
) -> None:
    ring = [
        zone("ring", "ignore", *box)
        for box in (
            (110.0, 110.0, 190.0, 120.0),
            (110.0, 180.0, 190.0, 190.0),
            (110.0, 110.0, 120.0, 190.0),
            (180.0, 110.0, 190.0, 190.0),
        )
    ]
    for number, policy in enumerate(ring):
        policy["name"] = f"ring-{number}"

    async def flight() -> None:
        async with World(tmp_path) as world:
            await violate(world, aborting(place=place), *ring)
            assert math.hypot(*await landed(world)) < 1.5
            assert world.outcome().startswith("revoked:")

    fly(flight)


def test_aborted_drone_returns_home_if_its_place_becomes_illegal_in_flight(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            await violate(world, aborting())
            await world.until(lambda: world.plane.xy[0] > 30)
            covered = zone("covered", "ignore", 70, -60, 90, -40)
            barrier = (8.0, -30.0, 16.0, 30.0)
            world.grants.put(spec(aborting(), covered, zone("barrier", "ignore", *barrier)))
            world.plane.trace.clear()
            assert math.hypot(*await landed(world)) < 1.5
            assert clearance_m(world, *barrier) > 1, "the return flight avoids the zone barrier"
            assert clearance_m(world, 70, -60, 90, -40) > 0

    fly(flight)


def test_aborted_drone_lands_at_its_place_after_removal_of_its_grant(tmp_path: Path) -> None:
    barrier = (40.0, -70.0, 60.0, 30.0)

    async def flight() -> None:
        async with World(tmp_path) as world:
            await violate(world, aborting(), zone("barrier", "ignore", *barrier))
            (grant,) = world.grants.active.values()
            world.grants.remove(grant)
            assert world.control.last_grant is grant, "its zones still apply"
            assert math.dist(await landed(world), PLACE) < 1.5
            assert clearance_m(world, *barrier) > 1

    fly(flight)


def test_aborted_drone_lands_at_its_place_after_restart_of_the_service(tmp_path: Path) -> None:
    async def flight() -> None:
        world = World(tmp_path)
        async with world:
            await violate(world, aborting())
            await world.until(lambda: world.plane.xy[0] > 20)
        async with World(tmp_path, after=world, initialised=False) as restarted:
            restarted.grants.put(spec(aborting()))
            restarted.observer.found()
            assert math.dist(await landed(restarted), PLACE) < 1.5

    fly(flight)


def test_aborted_drone_continues_to_its_place_when_pilot_hands_it_back(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            await violate(world, aborting())
            await world.until(lambda: world.plane.xy[0] > 20)
            world.plane.set_to(LOITER)
            world.observer.heartbeat()
            assert world.control.authority.value == "pilot"
            world.plane.set_to(GUIDED)
            world.observer.heartbeat()
            assert math.dist(await landed(world), PLACE) < 1.5

    fly(flight)


def test_landing_place_may_be_inside_the_corridor(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            north = {"operationArea": [area(-60, 20, 60, 200)], "corridor": [area(-60, -100, 60, 200)]}
            grant = world.grants.put(spec(aborting(place=(30, -60)), **north))
            await world.up(grant)
            await end(world.service.goto(grant, goto(0, 40), 0))
            await refusal(end_of(world, grant))
            assert math.dist(await landed(world), (30, -60)) < 1.5

    fly(flight)


async def until_stored(file: Path, *, exists: bool = True) -> None:
    """Wait for a write in a thread, which takes no virtual time."""
    for _ in range(1000):
        if await asyncio.to_thread(file.exists) is exists:
            return
        await asyncio.sleep(0.01)
    raise AssertionError("the flown Grant was not stored or not removed")


BARRIER = (-30.0, 40.0, 30.0, 50.0)
FAR_WALL = (-40.0, 160.0, 40.0, 180.0)


async def abort_behind_barrier(world: World, place: tuple[float, float] | None = None) -> None:
    """Fly around the barrier, cause an abort, and remove the Grant while the drone returns."""
    grant = world.grants.put(spec(aborting(box=FAR_WALL, place=place), zone("barrier", "ignore", *BARRIER)))
    await world.up(grant)
    for x, y in ((60, 20), (60, 80), (0, 100)):
        await end(world.service.goto(grant, goto(x, y), 0))

    async def enter() -> Any:
        return await end(world.service.goto(grant, goto(0, 170), 0))

    assert (await refusal(enter())).verdict.takeover == "abort"
    world.grants.remove(grant)
    await asyncio.sleep(1)


@pytest.mark.parametrize("place", [None, PLACE])
def test_restarted_service_flies_around_zones_of_removed_grant(
    tmp_path: Path, place: tuple[float, float] | None
) -> None:
    file = tmp_path / "flown-grant.json"

    async def flight() -> None:
        world = World(tmp_path, retraces=True, flown_grant=FlownGrantFile(file))
        async with world:
            await abort_behind_barrier(world, place)
            await until_stored(file)
        async with World(
            tmp_path, after=world, initialised=False, retraces=True, flown_grant=FlownGrantFile(file)
        ) as restarted:
            await asyncio.sleep(3)
            assert file.exists(), "the vehicle was not found yet"
            restarted.observer.found()
            assert math.dist(await landed(restarted), place or (0.0, 0.0)) < 1.5
            assert clearance_m(restarted, *BARRIER) > 0
            await until_stored(file, exists=False)

    fly(flight)


@pytest.mark.parametrize(("path_lost", "mode"), [(False, "SMART_RTL"), (True, "RTL")])
@pytest.mark.parametrize("content", [None, "", "[]", '{"key": "m1", "name": "a", "flat_terrain": false, "spec": {}}'])
def test_restarted_service_returns_on_the_flown_path_if_the_grant_is_unknown(
    tmp_path: Path, path_lost: bool, mode: str, content: str | None
) -> None:
    file = tmp_path / "flown-grant.json"

    async def flight() -> None:
        world = World(tmp_path, retraces=True)
        async with world:
            await abort_behind_barrier(world)
        if content is not None:
            file.write_text(content)
        async with World(
            tmp_path, after=world, initialised=False, retraces=True, flown_grant=FlownGrantFile(file)
        ) as restarted:
            restarted.control.failsafe_status = None  # verified only after the vehicle is found
            restarted.plane.vehicle.path_lost = path_lost
            restarted.observer.found()
            await restarted.until(lambda: restarted.plane.vehicle.mode.comes_down, 5)
            assert restarted.plane.vehicle.mode.name == mode
            assert restarted.kinds("control")[-1]["code"] == "NoLegalWay"

    fly(flight)
