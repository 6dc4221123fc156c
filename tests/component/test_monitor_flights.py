"""The motion monitor on simulated flights of the policy oracle.

The monitor does not stop drones on permitted legs. It stops drones in time before a new zone.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from fractus_core.policy.decision_types import Airframe
from fractus_core.policy.kinematics import stop_point
from fractus_core.policy.monitoring import monitor
from policy_flights import STEP_S, Fleet, scene
from policy_world import ask, at, box, compiled, exclusion, goto

WALL = box(-50, 50, 50, 90)


@pytest.mark.parametrize("speed_mps", [2.0, 5.0, 8.0, 12.0])
def test_monitor_never_stops_permitted_flights(speed_mps: float) -> None:
    """A drone flies a permitted leg to the edge of a zone's margin, braking as ArduPilot does."""
    grant = compiled(exclusion(WALL, "revoke"), operationArea=[])
    assert ask(grant, goto(0, 47.4, speed_mps=speed_mps)).permits
    rng = np.random.default_rng(1)
    fleet = Fleet(rng, [scene(rng)])
    fleet.airframes = [Airframe()]
    fleet.learn()
    fleet.place[:] = [0, 0, 10]
    fleet.speed[:] = 0.0
    fleet.gust[:] = 0.0
    fleet.error[:] = 0.0
    fleet.goal[:] = [0, 47.4, 10]
    fleet.cruise[:] = speed_mps
    fleet.setpoint[:] = speed_mps
    fleet.held[:] = False
    for _ in range(int(60 / STEP_S)):
        fleet.step()
        x, y, z = fleet.place[0]
        east, north, up = fleet.speed[0]
        now = at(
            x, y, z, east_mps=east, north_mps=north, down_mps=-up, speed_setpoint_mps=speed_mps,
            forward_mps2=fleet.accel[0, 1],
        )  # fmt: skip
        assert monitor(now, grant) is None, (y, north)
    assert fleet.place[0, 1] == pytest.approx(47.4, abs=0.1)


@pytest.mark.parametrize("appears_s", [0.5, 1.0, 1.5, 2.0, 2.5, 3.0])
def test_monitor_stops_accelerating_drone_before_new_zone(appears_s: float) -> None:
    rng = np.random.default_rng(1)
    fleet = Fleet(rng, [scene(rng)])
    fleet.airframes = [Airframe()]
    fleet.learn()
    fleet.place[:] = [0, 0, 10]
    fleet.speed[:] = 0.0
    fleet.gust[:] = 0.0
    fleet.error[:] = 0.0
    fleet.goal[:] = [0, 300, 10]
    fleet.cruise[:] = 12.0
    fleet.setpoint[:] = 12.0
    fleet.held[:] = False
    while fleet.time_s < appears_s:
        fleet.step()
    assert fleet.accel[0, 1] > 0.8 * fleet.accels[0]
    coasting = stop_point(at(north_mps=fleet.speed[0, 1], forward_mps2=0.0), (0.0, 0.0))[1]
    wall_m = fleet.place[0, 1] + coasting + 16.0
    grant = compiled(exclusion(box(-50, wall_m, 50, wall_m + 40), "revoke"))
    checks = 0
    while True:
        x, y, z = fleet.place[0]
        now = at(x, y, z, north_mps=fleet.speed[0, 1], speed_setpoint_mps=12.0, forward_mps2=fleet.accel[0, 1])
        verdict = monitor(now, grant, fences_changed=True)
        if verdict is not None:
            break
        assert monitor(now, grant) is None
        fleet.step()
        checks += 1
    assert checks > 2, "the monitor does not stop the drone at once"
    assert (verdict.action, verdict.takeover) == ("deny", "hover"), (
        "the monitor stops the drone without takeover, because the drone might not enter the zone"
    )
    assert monitor(now, grant) is None, "the monitor would not stop the drone if the fences had not changed"
    for _ in range(int(now.latency_s / STEP_S)):
        fleet.step()
    # The service commands a zero velocity.
    fleet.held[:] = True
    fleet.velocity_setpoint[:] = 0.0
    fleet.until[:] = math.inf
    for _ in range(int(20 / STEP_S)):
        fleet.step()
    rest_m = wall_m - fleet.place[0, 1]
    assert now.position_error_m < rest_m < 5.0, "the drone stops shortly before the zone"
