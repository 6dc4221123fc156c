"""Position estimator without absolute position: the vehicle uses dead reckoning although its GPS reports a fix."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
import shapely
from closed_loop import Account, Oracle, Sky
from fractus_core.policy.decision_types import TakeoffArgs
from fractus_services.mobility.rpc.telemetry import located
from fractus_vehicle.body import Body
from fractus_vehicle.control import Estimate
from fractus_vehicle.estimator import Estimator
from mobility_world import goto, spec, zone
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sky_drone import fly, ready, until

WALL = shapely.box(-100.0, 40.0, 100.0, 70.0)
FLOW = (
    mavlink.EKF_ATTITUDE | mavlink.EKF_VELOCITY_HORIZ | mavlink.EKF_VELOCITY_VERT
    | mavlink.EKF_POS_HORIZ_REL | mavlink.EKF_POS_VERT_ABS | mavlink.EKF_PRED_POS_HORIZ_REL
)  # fmt: skip
"""EKF flags of a vehicle that navigates by optical flow.

The estimator rejects the GPS, or the pilot has selected optical flow. The vehicle stays in GUIDED.
"""

DRIFT_MPS = 0.3


def test_drone_returns_home_if_estimator_has_no_absolute_position(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def work(sky: Sky, directory: Path) -> None:
        oracle = Oracle(sky, Account(0))
        async with ready(sky, directory) as (drone, grant):
            drone.grants.put(spec(zone("wall", "ignore", *WALL.bounds)))
            await drone.service.arm(grant, 120.0)
            async for _ in drone.service.take_off(grant, TakeoffArgs(15.0)):
                pass
            async for _ in drone.service.goto(grant, goto(0.0, 32.0), 0.0):
                pass
            distances_m: list[float] = []
            sky.witnesses.append(lambda: distances_m.append(WALL.distance(shapely.Point(*oracle.place()[:2]))))
            since_s = sky.time()
            estimate = Estimator.estimate

            def drifting(self: Estimator, body: Body) -> Estimate:
                known = estimate(self, body)
                return known._replace(north=known.north - DRIFT_MPS * (sky.time() - since_s))

            monkeypatch.setattr(Estimator, "estimate", drifting)
            monkeypatch.setattr(Estimator, "flags", FLOW)
            await asyncio.sleep(2.0)
            assert not located(drone.control), "camera requests must not use a position from dead reckoning"
            await until(lambda: drone.control.state.returning or min(distances_m) <= 0.0)
            assert min(distances_m) > 1.0

    fly(work, tmp_path)
