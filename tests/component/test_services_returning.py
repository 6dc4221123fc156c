"""RTL altitude and speed of the autopilot: limited during a mission, and restored to the owner's values afterwards."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from fractus_core.policy.decision_types import Airframe
from fractus_core.policy.return_route import ReturnBounds, return_altitudes_m, return_bounds
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from mobility_world import World, area, end, goto, refusal, spec
from parameter_vehicle import as_release_4_7
from policy_world import altitude, at, box, compiled, exclusion, speed, zone
from virtual_time import fly

OWNED = {"RTL_ALT": 4000.0, "RTL_SPEED": 0.0, "WPNAV_SPEED": 1000.0, "RTL_CLIMB_MIN": 500.0}
LOW = {"RTL_ALT": 1180.0, "RTL_SPEED": 0.0, "WPNAV_SPEED": 300.0, "RTL_CLIMB_MIN": 0.0}
LIMITS = {"maxAltitude": 12, "maxSpeed": 3.5}


def limited(kind: str, upper: float, *box_m: float) -> dict[str, Any]:
    body = {"type": "LimitControl", "kind": kind, "upperLimit": upper, "selector": {"zones": ["there"]}}
    return {"name": kind, "spec": body, "zones": [{"name": "there", "area": area(*box_m)}]}


def held(world: World) -> dict[str, float]:
    return {name: world.plane.parameters[name] for name in OWNED}


def test_return_bounds_use_strictest_limit_between_home_and_operation_area() -> None:
    everywhere = compiled(altitude(upperLimit=30), speed(upperLimit=10))
    assert return_bounds(at(), everywhere) == ReturnBounds(29.8, 9.5)
    near = box(20, 20, 40, 40)
    far = box(5000, 5000, 5100, 5100)
    zoned = compiled(
        altitude("near", [zone("a", near)], upperLimit=30),
        altitude("far", [zone("b", far)], upperLimit=3),
        speed("slow", [zone("c", near)], upperLimit=4),
    )
    assert return_bounds(at(), zoned) == ReturnBounds(29.8, 3.5)
    assert return_bounds(at(), compiled(limits=None)) == ReturnBounds()


def test_return_bounds_forbid_climb_if_limit_datum_is_unknown() -> None:
    above_terrain = {"altitudeReference": "terrain"}
    unknown = altitude("terrain", upperLimit=30, **above_terrain)
    assert return_bounds(at(), compiled(unknown, limits=None)).height_m == 0.0
    assert return_bounds(at(), compiled(unknown, flat_terrain=True, limits=None)).height_m == 29.8
    floor = altitude("floor", lowerLimit=3, **above_terrain)
    assert return_bounds(at(), compiled(floor, limits=None)).height_m == math.inf
    assert return_bounds(at(), compiled(altitude(upperLimit=20), floor, limits=None)).height_m == 19.8
    both = compiled(altitude(upperLimit=20), unknown)
    now = at(alt=25, airframe=Airframe(return_altitude_m=40))
    assert all(height <= 25 for height in return_altitudes_m(now, both, 100.0))
    assert return_altitudes_m(now, both, 100.0)[0] == 19.8
    limited = compiled(altitude(upperLimit=20), floor)
    assert return_altitudes_m(at(alt=10, airframe=Airframe(return_altitude_m=40)), limited, 100.0)[0] == 19.8


def test_return_altitudes_include_heights_below_overhead_zones() -> None:
    now = at(50, 0, alt=33, airframe=Airframe(return_altitude_m=40))
    zones = [exclusion(box(*zone_box), name=name, lower=low) for name, low, zone_box in (
        ("above", 35, (20, -20, 80, 20)), ("lower", 20, (0, -5, 10, 5)), ("ground", 12, (0, 5, 10, 15)),
        ("beyond", 15, (500, 0, 510, 10)), ("higher", 60, (0, 0, 10, 10)),
    )]  # fmt: skip
    assert return_altitudes_m(now, compiled(*zones), 150.0) == (40.0, 33.0, 32.5, 17.5)
    with_minimum = compiled(*zones, altitude(lowerLimit=25), limits=None)
    assert return_altitudes_m(now, with_minimum, 150.0) == (40.0, 33.0, 32.5)


@pytest.mark.parametrize(
    ("owned", "bounds", "expected"),
    [
        (OWNED, ReturnBounds(11.8, 3.0), LOW),
        (OWNED, ReturnBounds(60.0, 12.0), OWNED | {"RTL_CLIMB_MIN": 0.0}),
        (OWNED, ReturnBounds(), OWNED | {"RTL_CLIMB_MIN": 0.0}),
        (OWNED, ReturnBounds(12.345678, 0.0), LOW | {"RTL_ALT": 1234.0, "WPNAV_SPEED": 20.0}),
        ({"RTL_ALT_M": 40.0, "RTL_SPEED_MS": 9.0, "WP_SPD": 8.0}, ReturnBounds(12.5, 3.5),
         {"RTL_ALT_M": 12.5, "RTL_SPEED_MS": 3.5, "WP_SPD": 3.5}),
        ({}, ReturnBounds(12.0, 3.5), {}),
    ],
)  # fmt: skip
def test_rtl_parameters_are_derived_from_return_bounds(
    owned: dict[str, float], bounds: ReturnBounds, expected: dict[str, float]
) -> None:
    assert ARDUCOPTER.return_values(owned, bounds) == expected


@pytest.mark.parametrize("restarted", [False, True])
def test_rtl_limits_are_applied_during_mission_and_restored_after(tmp_path: Path, restarted: bool) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.parameters |= OWNED
            grant = world.grants.put(spec(limits=LIMITS))
            await world.up(grant, 8.0)
            assert held(world) == LOW
            assert world.gate.situation().airframe.return_altitude_m == pytest.approx(11.8)
            await end(world.service.goto(grant, goto(0, 30, 8.0), 0))
            if not restarted:
                await world.control.return_control(grant)
                await world.until(lambda: not world.plane.vehicle.armed)
                await world.until(lambda: held(world) == OWNED, 30)
        if restarted:
            async with World(tmp_path, after=world, initialised=False) as second:
                second.observer.found()
                await second.until(lambda: not second.plane.vehicle.armed)
                await second.until(lambda: held(second) == OWNED, 30)
        assert not (tmp_path / "return.json").exists()

    fly(flight)


def test_vehicle_of_release_4_7_is_limited_and_restored_under_its_own_names(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            plane = world.plane
            owned = as_release_4_7({**plane.parameters, **OWNED, "SYSID_MYGCS": 255.0, "GUID_TIMEOUT": 3.0})
            plane.parameters = dict(owned)
            plane.errors = True
            world.observer.found()
            await world.until(lambda: world.control.failsafe_status is not None)
            grant = world.grants.put(spec(limits=LIMITS))
            await world.up(grant, 8.0)
            flown = {name: value for name, value in plane.parameters.items() if value != owned[name]}
            limited_to = {
                "MAV_GCS_SYSID": 244.0,
                "GUID_TIMEOUT": 1.0,
                "RTL_ALT_M": 11.8,
                "WP_SPD": 3.0,
                "RTL_CLIMB_MIN_M": 0.0,
            }
            assert flown == pytest.approx(limited_to)
            assert plane.parameters.keys() == owned.keys()
            plane.parameters = dict(owned)  # as after PREFLIGHT_STORAGE of another station, without a message
            await world.until(lambda: all(plane.parameters[name] == value for name, value in flown.items()), 12)
            await world.control.return_control(grant)
            await world.until(lambda: not plane.vehicle.armed)
            await world.until(lambda: plane.parameters == owned | {"MAV_GCS_SYSID": 244.0}, 30)

    fly(flight)


FLOWN = {
    "GUID_OPTIONS": 32.0,
    "GUID_TIMEOUT": 3.0,
    "RTL_ALT_FINAL": 500.0,
    "RALLY_LIMIT_KM": 0.3,
    "RTL_ALT_TYPE": 1.0,
    "RTL_CONE_SLOPE": 1.0,
}
HELD = {
    "GUID_OPTIONS": 0.0,
    "GUID_TIMEOUT": 1.0,
    "RTL_ALT_FINAL": 0.0,
    "RALLY_LIMIT_KM": 2.0**-10,
    "RTL_ALT_TYPE": 0.0,
    "RTL_CONE_SLOPE": 3.0,
}


@pytest.mark.parametrize("restarted", [False, True])
def test_mission_parameters_are_held_during_mission_and_restored_after(tmp_path: Path, restarted: bool) -> None:
    def current_values(world: World) -> dict[str, float]:
        return {name: world.plane.parameters[name] for name in FLOWN}

    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.parameters |= FLOWN
            world.observer.found()
            await world.until(
                lambda: world.control.failsafe_status is not None and not world.control.failsafe_status.problem
            )
            assert current_values(world) == FLOWN, "parameters are unchanged before the mission"
            grant = world.grants.put(spec())
            await world.up(grant, 8.0)
            assert current_values(world) == HELD
            world.plane.parameters["GUID_OPTIONS"] = 16.0
            await world.until(lambda: current_values(world) == HELD, 30)
            await end(world.service.goto(grant, goto(0, 30, 8.0), 0))
            if not restarted:
                await world.control.return_control(grant)
                await world.until(lambda: not world.plane.vehicle.armed)
                await world.until(lambda: current_values(world) == FLOWN, 30)
        if restarted:
            async with World(tmp_path, after=world, initialised=False) as second:
                second.observer.found()
                await second.until(lambda: not second.plane.vehicle.armed)
                await second.until(lambda: current_values(second) == FLOWN, 30)

    fly(flight)


@pytest.mark.parametrize("name", FLOWN)
def test_arming_is_refused_if_mission_parameter_cannot_be_set(tmp_path: Path, name: str) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.parameters |= FLOWN
            world.plane.fixed = (name,)
            grant = world.grants.put(spec())
            await world.drive(grant)
            refused = await refusal(world.service.arm(grant, 10.0))
            assert refused.verdict.code == "ReturnNotLimited"
            assert f"{name} cannot be set to {HELD[name]:g}" in refused.verdict.reason
            assert not world.plane.vehicle.armed

    fly(flight)


def test_rtl_parameters_are_restored_if_fence_cannot_be_lowered(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.parameters |= OWNED
            grant = world.grants.put(spec(limits=LIMITS))
            await world.up(grant, 8.0)

            async def fails(_idle: object) -> None:
                raise OSError("no space left on device")

            world.fence.lower = fails  # type: ignore[method-assign]
            await world.control.return_control(grant)
            await world.until(lambda: not world.plane.vehicle.armed)
            await world.until(lambda: held(world) == OWNED, 30)
            assert world.fence.raised

    fly(flight)


def test_rtl_limits_follow_grant_changes_in_flight(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.parameters |= OWNED
            grant = world.grants.put(spec())
            world.observer.found()
            await world.up(grant, 8.0)
            world.grants.put(spec(limited("altitude", 12.0, 50, 50, 60, 60), limited("speed", 3.5, 50, 50, 60, 60)))
            await world.until(lambda: held(world) == LOW, 5)
            assert world.gate.situation().airframe.return_altitude_m == pytest.approx(11.8)
            assert world.control.cruise_mps == 10.0, "the leg is outside the zone of the limits"
            world.plane.parameters["RTL_ALT"] = 3000.0  # changed by another station, without a message to the service
            await world.until(lambda: held(world) == LOW, 15)
            world.grants.put(spec())
            await world.until(lambda: held(world) == OWNED | {"RTL_CLIMB_MIN": 0.0}, 5)
            codes = [entry["code"] for entry in world.kinds("control")]
            assert codes.count("ReturnLimited") >= 3

    fly(flight)


def test_arming_is_refused_if_rtl_speed_cannot_be_limited(tmp_path: Path) -> None:
    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.parameters |= OWNED
            world.plane.fixed = ("WPNAV_SPEED",)
            grant = world.grants.put(spec(limits=LIMITS))
            await world.drive(grant)
            reason = await refusal(world.service.arm(grant))
            assert reason.verdict.code == "ReturnNotLimited"
            assert "WPNAV_SPEED cannot be set to 300; it remains 1000" in str(reason)
            assert not world.plane.vehicle.armed
            await world.until(lambda: held(world) == OWNED, 30)

    fly(flight)


def test_saved_values_with_parameter_names_of_another_firmware_are_ignored(tmp_path: Path) -> None:
    """The vehicle firmware was updated after the file was written, and its parameters have other names."""
    (tmp_path / "return.json").write_text('{"RTL_ALT_M": 40.0, "WP_SPD": 10.0, "RTL_SPEED_MS": 0.0}')

    async def flight() -> None:
        world = World(tmp_path)
        world.plane.parameters |= OWNED
        async with world:
            grant = world.grants.put(spec(limits=LIMITS))
            await world.up(grant, 8.0)
            assert held(world) == LOW
            await world.control.return_control(grant)
            await world.until(lambda: not world.plane.vehicle.armed)
            await world.until(lambda: held(world) == OWNED, 30)
        assert "WP_SPD" not in world.plane.parameters
        assert not (tmp_path / "return.json").exists()

    fly(flight)


def test_saved_values_are_deleted_if_all_belong_to_another_firmware(tmp_path: Path) -> None:
    (tmp_path / "return.json").write_text('{"RTL_RETURN_ALT": 40.0, "MPC_XY_CRUISE": 3.0}')

    async def flight() -> None:
        world = World(tmp_path)
        world.plane.parameters |= OWNED
        async with world:
            world.observer.found()
            await world.until(lambda: not (tmp_path / "return.json").exists(), 60)
            assert held(world) == OWNED

    fly(flight)


def test_rtl_limits_are_applied_if_saved_values_are_corrupt(tmp_path: Path) -> None:
    (tmp_path / "return.json").write_text("[")

    async def flight() -> None:
        async with World(tmp_path) as world:
            world.plane.parameters |= OWNED
            grant = world.grants.put(spec(limits=LIMITS))
            await world.up(grant, 8.0)
            assert held(world) == LOW

    fly(flight)
