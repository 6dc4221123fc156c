"""Tests of an application with an edge component over a simulated network. They need Linux and root."""

from __future__ import annotations

import pytest
from fractus_testing import SUCCESS, FlightPlan, Network, Scene, VirtualDrone, circle, no_fly, until

pytestmark = pytest.mark.fractus(speedup=2)
HOME = (39.3600, 22.9450, 3.0)
PLAN = FlightPlan(path=[(39.3603, 22.9450, 10), (39.3609, 22.9450, 10)])
"""Waypoints 33 m and 100 m north of the start."""


def start(fractus: Scene, network: Network) -> VirtualDrone:
    """Start a drone that reports to an edge node at its start."""
    drone = fractus.vDrone("vDrone-1")
    drone.set_pos(HOME)
    drone.set_plan(PLAN)
    drone.set_app("report_app.py")
    edge = fractus.vNode("edge-1", HOME)
    edge.set_app("collector.py", component="Collector", port=7000)
    fractus.NetSim(network).add_participants(drone, edge)
    edge.start_app()
    drone.start_app()
    return drone


def test_reports_arrive_over_a_slow_network(fractus: Scene) -> None:
    drone = start(fractus, Network(delay=0.1, loss=0.02, bandwidth=2))
    drone.wait_landed(240)

    results = fractus.results()
    results.check_app_status("vDrone-1", SUCCESS)
    # Two reports of 20,000 bytes, and the calls of the SDK.
    results.check_data_sent("vDrone-1", level="app", min=40_000, max=150_000)
    assert 100 < results.get_data_sent("edge-1", level="app") < 10_000


def test_drone_out_of_range_continues_without_its_edge_node(fractus: Scene) -> None:
    drone = start(fractus, Network(range=60))
    drone.wait_landed(240)

    results = fractus.results()
    results.check_app_status("vDrone-1", SUCCESS)
    results.check("reached", lat=39.3609, lon=22.9450, alt=10)
    # One of two reports of 20,000 bytes has arrived.
    results.check_data_sent("vDrone-1", level="app", min=20_000, max=60_000)
    results.check_landed("vDrone-1", near_home=3)


def test_restriction_waits_until_the_drone_is_in_range(fractus: Scene) -> None:
    controller = fractus.vController()
    controller.set_pos(HOME)
    drone = fractus.vDrone("vDrone-1")
    drone.set_pos(HOME)
    drone.set_plan(PLAN)
    drone.set_app("waypoint_app.py", params={"ALTITUDE": "10", "WAYPOINTS": PLAN.path})
    fractus.NetSim(Network(range=60)).add_participants(controller, drone)
    drone.start_app()
    drone.wait(until(drone, reached=2))
    controller.update_restrictions(no_fly("closed", circle(39.3609, 22.9450, 5), action="returnToLaunch"))
    drone.wait_landed(240)

    fractus.results().check_no_violations("vDrone-1")
