"""Vehicles in lockstep for tests of the simulated vehicle."""

from __future__ import annotations

import math
from dataclasses import replace

from fractus_vehicle.earth import Place
from fractus_vehicle.simulation import Simulation
from fractus_vehicle.state import VehicleConfig, VehicleState
from vehicle_pilot import Pilot

START = Place.from_degrees(48.2, 16.37, 150.0)
CONFIG = VehicleConfig(start=START, ready_after_s=2.0, position_noise_m=0.05)


def alone(*, config: VehicleConfig = CONFIG, **parameters: float) -> tuple[VehicleState, Pilot]:
    """Return one vehicle and its pilot."""
    simulation = Simulation([replace(config, parameters={**config.parameters, **parameters})])
    craft = simulation.crafts[0]
    return craft.vehicle.state, Pilot(simulation, craft)


def airborne(altitude_m: float = 10.0, **parameters: float) -> tuple[VehicleState, Pilot]:
    """Return one vehicle that hovers in GUIDED."""
    vehicle, pilot = alone(**parameters)
    pilot.take_off(altitude_m)
    pilot.wait(lambda: not vehicle.taking_off, 20.0)
    return vehicle, pilot


def distance_m(vehicle: VehicleState, north_m: float, east_m: float) -> float:
    """Return the true horizontal distance of a vehicle from a local point."""
    return math.hypot(vehicle.body.north - north_m, vehicle.body.east - east_m)


def upload(pilot: Pilot, kind: int, items: list[dict[str, float]]) -> int:
    """Upload a list by the mission protocol and return the final MISSION_ACK type."""
    pilot.read()
    target = {"target_system": 1, "target_component": 1, "mission_type": kind}
    pilot.send("MISSION_COUNT", target | {"count": len(items)})
    for _ in range(len(items) + 2):
        for message in pilot.step():
            if message.name == "MISSION_REQUEST":
                seq = message.integer("seq")
                pilot.send("MISSION_ITEM_INT", target | {"seq": seq, "autocontinue": 1} | items[seq])
            elif message.name == "MISSION_ACK":
                return message.integer("type")
    raise AssertionError("no MISSION_ACK")
