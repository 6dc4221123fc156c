"""A MAVSDK-Python 4 program that uses the plugins action, telemetry, offboard, geofence, param and mission."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator, Callable
from typing import Any

from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins import action, geofence, mission, mission_raw, offboard, param, telemetry
from mavsdk.plugins import geofence as shapes
from mavsdk.plugins.mission import MissionError, MissionItem, MissionPlan, MissionResult
from mavsdk.plugins.offboard import PositionNedYaw, VelocityNedYaw

METRES = 111_319.0


async def first(
    stream: AsyncIterator[Any], condition: Callable[[Any], bool], description: str, timeout_s: float = 40.0
) -> Any:
    """Return the first value of a stream for which a condition holds."""
    async with asyncio.timeout(timeout_s):
        async for value in stream:
            if condition(value):
                print("ok:", description, flush=True)
                return value
    raise SystemExit(f"stream ended: {description}")


async def fly(url: str) -> None:
    """Fly with each plugin in turn."""
    core = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    await core.add_any_connection(url)
    system = await core.first_autopilot(timeout_s=15.0)
    assert system is not None, "no autopilot"
    sense = telemetry.TelemetryAsync(system)
    for rate in (sense.set_rate_health, sense.set_rate_home, sense.set_rate_position, sense.set_rate_landed_state):
        await rate(5.0)
    for rate in (sense.set_rate_velocity_ned, sense.set_rate_position_velocity_ned, sense.set_rate_gps_info):
        await rate(10.0)
    ready = lambda h: h.is_global_position_ok and h.is_home_position_ok and h.is_armable  # noqa: E731
    await first(sense.subscribe_health(), ready, "healthy")
    home = await first(sense.subscribe_home(), lambda _: True, "home")
    await parameters(param.ParamAsync(system))
    act = action.ActionAsync(system)
    await act.set_takeoff_altitude(8.0)
    await act.arm()
    await act.takeoff()
    await first(sense.subscribe_position(), lambda p: p.relative_altitude_m > 7.5, "takeoff")
    await act.goto_location(home.latitude_deg + 20 / METRES, home.longitude_deg, home.absolute_altitude_m + 10, 0.0)
    arrived = lambda p: abs(p.latitude_deg - home.latitude_deg - 20 / METRES) * METRES < 1.5  # noqa: E731
    await first(sense.subscribe_position(), arrived, "goto_location")
    await act.hold()
    await steer(offboard.OffboardAsync(system), sense)
    await fence(geofence.GeofenceAsync(system), home)
    await missions(mission.MissionAsync(system), mission_raw.MissionRawAsync(system), home)
    await act.return_to_launch()
    await first(sense.subscribe_armed(), lambda armed: not armed, "landed and disarmed", 60.0)
    print("DONE", flush=True)


async def parameters(params: param.ParamAsync) -> None:
    """Read, write and list parameters."""
    assert await params.get_param_float("WPNAV_SPEED") == 1000.0
    await params.set_param_float("WPNAV_SPEED", 900.0)
    assert await params.get_param_float("WPNAV_SPEED") == 900.0
    everything = await params.get_all_params()
    assert len(everything.int_params) + len(everything.float_params) > 400
    print("ok: param", flush=True)


async def steer(board: offboard.OffboardAsync, sense: telemetry.TelemetryAsync) -> None:
    """Fly positions and velocities with the offboard plugin."""
    await board.set_position_ned(PositionNedYaw(20.0, 0.0, -10.0, 0.0))
    await board.start()
    await board.set_position_ned(PositionNedYaw(20.0, 10.0, -12.0, 90.0))
    arrived = lambda p: abs(p.position.east_m - 10.0) < 0.7 and abs(p.position.down_m + 12.0) < 0.5  # noqa: E731
    await first(sense.subscribe_position_velocity_ned(), arrived, "offboard position")
    await board.set_velocity_ned(VelocityNedYaw(-2.0, 0.0, 0.0, 0.0))
    await first(sense.subscribe_velocity_ned(), lambda v: v.north_m_s < -1.7, "offboard velocity")
    await board.stop()


async def fence(fences: geofence.GeofenceAsync, home: Any) -> None:
    """Upload an inclusion polygon."""
    corners = [
        shapes.Point(home.latitude_deg + north / METRES, home.longitude_deg + east / 74_000)
        for north, east in ((-200, -200), (200, -200), (200, 200), (-200, 200))
    ]
    polygon = shapes.Polygon(corners, shapes.FenceType.INCLUSION)
    await fences.upload_geofence(shapes.GeofenceData([polygon], []))
    print("ok: geofence", flush=True)


async def upload(missions: mission.MissionAsync, plan: MissionPlan) -> None:
    """Upload a mission. Retry, because MAVSDK may still be busy after it has reported the end of a transfer."""
    for remaining in reversed(range(100)):
        try:
            await missions.upload_mission(plan)
        except MissionError as error:
            if error.result != MissionResult.BUSY or not remaining:
                raise
            await asyncio.sleep(0.1)
        else:
            return


async def missions(missions: mission.MissionAsync, raw: mission_raw.MissionRawAsync, home: Any) -> None:
    """Upload a mission, read it back and fly it."""
    items = [
        MissionItem(
            latitude_deg=home.latitude_deg + north / METRES,
            longitude_deg=home.longitude_deg + east / 74_000,
            relative_altitude_m=altitude,
            speed_m_s=5.0,
            is_fly_through=True,
        )
        for north, east, altitude in ((10, 0, 10.0), (10, 10, 12.0), (0, 10, 10.0))
    ]
    # MAVSDK sets the parameters of its return item to NaN. The simulated vehicle must refuse this item, like ArduPilot.
    await missions.set_return_to_launch_after_mission(True)
    try:
        await missions.upload_mission(MissionPlan(items))
    except MissionError as error:
        print("ok: refused", error, flush=True)
    else:
        raise SystemExit("the vehicle accepted a return item with NaN parameters")
    await missions.set_return_to_launch_after_mission(False)
    await upload(missions, MissionPlan(items))
    assert len(await raw.download_mission()) >= len(items)
    await missions.start_mission()
    await first(missions.subscribe_mission_progress(), lambda p: 0 < p.total == p.current, "mission", timeout_s=60.0)


if __name__ == "__main__":
    asyncio.run(asyncio.wait_for(fly(sys.argv[1]), 150.0))
