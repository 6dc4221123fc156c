"""Checks the service with vehicles whose parameters are missing, unreadable or unusual.

The oracle computes the flight limits from the parameters independently of the service.
"""

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
"""Parameters by Airframe field: name and scale before ArduCopter 4.7, name and scale since 4.7, and minimum."""

OTHER_PARAMETERS = {
    "SYSID_MYGCS": 255.0, "FS_GCS_ENABLE": 0.0, "FS_GCS_TIMEOUT": 5.0, "GUID_TIMEOUT": 3.0, "BATT_FS_LOW_ACT": 0.0,
    "BATT_FS_CRT_ACT": 0.0, "FS_EKF_ACTION": 1.0, "SRTL_POINTS": 300.0, "FENCE_ENABLE": 0.0, "FENCE_AUTOENABLE": 0.0,
    "FENCE_TYPE": 7.0, "FENCE_ALT_MAX": 100.0, "FENCE_MARGIN": 2.0, "FENCE_ACTION": 1.0, "FENCE_OPTIONS": 0.0,
    "RTL_SPEED": 0.0, "RTL_CLIMB_MIN": 0.0, "RTL_CONE_SLOPE": 3.0, "GUID_OPTIONS": 0.0, "FS_EKF_THRESH": 0.8,
}  # fmt: skip


@dataclass
class _Parameters:
    """Fake of the parameter interface that the service uses."""

    values: dict[str, float]
    unreadable: set[str]
    reported: dict[str, float] = field(default_factory=dict)
    leg_speed: dict[str, float] = field(default_factory=dict)

    async def read(self, requested: Iterable[tuple[str, ...]]) -> dict[str, float]:
        """Return the requested parameters that the vehicle has.

        Raises:
            ParameterLost: A parameter is unreadable.
        """
        names = {name for alternatives in requested for name in alternatives}
        if names & self.unreadable:
            raise ParameterLost(f"{', '.join(sorted(names & self.unreadable))} cannot be read")
        return {name: value for name, value in self.values.items() if name in names}

    async def write(self, name: str, value: float) -> float:
        """Set a parameter."""
        self.values[name] = value
        return value


def parameter_faults(seed: int, count: int) -> list[str]:
    """Check vehicles with random parameter faults, and return a text for each violation.

    The service must arm a vehicle only if all required parameters are known, and it must use their values.
    """
    rng = random.Random(seed)
    logging.getLogger("fractus_services.mobility.mavlink.failsafes").setLevel(logging.CRITICAL + 1)
    with asyncio.Runner() as runner:
        return [f"seed {seed}, vehicle {i}: {wrong}" for i in range(count) if (wrong := runner.run(_violation(rng)))]


async def _violation(rng: random.Random) -> str:
    """Return the violation of the service for one random vehicle, or an empty text."""
    values = dict(OTHER_PARAMETERS)
    unreadable = set()
    expected = {}
    known = True
    for field_name, (older, newer, minimum) in NEEDED.items():
        name, scale = rng.choice((older, newer))
        value = rng.choice((rng.uniform(0.5, 10.0), 0.0, -1.0, 1e6)) / scale
        match rng.choice(("reported",) * 20 + ("unreadable", "absent", "no number")):
            case "unreadable":
                unreadable.add(name)
                known = False
            case "absent":
                known = False
            case "no number":
                values[name] = rng.choice((math.nan, math.inf, -math.inf))
                known = False
            case _:
                values[name] = value
        expected[field_name] = max(value * scale, minimum)
    name, scale, lean_deg = rng.choice(
        (("ANGLE_MAX", 0.01, 10.0), ("ANGLE_MAX", 0.01, 30.0), ("ATC_ANGLE_MAX", 1.0, 20.0))
    )
    values |= {name: lean_deg / scale, "PSC_ANGLE_MAX": rng.choice((0.0, 15.0))}
    braking_deg = (values["PSC_ANGLE_MAX"] or lean_deg) - 4.0
    expected["accel_mps2"] = min(expected["accel_mps2"], 9.81 * math.tan(math.radians(braking_deg)))
    parameters = _Parameters(values, unreadable)
    autopilot: Any = SimpleNamespace(
        stack=ARDUCOPTER, vehicle_parameters=parameters, vehicle=SimpleNamespace(unsupported="")
    )
    checked = await MavlinkFailsafes(autopilot).configure()
    if not known:
        return "" if checked.problem else f"may arm with unknown parameters: {values}, unreadable {unreadable}"
    if checked.problem:
        return f"may not arm with known parameters: {checked.problem}"
    flown = {field_name: getattr(checked.airframe, field_name, checked.speed_mps) for field_name in expected}
    differ = [
        field_name for field_name in expected if not math.isclose(flown[field_name], expected[field_name], abs_tol=1e-9)
    ]
    return f"fields {differ} differ: {flown} instead of {expected}" if differ else ""
