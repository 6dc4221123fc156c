"""The SDK against the real service: what components will live with."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from fractus.drone import Mobility
from fractus.environment import Endpoint
from fractus.errors import ControlLost, InvalidRequest, MissionComplete, PolicyDenied
from fractus_core.api.plans import node_server_name
from mobility_rig import DRIVER, FRAME, NODE, Rig, altitude_limit, fence, grant


@pytest.fixture
async def rig(tmp_path: Path) -> AsyncIterator[Rig]:
    rig = Rig(tmp_path)
    try:
        yield rig
    finally:
        await rig.close()


def endpoint(rig: Rig) -> Endpoint:
    folder = rig.directory / "driver-tls"
    folder.mkdir(exist_ok=True)
    key, certificate = rig.authority.issue(DRIVER)
    for name, data in (("tls.key", key), ("tls.crt", certificate), ("ca.crt", rig.authority.pem)):
        (folder / name).write_bytes(data)
    return Endpoint(rig.address, node_server_name(NODE), folder)


async def test_a_mission_through_the_sdk(rig: Rig) -> None:
    rig.write_grant(
        grant(
            altitude_limit(5, 15),
            fence("no-fly", "exclusion", "ignore", -60, -10, -40, 10),
            fence("sensitive", "exclusion", "revoke", 60, 60, 80, 80),
        )
    )
    patient = ("--driver-grace", "15")  # a restart takes seconds on a busy machine
    rig.start_service(*patient)
    rig.start_vehicle(1.0)  # five of its seconds after the service went it flies home
    async with Mobility(endpoint(rig)) as drone:
        with pytest.raises(ControlLost):
            async with drone.control() as control:
                assert control.control_point == 0
                await drone.arm()
                up = await drone.takeoff(20)
                assert up.corrected
                lat, lon = FRAME.latlon(0, 40)
                there = await drone.goto(lat, lon, 10)
                assert not there.corrected
                with pytest.raises(PolicyDenied) as refused:
                    await drone.goto(*FRAME.latlon(-50, 0), 10)
                assert refused.value.code == "InsideExclusionZone"
                with pytest.raises(InvalidRequest):
                    await drone.goto(math.nan, lon, 10)
                rig.kill("service")
                rig.start_service(*patient)
                await drone.goto(*FRAME.latlon(40, 40), 10)
                with pytest.raises(PolicyDenied) as taken:
                    await drone.goto(*FRAME.latlon(70, 70), 10)
                assert taken.value.decision.action.name == "TAKEOVER"
                await drone.goto(*FRAME.latlon(0, 0), 10)
    state = await rig.until(lambda t: not t.armed, 60, "landing")
    assert state.missions["uid-app-navigator"].startswith("revoked:")


async def test_control_returned_through_the_sdk(rig: Rig) -> None:
    rig.write_grant(grant())
    rig.start_service()
    rig.start_vehicle()
    async with Mobility(endpoint(rig)) as drone:
        async with drone.control() as control:
            await drone.arm()
            await drone.takeoff(10)
        assert control.mission_complete
        await rig.until(lambda t: not t.armed, 60, "landing")
        with pytest.raises(MissionComplete):
            async with drone.control():
                raise AssertionError("control after the mission")
