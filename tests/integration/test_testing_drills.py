"""Drills: bad applications that the platform must stop, and commands of the controller in flight."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from fractus_cluster.ports import free_port
from fractus_testing import (
    ABORTED,
    SUCCESS,
    App,
    ExperimentError,
    FlightPlan,
    Results,
    Scene,
    VirtualController,
    VirtualDrone,
    World,
    circle,
    malice,
    max_altitude,
    no_fly,
    until,
)
from vehicle_process import running_vehicle

pytestmark = [pytest.mark.slow, pytest.mark.fractus(speedup=2)]

HOME = (50.8637, 4.6785, 25.0)
PATH = ((50.8640, 4.6785, 10.0), (50.8640, 4.6791, 10.0), (50.8637, 4.6791, 10.0))
SAFETY_RADIUS_M = 7.0
"""Half the width of the corridor along the path."""

KEPT_M = 1.0
"""Distance that a drone keeps from the border of the corridor at least: the margin, less a deviation of the vehicle."""

EXAMPLES = Path(__file__).parents[2] / "examples" / "testing"
PILOT = """
import fractus

async def fly(drone, control):
    await drone.arm()
    await drone.takeoff(10)
    async for waypoint in control.remaining():
        try:
            await drone.goto(waypoint.lat, waypoint.lon, waypoint.alt)
        except fractus.PolicyDenied as refusal:
            print(refusal)

fractus.run(fly)
"""


def start(
    scene: Scene, app: App | str, *, camera: bool = False, connection: str | None = None
) -> tuple[VirtualController, VirtualDrone]:
    controller = scene.vController()
    drone = scene.vDrone("vDrone-1", connection=connection)
    drone.set_pos(HOME)
    drone.set_plan(FlightPlan(path=PATH, restrictions=[max_altitude(20)]))
    drone.set_app(app)
    if camera:
        drone.set_camera(World(seed=3))
    drone.start_app()
    return controller, drone


def pilot(folder: Path) -> str:
    (folder / "pilot.py").write_text(PILOT)
    return str(folder / "pilot.py")


@pytest.mark.parametrize(
    ("attack", "violation"),
    [
        (malice.leaves_corridor(), "flight_path"),
        (malice.presses_border(), "flight_path"),
        (malice.wrong_frames(), "altitude"),
        (malice.floods(), None),
        (malice.forges_identity(), None),
        (malice.forces_arming(), None),
        (malice.leaves_corridor(60.0, interface="mavlink"), "flight_path"),
        (malice.presses_border(10.0, interface="mavlink"), "flight_path"),
        (malice.wrong_frames(interface="mavlink"), "altitude"),
        (malice.floods(interface="mavlink"), None),
        (malice.forges_identity(interface="mavlink"), None),
        (malice.forces_arming(interface="mavlink"), None),
    ],
    ids=lambda value: f"{value.command[-1]}-{value.interface}" if isinstance(value, App) else "",
)
def test_attack_is_prevented_and_the_drone_returns(fractus: Scene, attack: App, violation: str | None) -> None:
    _, drone = start(fractus, attack)
    drone.wait_landed(240)
    results = fractus.results()
    results.check_app_status("vDrone-1", SUCCESS)
    results.check_landed("vDrone-1", near_home=3)
    results.check_audit()
    if violation is not None:
        results.check_violations("vDrone-1", type=violation)  # type: ignore[arg-type]
    if attack.command[-1] == "leaves-corridor":
        callers = {v.caller for v in results.get_violations("vDrone-1")}
        assert callers == {"App-vdrone-1"}, "the engine must refuse the calls before the monitor has to stop the drone"
    border = PATH[0][0] + SAFETY_RADIUS_M / 111_320
    assert max(sample.place.lat for sample in results.track("vDrone-1").samples) < border - KEPT_M / 111_320


def test_pictures_of_others_cannot_be_read_or_deleted(fractus: Scene) -> None:
    _, drone = start(fractus, malice.reads_foreign_pictures(), camera=True)
    drone.wait_landed(240)
    fractus.results().check_app_status("vDrone-1", SUCCESS)


@pytest.mark.parametrize(
    "attack",
    [malice.stalls(), malice.crashes(), malice.stalls(interface="mavlink"), malice.crashes(interface="mavlink")],
    ids=lambda app: f"{app.command[-1]}-{app.interface}",
)
def test_drone_returns_if_its_program_stalls_or_crashes(fractus: Scene, attack: App) -> None:
    _, drone = start(fractus, attack)
    drone.wait_landed(240)
    results = fractus.results()
    results.check_landed("vDrone-1", near_home=3)
    assert results.get_app_status("vDrone-1") != SUCCESS


def test_running_autopilot_is_flown_by_the_services(fractus: Scene, tmp_path: Path) -> None:
    link = f"tcp:127.0.0.1:{free_port()}"
    with running_vehicle("--speedup", "2", "--home", "50.8637,4.6785,25", links=(link,)):
        _, drone = start(fractus, pilot(tmp_path), connection=link)
        drone.wait_landed(240)
        results = fractus.results()
        results.check_app_status("vDrone-1", SUCCESS)
        results.check_landed("vDrone-1", near_home=3)
        fractus.close()


def test_emergency_landing_lands_the_drone_where_it_is(fractus: Scene, tmp_path: Path) -> None:
    controller, drone = start(fractus, pilot(tmp_path))
    controller.emergency_landing(drone, at=until(drone, reached=1))
    drone.wait_landed(120)
    results = fractus.results()
    results.check_app_status("vDrone-1", ABORTED)
    with pytest.raises(AssertionError, match="m from the takeoff position"):
        results.check_landed("vDrone-1", near_home=10)


def test_smaller_flight_plan_applies_in_flight(fractus: Scene, tmp_path: Path) -> None:
    controller, drone = start(fractus, pilot(tmp_path))
    drone.wait(until(drone, reached=1))
    with pytest.raises(ExperimentError, match="cannot be planned"):
        controller.set_plan(drone, FlightPlan(path=[(51.9, 4.6785, 10.0)]))
    controller.set_plan(drone, FlightPlan(path=PATH[:1]))
    drone.wait_landed(240)
    results = fractus.results()
    results.check_violations("vDrone-1", type="flight_path")
    results.check_landed("vDrone-1", near_home=3)
    assert max(sample.place.lon for sample in results.track("vDrone-1").samples) < PATH[1][1] - 0.0001


def test_aborted_mission_ends_at_home(fractus: Scene, tmp_path: Path) -> None:
    controller, drone = start(fractus, pilot(tmp_path))
    controller.abort(drone, at=until(drone, altitude=8))
    drone.wait_landed(200)
    results = fractus.results()
    results.check_landed("vDrone-1", near_home=3)
    results.check_app_status("vDrone-1", ABORTED)


def test_restriction_reaches_a_drone_only_after_its_contact_returns(fractus: Scene, tmp_path: Path) -> None:
    controller, drone = start(fractus, pilot(tmp_path))
    controller.lose_contact(drone, 1000, at=until(drone, altitude=8))
    lat, lon, _ = PATH[2]
    controller.update_restrictions(no_fly("closed", circle(lat, lon, 8)))
    drone.wait_landed(200)
    results = fractus.results()
    results.check_no_violations("vDrone-1")
    results.check_app_status("vDrone-1", SUCCESS)


def test_results_of_a_folder_equal_those_of_the_run(fractus: Scene, tmp_path: Path) -> None:
    _, drone = start(fractus, malice.leaves_corridor(60.0))
    drone.wait_landed(240)
    live = fractus.results()
    usage = live.get_app_resources("vDrone-1")
    assert 0 < usage.cpu < 2
    assert 20 < usage.mean_memory_mib <= usage.peak_memory_mib < 300
    violations = live.get_violations("vDrone-1")
    fractus.write_report()
    old = Results.read(fractus.folder)
    assert [(v.code, v.reason) for v in old.get_violations("vdrone-1")] == [(v.code, v.reason) for v in violations]
    assert old.get_violations("vdrone-1")[0].time_s == pytest.approx(violations[0].time_s, abs=2.0)
    assert old.get_app_status("vdrone-1") == SUCCESS
    assert old.get_app_resources("vdrone-1").cpu_s == pytest.approx(usage.cpu_s, rel=0.2)
    old.check_landed("vdrone-1", near_home=3)
    old.check_audit()


def test_examples_pass(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "--fractus-out",
        str(tmp_path),
        str(EXAMPLES),
    ]
    result = subprocess.run(command, cwd=EXAMPLES, env=dict(os.environ), capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


def test_first_test_of_the_page_passes(tmp_path: Path) -> None:
    page = (EXAMPLES.parents[1] / "docs" / "testing.md").read_text()
    program, test = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)[:2]
    (tmp_path / "pilot.py").write_text(program)
    (tmp_path / "test_pilot.py").write_text(test)
    result = subprocess.run(
        [sys.executable, "-m", "pytest", "-q"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr


def test_program_that_does_not_exist_is_reported(fractus: Scene) -> None:
    with pytest.raises((ExperimentError, AssertionError), match=r"no_such_program\.py"):
        _, drone = start(fractus, "no_such_program.py")
        drone.wait_landed(5)
