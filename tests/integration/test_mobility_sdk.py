"""The SDK with the real mobility service."""

from __future__ import annotations

import asyncio
import contextlib
import math
import signal
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from typing import Any, TypeVar

import pytest
from fractus import sync
from fractus.drone import Mobility
from fractus.environment import Endpoint
from fractus.errors import ControlLost, InvalidRequest, MissionComplete, PolicyDenied
from fractus.pictures import Camera
from fractus_core.api.names import node_server_name
from mobility_rig import (
    ALL,
    DRIVER,
    FRAME,
    NAVIGATOR_MISSION,
    NODE,
    PASSENGER,
    Rig,
    altitude_limit,
    fence,
    grant,
    outcomes,
    passenger_grant,
)

T = TypeVar("T")


def endpoint(rig: Rig, identity: str = DRIVER, **validity: float) -> Endpoint:
    folder = rig.directory / f"tls-{identity.rpartition('/')[2]}"
    folder.mkdir(exist_ok=True)
    key, certificate = rig.authority.issue(identity, **validity)
    for name, data in (("tls.key", key), ("tls.crt", certificate), ("ca.crt", rig.authority.pem)):
        fresh = folder / f".{name}"
        fresh.write_bytes(data)
        fresh.replace(folder / name)
    return Endpoint(rig.address, node_server_name(NODE), folder)


async def restart(rig: Rig) -> None:
    """Restart the service while the vehicle is paused. Otherwise its failsafe would start a return flight after 5 s."""
    rig.send_signal("vehicle", signal.SIGSTOP)
    rig.kill("service")
    rig.start_service("--driver-grace", "15")
    async with asyncio.timeout(60):
        await rig.channel(DRIVER).channel_ready()
    rig.send_signal("vehicle", signal.SIGCONT)


async def test_sdk_mission_survives_service_restart_and_takeover(rig: Rig) -> None:
    rig.write_grant(
        grant(
            altitude_limit(5, 7),
            fence("no-fly", "exclusion", "ignore", -60, -10, -40, 10),
            fence("sensitive", "exclusion", "revoke", 30, 30, 50, 50),
        )
    )
    rig.start_service("--driver-grace", "15")
    rig.start_vehicle(2.0)
    async with Mobility(endpoint(rig)) as drone:
        with pytest.raises(ControlLost):
            async with drone.control() as control:
                assert control.control_point == 0
                await drone.arm()
                up = await drone.takeoff(20)
                assert up.corrected
                lat, lon = FRAME.latlon(0, 8)
                reached = await drone.goto(lat, lon, 7)
                assert not reached.corrected
                with pytest.raises(PolicyDenied) as refused:
                    await drone.goto(*FRAME.latlon(-50, 0), 7)
                assert refused.value.code == "InsideExclusionZone"
                with pytest.raises(InvalidRequest):
                    await drone.goto(math.nan, lon, 10)
                await restart(rig)
                await drone.goto(*FRAME.latlon(5, 8), 7)
                with pytest.raises(ControlLost) as taken:
                    await drone.goto(*FRAME.latlon(40, 40), 7)
                assert taken.value.decision.action.name == "TAKEOVER"
                await drone.goto(*FRAME.latlon(0, 0), 7)
    state = await rig.until(lambda t: NAVIGATOR_MISSION in t.missions, 30, "the outcome")
    assert outcomes(state)[NAVIGATOR_MISSION].startswith("revoked:")


async def test_sdk_returns_control_and_mission_completes(rig: Rig) -> None:
    rig.write_grant(grant())
    rig.start_service()
    rig.start_vehicle()
    async with Mobility(endpoint(rig)) as drone:
        async with drone.control() as control:
            await drone.arm()
            await drone.takeoff(10)
            position = (await drone.position()).position
            await drone.goto(position.lat, position.lon, 12.0)
        assert control.mission_complete
        await rig.until(lambda t: not t.armed, 90, "landing")
        with pytest.raises(MissionComplete):
            async with drone.control():
                raise AssertionError("control was granted after the mission")


async def test_sdk_watch_streams_report_vehicle_state(rig: Rig) -> None:
    rig.write_grant(grant())
    rig.start_service()
    rig.start_vehicle()
    async with Mobility(endpoint(rig)) as drone, asyncio.timeout(60):
        async with contextlib.aclosing(drone.watch.health()) as healths:
            health_reports = [health async for health in _until(healths, lambda health: health.ready)]
        assert all(health.problem for health in health_reports[:-1])
        assert health_reports[-1].problem == ""
        assert (await anext(drone.watch.gps())).satellites >= 6
        assert (await anext(drone.watch.battery())).voltage_v > 10
        assert abs((await anext(drone.watch.attitude())).roll_deg) < 5
        assert (await anext(drone.watch.wind())).speed_mps < 30
        async with drone.control():
            text = asyncio.create_task(anext(drone.watch.status_texts()))
            await drone.arm()
            await drone.disarm()
            assert (await text).text


async def _until(items: AsyncIterator[T], over: Callable[[T], bool]) -> AsyncIterator[T]:
    async for item in items:
        yield item
        if over(item):
            return


async def test_sdk_dry_runs_and_passenger_poi_mission(rig: Rig) -> None:
    rig.write_grant(grant(altitude_limit(5, 15), fence("no-fly", "exclusion", "revoke", -60, -10, -40, 10)))
    rig.start_service()
    rig.start_vehicle()
    await rig.until(lambda t: t.HasField("position") and t.HasField("home"), 30)
    async with Mobility(endpoint(rig)) as drone:
        # A known position is not sufficient for a call: the delay of the link must be measured too.
        async with asyncio.timeout(60), contextlib.aclosing(drone.watch.health()) as healths:
            async for _ in _until(healths, lambda health: health.ready):
                pass
        high = await drone.can_i.takeoff(40)
        assert high, high
        assert high.altitude_m == pytest.approx(14.8)
        assert high.decision.policies == ("altitudes",)
        into = await drone.can_i.goto(*FRAME.latlon(-50, 0), 10)
        assert not into
        assert into.takeover == "revoke"
        fast = await drone.can_i.set_speed(30)
        assert fast.speed_mps == pytest.approx(11.4)
        slow = await drone.can_i.set_velocity(1.0, 0.0, yaw_deg=90)
        assert slow.velocity is None or slow.velocity.north <= 1.0
        assert (await drone.can_i.hover()).allowed
        with pytest.raises(ControlLost):
            await drone.set_velocity(1.0, 0.0)
        async for sample in drone.telemetry(0.1):
            assert sample.attitude is not None
            assert abs(sample.attitude.roll_deg) < 5
            break

    def plainly() -> None:
        with sync.Mobility(endpoint(rig)) as drone:
            assert drone.can_i.takeoff(40).altitude_m == pytest.approx(14.8)
            samples: Any = drone.telemetry(0.1)
            assert next(samples).attitude is not None
            samples.close()

    await asyncio.to_thread(plainly)

    points = [dict(zip(("lat", "lon", "alt"), (*FRAME.latlon(0, 30), 10.0), strict=True))]
    rig.write_grant(passenger_grant(tour=points, services=[{"service": "mobility", "methods": ["GetControl"]}]))
    await rig.until(lambda t: t.ready and len(rig.entries("grant")) == 2, 20, "the passenger's grant")
    async with Mobility(endpoint(rig, PASSENGER)) as viewer:
        assert not await viewer.can_i.goto(*FRAME.latlon(0, 10), 10)
        async with contextlib.aclosing(viewer.passenger()) as tour:
            async for progress in tour:
                assert (progress.visited, progress.complete) == (0, False)
                if progress.flying:
                    break


CALL_EVERY_S = 0.05
LIFE_S = 8.0


async def test_sdk_calls_succeed_during_certificate_renewal(rig: Rig) -> None:
    """Certificates of services and client are renewed while the client holds control of the drone."""
    rig.write_grant(
        grant(services=[{"service": "mobility", "methods": ALL}, {"service": "camera", "methods": ["ListImages"]}])
    )
    rig.start_service()
    camera_address = rig.start_camera()
    rig.start_vehicle()
    await rig.until(lambda t: t.ready and t.HasField("position"), 40)
    clock = asyncio.get_running_loop()
    rig.write_tls(seconds=LIFE_S)
    client_endpoint = endpoint(rig, seconds=LIFE_S)
    expiry_s = clock.time() + LIFE_S
    async with Mobility(client_endpoint) as drone, Camera(replace(client_endpoint, address=camera_address)) as camera:
        calls: list[asyncio.Task[object]] = []

        async def call_until(end_s: float) -> None:
            # Start calls at a fixed rate, so that a stalled call does not delay later calls.
            while clock.time() < end_s:
                calls.extend(map(asyncio.ensure_future, (drone.position(), camera.list())))
                await asyncio.sleep(CALL_EVERY_S)

        async with asyncio.timeout(60), drone.control() as control:
            await call_until(clock.time() + 0.5)
            rig.write_tls()
            await call_until(clock.time() + 0.5)
            endpoint(rig)
            await call_until(expiry_s + 2.0)
            ended = await asyncio.gather(*calls, return_exceptions=True)
            assert [result for result in ended if isinstance(result, BaseException)] == []
            assert control.lost is None
            assert (await rig.telemetry()).controller == DRIVER
    assert len(calls) > 20 * LIFE_S
