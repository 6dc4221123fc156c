"""Tests of the waypoint application with a virtual drone. Run them with `pytest examples/testing`."""

from __future__ import annotations

from collections.abc import Mapping

import config
import pytest
from fractus_testing import (
    ABORTED,
    SITL,
    SUCCESS,
    Ardupilot,
    Builtin,
    Scene,
    VirtualController,
    VirtualDrone,
    app,
    autopilot,
    circle,
    no_fly,
    runtime,
    until,
)


def start(fractus: Scene, params: Mapping[str, object]) -> tuple[VirtualController, VirtualDrone]:
    """Start the application on a virtual drone."""
    controller = fractus.vController()
    drone = fractus.vDrone("vDrone-1", SITL,
                           autopilot=Ardupilot,
                           fdm=Builtin,
                           setup=config.min_resources)  # fmt: skip
    drone.set_camera(config.satellite)
    drone.set_app("waypoint_app.py",
                  params=params)  # fmt: skip
    drone.set_plan(config.flight_plan)
    drone.set_pos(config.home_pos)
    drone.set_logs(app, runtime, autopilot)
    controller.set_logs(runtime)
    drone.start_app()
    return controller, drone


@pytest.mark.fractus(speedup=4)
def test_planned_waypoints_violate_nothing(fractus: Scene) -> None:
    _, drone = start(fractus, config.app_params)
    drone.wait_landed(200)

    results = fractus.results()
    perf = results.get_app_resources("vDrone-1")
    results.compare(perf.mean_memory_mib, config.expected_memory_mib, tolerance=0.5)
    results.check_app_resources("vDrone-1")
    results.check_app_status("vDrone-1", SUCCESS)
    results.check_no_violations("vDrone-1")
    results.check_landed("vDrone-1", near_home=3)
    results.check_audit()


@pytest.mark.fractus(speedup=4)
def test_deviations_are_corrected_and_the_no_fly_zone_ends_the_mission(fractus: Scene) -> None:
    _, drone = start(fractus, config.deviating_params)
    drone.wait_landed(300)

    results = fractus.results()
    # On its way from the border, the monitor may stop the drone. This is a later violation, of the flight path.
    info = results.get_violations("vDrone-1", type="no_fly")
    assert info[-1].policies[0] == "city-hall"
    results.check_violations("vDrone-1", type="flight_path")
    results.check_violations("vDrone-1", type="no_fly", count=1)
    results.check_app_status("vDrone-1", ABORTED)
    results.check("outsideZone", zone="city-hall", margin=2)
    lat, lon, _ = config.WAYPOINTS["WP4"]
    results.check("reached", lat=lat, lon=lon, alt=0)
    results.check_landed("vDrone-1")


@pytest.mark.fractus(speedup=4)
def test_pictures_of_the_square_are_refused(fractus: Scene) -> None:
    _, drone = start(fractus, config.photo_params)
    drone.wait_landed(200)

    results = fractus.results()
    pictures = results.requests("vDrone-1", method="CaptureImage")
    assert {picture.action for picture in pictures} == {"allow", "deny"}
    results.check_violations("vDrone-1", type="camera")
    results.check_app_status("vDrone-1", SUCCESS)


@pytest.mark.fractus(speedup=4)
def test_zone_that_is_closed_in_flight_is_avoided(fractus: Scene) -> None:
    controller, drone = start(fractus, config.app_params)
    lat, lon, _ = config.WAYPOINTS["WP3"]
    closed = no_fly("accident", circle(lat, lon, 15))
    controller.update_restrictions(closed, at=until(drone, reached=1))
    drone.wait_landed(200)

    results = fractus.results()
    results.check_violations("vDrone-1", type="no_fly")
    results.check_landed("vDrone-1", near_home=3)
    farthest = max(sample.place.lon for sample in results.track("vDrone-1").samples)
    assert farthest < lon - 0.0001, "the drone must not enter the closed zone"
