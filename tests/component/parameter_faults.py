"""Vehicles whose parameters are lost, absent, no numbers, or unusual, against a plain reading of what their services may fly."""

from __future__ import annotations

import asyncio
import logging
import math
import random
from collections.abc import Iterable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.failsafes import MavlinkFailsafes
from fractus_services.mobility.mavlink.parameters import ParameterLost

NEEDED = {
    "accel_mps2": (("WPNAV_ACCEL", 0.01), ("WP_ACC", 1.0), 0.1),
    "position_gain": (("PSC_POSXY_P", 1.0), ("PSC_NE_POS_P", 1.0), 0.1),
    "climb_accel_mps2": (("WPNAV_ACCEL_Z", 0.01), ("WP_ACC_Z", 1.0), 0.1),
    "jerk_mps3": (("PSC_JERK_XY", 1.0), ("PSC_NE_JERK", 1.0), 0.5),
    "return_altitude_m": (("RTL_ALT", 0.01), ("RTL_ALT_M", 1.0), -math.inf),
    "speed_mps": (("WPNAV_SPEED", 0.01), ("WP_SPD", 1.0), -math.inf),
}
"""What must be known of how a vehicle moves: its name before release 4.7 and since, each with its unit, and the least."""

OTHERS = {
    "SYSID_MYGCS": 255.0, "FS_GCS_ENABLE": 0.0, "FS_GCS_TIMEOUT": 5.0, "GUID_TIMEOUT": 3.0, "BATT_FS_LOW_ACT": 0.0,
    "BATT_FS_CRT_ACT": 0.0, "FS_EKF_ACTION": 1.0, "SRTL_POINTS": 300.0, "FENCE_ENABLE": 0.0, "FENCE_AUTOENABLE": 0.0,
    "FENCE_TYPE": 7.0, "FENCE_ALT_MAX": 100.0, "FENCE_MARGIN": 2.0, "FENCE_ACTION": 1.0, "FENCE_OPTIONS": 0.0,
    "RTL_SPEED": 0.0, "RTL_CLIMB_MIN": 0.0, "RTL_CONE_SLOPE": 3.0, "GUID_OPTIONS": 0.0, "FS_EKF_THRESH": 0.8,
}  # fmt: skip


@dataclass
class _Parameters:
    """A vehicle's parameters as the service reads and sets them."""

    values: dict[str, float]
    lost: set[str]
    told: dict[str, float] = field(default_factory=dict)
    leg_speed: dict[str, float] = field(default_factory=dict)

    async def read(self, wanted: Iterable[tuple[str, ...]]) -> dict[str, float]:
        """Those that the vehicle has.

        Raises:
            ParameterLost: one of them does not answer.
        """
        names = {name for names in wanted for name in names}
        if names & self.lost:
            raise ParameterLost(f"{', '.join(sorted(names & self.lost))} cannot be read")
        return {name: value for name, value in self.values.items() if name in names}

    async def write(self, name: str, value: float) -> float:
        """Set one."""
        self.values[name] = value
        return value


def parameter_faults(seed: int, count: int) -> list[str]:
    """Vehicles with random faults: what went wrong with which.

    A service may arm only a vehicle all of whose figures it knows, and flies it by these.
    """
    rng = random.Random(seed)
    logging.getLogger("fractus_services.mobility.mavlink.failsafes").setLevel(logging.CRITICAL + 1)
    with asyncio.Runner() as runner:
        return [f"seed {seed}, vehicle {i}: {wrong}" for i in range(count) if (wrong := runner.run(_wrong(rng)))]


async def _wrong(rng: random.Random) -> str:
    """What is wrong with what the service makes of one vehicle."""
    values = dict(OTHERS)
    lost = set()
    expected = {}
    known = True
    for figure, (older, newer, least) in NEEDED.items():
        name, scale = rng.choice((older, newer))
        value = rng.choice((rng.uniform(0.5, 10.0), 0.0, -1.0, 1e6)) / scale
        match rng.choice(("told",) * 20 + ("lost", "absent", "no number")):
            case "lost":
                lost.add(name)
                known = False
            case "absent":
                known = False
            case "no number":
                values[name] = rng.choice((math.nan, math.inf, -math.inf))
                known = False
            case _:
                values[name] = value
        expected[figure] = max(value * scale, least)
    name, scale, lean_deg = rng.choice(
        (("ANGLE_MAX", 0.01, 10.0), ("ANGLE_MAX", 0.01, 30.0), ("ATC_ANGLE_MAX", 1.0, 20.0))
    )
    values |= {name: lean_deg / scale, "PSC_ANGLE_MAX": rng.choice((0.0, 15.0))}
    braking_deg = (values["PSC_ANGLE_MAX"] or lean_deg) - 4.0
    expected["accel_mps2"] = min(expected["accel_mps2"], 9.81 * math.tan(math.radians(braking_deg)))
    parameters = _Parameters(values, lost)
    autopilot: Any = SimpleNamespace(
        stack=ARDUCOPTER, vehicle_parameters=parameters, vehicle=SimpleNamespace(unsupported="")
    )
    checked = await MavlinkFailsafes(autopilot).configure()
    if not known:
        return "" if checked.problem else f"may arm, though not all is known: {values}, lost {lost}"
    if checked.problem:
        return f"may not arm, though all is known: {checked.problem}"
    flown = {figure: getattr(checked.airframe, figure, checked.speed_mps) for figure in expected}
    differ = [figure for figure in expected if not math.isclose(flown[figure], expected[figure], abs_tol=1e-9)]
    return f"{differ} of {flown} are not {expected}" if differ else ""
