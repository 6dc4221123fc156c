"""Tests of vehicles without services and programs. Each of them takes about a second."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
from fractus_testing import Results, Scene, VirtualDrone, until

HOME = (39.3600, 22.9450, 3.0)
TAKEOFF = {"do": "takeoff", "alt": 10}
OUT = {"do": "goto", "north": 40, "east": 0, "alt": 10}
BACK = {"do": "returnToLaunch"}


def drone_with(
    fractus: Scene, *steps: Mapping[str, object], name: str = "vDrone-1", east_m: float = 0.0
) -> VirtualDrone:
    """Return a drone that flies steps, this far east of the common start position."""
    drone = fractus.vDrone(name)
    drone.set_pos((HOME[0], HOME[1] + east_m / 86_000, HOME[2]))
    drone.set_task(*steps)
    return drone


def flown(fractus: Scene, drone: VirtualDrone) -> Results:
    """Fly the steps of a drone, and return the results."""
    drone.start_app()
    drone.wait_landed(200)
    return fractus.results()


def test_vehicle_returns_after_a_loss_of_gps_quality(fractus: Scene) -> None:
    drone = drone_with(fractus, TAKEOFF, OUT, BACK)
    drone.add_fault("gpsNoise", noise=0.5, at=5, duration=5)
    results = flown(fractus, drone)
    results.check("reached", north=40, east=0)
    results.check_landed("vDrone-1", near_home=5)


@pytest.mark.fractus(seed=1, seeds=3)
def test_turbulence_does_not_move_the_landing_place(fractus: Scene) -> None:
    drone = drone_with(fractus, TAKEOFF, OUT, BACK)
    fractus.set_wind(6.0, direction=300.0, turbulence=1.5)
    flown(fractus, drone).check_landed("vDrone-1", near_home=3)


def test_gust_is_compensated(fractus: Scene) -> None:
    drone = drone_with(fractus, TAKEOFF, {"do": "hold", "seconds": 20}, BACK)
    drone.add_fault("windGust", speed=9, direction=270, at=8, duration=8)
    results = flown(fractus, drone)
    farthest = max(abs(sample.place.lon - HOME[1]) for sample in results.track("vDrone-1").samples)
    assert farthest * 86_000 < 5.0, "the drone must keep its position"


def test_battery_failsafe_brings_the_drone_home(fractus: Scene) -> None:
    drone = drone_with(fractus, TAKEOFF, {**OUT, "north": 150}, {"do": "hold", "seconds": 100})
    drone.set_parameters(BATT_FS_LOW_ACT=2, BATT_LOW_VOLT=10.5)
    drone.add_fault("batteryDrop", voltage=10.4, at=15)
    results = flown(fractus, drone)
    results.check("statustext", matches="Battery 1 is low")
    results.check("mode", mode="RTL")
    results.check_landed("vDrone-1", near_home=3)


def test_ground_station_failsafe_brings_the_drone_home(fractus: Scene) -> None:
    drone = drone_with(fractus, TAKEOFF, {**OUT, "north": 150}, {"do": "hold", "seconds": 100})
    drone.set_parameters(FS_GCS_ENABLE=1)
    drone.add_fault("linkLoss", at=12)
    results = flown(fractus, drone)
    results.check("statustext", matches="GCS Failsafe")
    results.check_landed("vDrone-1", near_home=3)


def test_speed_parameter_limits_the_legs(fractus: Scene) -> None:
    drone = drone_with(fractus, TAKEOFF, OUT, BACK)
    drone.set_parameters(WPNAV_SPEED=300)
    flown(fractus, drone).check("speed", max=3.5)


def test_altitude_stays_in_its_band(fractus: Scene) -> None:
    drone = drone_with(fractus, TAKEOFF, OUT, {**OUT, "east": 20}, {"do": "land"})
    flown(fractus, drone).check("altitude", min=9, max=11)


def test_mission_waypoints_are_reached(fractus: Scene) -> None:
    waypoints = [{"north": 30, "east": 0, "alt": 12}, {"north": 30, "east": 30, "alt": 15}]
    drone = drone_with(fractus, {"do": "mission", "takeoff": 10, "waypoints": waypoints})
    results = flown(fractus, drone)
    for waypoint in waypoints:
        results.check("reached", "vDrone-1", **waypoint)


def test_drone_that_lands_elsewhere_fails_the_check(fractus: Scene) -> None:
    drone = drone_with(fractus, TAKEOFF, OUT, {"do": "land"})
    results = flown(fractus, drone)
    results.check_landed("vDrone-1")
    with pytest.raises(AssertionError, match="from the takeoff position"):
        results.check_landed("vDrone-1", near_home=10)


def test_two_drones_keep_their_separation(fractus: Scene) -> None:
    drones = [
        drone_with(fractus, TAKEOFF, OUT, BACK, name=f"vDrone-{number}", east_m=15.0 * number) for number in (1, 2)
    ]
    for drone in drones:
        drone.start_app()
    for drone in drones:
        drone.wait_landed(200)
    fractus.results().check("separation", min=10)


def test_flight_is_observed_while_it_continues(fractus: Scene) -> None:
    drone = drone_with(fractus, TAKEOFF, OUT, BACK)
    drone.start_app()
    drone.wait(until(drone, altitude=9))
    assert fractus.results().track("vDrone-1").landing_s is None
    drone.wait_landed(200)
    assert fractus.results().track("vDrone-1").landing_s is not None


def test_results_of_an_earlier_test_are_read_from_its_folder(fractus: Scene) -> None:
    drone = drone_with(fractus, TAKEOFF, OUT, BACK)
    flown(fractus, drone)
    lines = fractus.write_report()
    assert any("map.png" in line for line in lines)
    earlier = Results.read(fractus.folder)
    earlier.check_landed("vDrone-1", near_home=3)
    # A return to launch climbs to 15 m.
    earlier.compare(earlier.track("vDrone-1").max_altitude_m, 15.0, tolerance=0.1)
