"""Cold start: the service connects to a vehicle that was just switched on, over links that lose frames."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest
from closed_loop import Account, Drone, Sky, Weather
from depth import cells
from fractus_core.control import StreamState
from fractus_services.mobility.autopilot import FailsafeStatus
from mobility_world import spec

SLOW = {"WPNAV_ACCEL": 100.0, "PSC_JERK_XY": 3.0, "WPNAV_SPEED": 600.0, "GUID_TIMEOUT": 3.0, "FS_GCS_ENABLE": 0.0}


async def until(condition: Callable[[], object]) -> None:
    while not condition():  # noqa: ASYNC110 - the simulation has no notification
        await asyncio.sleep(0.1)


async def armed(sky: Sky, directory: Path) -> FailsafeStatus:
    """Arm the drone. Return the result of the failsafe verification at that time."""
    drone = Drone(directory, Account(0))
    turning = asyncio.ensure_future(sky.run_vehicle())
    grant = drone.grants.put(spec())
    following = asyncio.ensure_future(drone.follow(grant))
    try:
        async with asyncio.timeout(300):
            await until(lambda: drone.state is StreamState.GRANTED)
            assert sky.truth.home is not None, "control was granted before the vehicle was ready"
            await drone.service.arm(grant, 120.0)
        assert drone.control.failsafe_status is not None
        return drone.control.failsafe_status
    finally:
        for task in (following, turning):
            task.cancel()
        await asyncio.gather(following, turning, return_exceptions=True)
        await drone.close()


@pytest.mark.parametrize(
    ("loss", "seed"), cells([(0.0, 1), (0.1, 2), (0.1, 3), (0.3, 4)], quick=[(0.0, 1), (0.1, 2), (0.1, 3)])
)
def test_arming_uses_vehicle_parameters_after_cold_start_with_frame_loss(
    tmp_path: Path, loss: float, seed: int
) -> None:
    sky = Sky(seed, Weather(uplink_s=0.03, downlink_s=0.03, loss=loss), SLOW)
    with asyncio.Runner(loop_factory=lambda: sky) as runner:
        checked = runner.run(armed(sky, tmp_path))
    assert not checked.problem
    assert (checked.airframe.accel_mps2, checked.airframe.jerk_mps3, checked.speed_mps) == (1.0, 3.0, 6.0)
    params = sky.truth.params
    assert (params["GUID_TIMEOUT"], params["FENCE_ENABLE"]) == (1.0, 1.0)
    assert params["FS_GCS_ENABLE"] in {1.0, 3.0}
