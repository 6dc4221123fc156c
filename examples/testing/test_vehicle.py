"""A test of a vehicle without services and programs. It takes less than a second."""

from __future__ import annotations

from fractus_testing import Scene


def test_vehicle_returns_after_a_loss_of_gps_quality(fractus: Scene) -> None:
    drone = fractus.vDrone("vDrone-1")
    drone.set_pos((39.3600, 22.9450, 3.0))
    drone.set_task(
        {"do": "takeoff", "alt": 10},
        {"do": "goto", "north": 40, "east": 0, "alt": 10},
        {"do": "returnToLaunch"},
    )
    drone.add_fault("gpsNoise", noise=0.5, at=5, duration=5)
    drone.start_app()
    drone.wait_landed(120)

    results = fractus.results()
    results.check("reached", north=40, east=0)
    results.check_landed("vDrone-1", near_home=5)
