"""Scenes: vehicles alone in lockstep, flight plans that can be planned, and clear refusals of wrong use."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from unittest import SkipTest
from unittest.mock import Mock

import fractus_testing.scene
import pytest
from fractus_core.api import Grant
from fractus_core.api.grants import GrantSpec
from fractus_sim.experiment import load
from fractus_sim.report.track import Place, Sample
from fractus_sim.testbeds.node_networks import NetworksUnavailable
from fractus_sim.testbeds.standalone_testbed import grant_manifest, planned_grants, read_all_manifests
from fractus_testing import (
    LTE,
    WIFI,
    ExperimentError,
    FlightPlan,
    Network,
    Resources,
    Results,
    Scene,
    World,
    app,
    circle,
    max_altitude,
    max_speed,
    no_fly,
    no_photo,
    stay_inside,
    until,
)
from fractus_testing.flight_plan import drone_manifests, merged

HOME = (50.8637, 4.6785, 25.0)
TASK = ({"do": "takeoff", "alt": 5}, {"do": "goto", "north": 10, "east": 0, "alt": 5}, {"do": "returnToLaunch"})
PATH = ((50.8640, 4.6785, 10.0), (50.8640, 4.6791, 10.0))


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    with Scene(tmp_path / "scene", base=tmp_path) as scene:
        yield scene


def test_vehicle_alone_flies_its_task(scene: Scene) -> None:
    drone = scene.vDrone("vDrone-1")
    drone.set_pos(HOME)
    drone.set_task(*TASK)
    drone.add_fault("gpsNoise", noise=0.3, at=1, duration=2)
    scene.set_wind(3.0, 200.0)
    drone.start_app()
    drone.wait(until(drone, altitude=4))
    assert scene.results().track("vDrone-1").landing_s is None
    drone.wait_landed(60)
    live = scene.results()
    live.check_landed("vDrone-1", near_home=3)
    live.check("reached", north=10, east=0)
    lines = scene.write_report()
    assert lines[:2] == [f"folder: {scene.folder}", f"map: {scene.folder / 'map.png'}"]
    old = Results.read(scene.folder)
    assert len(old.track("vdrone-1").samples) == len(live.track("vDrone-1").samples)
    old.check_landed("vdrone-1", near_home=3)
    assert load(scene.folder / "experiment.yaml").vehicles[0].task


def test_two_vehicles_alone_are_separate(scene: Scene) -> None:
    for number in (1, 2):
        drone = scene.vDrone(f"vDrone-{number}")
        drone.set_pos((HOME[0] + number / 1000, HOME[1], HOME[2]))
        drone.set_task(*TASK)
        drone.start_app() if number == 2 else None
    drone.wait_landed(60)
    results = scene.results()
    assert results.drones == ("vdrone-1", "vdrone-2")
    results.check("separation", min=50)


def test_drone_that_does_not_land_is_described(scene: Scene) -> None:
    drone = scene.vDrone("vDrone-1")
    drone.set_pos(HOME)
    drone.set_task({"do": "takeoff", "alt": 5}, {"do": "hold", "seconds": 100})
    drone.start_app()
    with pytest.raises(
        AssertionError, match=r"vDrone-1 has not landed within 20 s: in the air in mode GUIDED, 5\.\d m above"
    ):
        drone.wait_landed(20)
    with pytest.raises(AssertionError, match="not within 3 s: vDrone-1 reaches 50 m"):
        drone.wait(until(drone, altitude=50), timeout=3)


def test_manifests_of_a_flight_plan_can_be_planned(tmp_path: Path) -> None:
    import yaml

    plan = FlightPlan(
        path=PATH,
        restrictions=(
            no_fly("hospital", circle(50.8650, 4.6785, 20), action="abort", land_at=(50.8640, 4.6785)),
            stay_inside("town", circle(50.8640, 4.6785, 500)),
            no_photo("school", circle(50.8640, 4.6791, 20)),
            max_altitude(40),
            max_speed(8, refuse=True),
        ),
    )
    manifests = drone_manifests("vdrone-1", "App-vdrone-1", HOME, plan, resources=Resources(), camera=True)
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump_all(manifests))
    (spec,) = planned_grants(read_all_manifests([tmp_path / "plan.yaml"]))
    grant = Grant.from_body(grant_manifest(spec)).spec
    assert grant.node == "vdrone-1"
    assert {policy.name for policy in grant.policies} == {"hospital", "town", "school", "max-altitude", "max-speed"}
    assert {service.service for service in grant.services} == {"mobility", "camera"}


def test_drones_share_the_restrictions_of_their_plans(tmp_path: Path) -> None:
    import yaml

    plan = FlightPlan(path=PATH, restrictions=(no_fly("hospital", circle(50.8650, 4.6785, 20)),))
    homes = {"one": HOME, "two": (HOME[0], HOME[1] + 0.0006, HOME[2])}
    manifests = [
        manifest
        for name, home in homes.items()
        for manifest in drone_manifests(name, f"App-{name}", home, plan, resources=Resources(), camera=False)
    ]
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump_all(merged(manifests)))
    specs = planned_grants(read_all_manifests([tmp_path / "plan.yaml"]))
    assert {(spec.node, spec.component) for spec in specs} == {("one", "App-one"), ("two", "App-two")}
    other = no_fly("hospital", circle(50.8650, 4.6785, 30)).manifests()
    with pytest.raises(ExperimentError, match="two restrictions are named hospital, but their Zone differs"):
        merged([*manifests, *other])


def test_folder_with_other_files_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("important")
    with pytest.raises(ExperimentError, match="contains other files than an earlier test; specify a new folder"):
        Scene(tmp_path)
    assert (tmp_path / "thesis.txt").exists()
    (tmp_path / "experiment.yaml").touch()
    Scene(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["experiment.yaml"]


def test_wrong_use_is_refused_with_a_remedy(scene: Scene) -> None:
    with pytest.raises(ExperimentError, match="mode hitl is not supported; use sitl"):
        scene.vDrone("vDrone-1", "hitl")
    with pytest.raises(ExperimentError, match="fdm gazebo is not supported; use builtin"):
        scene.vDrone("vDrone-1", fdm="gazebo")
    scene.vController()
    with pytest.raises(ExperimentError, match="a test has one controller"):
        scene.vController()
    drone = scene.vDrone("vDrone-1")
    with pytest.raises(ExperimentError, match="names must be unique in lower case"):
        scene.vDrone("VDRONE-1")
    with pytest.raises(ExperimentError, match="unknown log radio; known: app, runtime, autopilot"):
        drone.set_logs(app, "radio")
    with pytest.raises(ExperimentError, match="nothing runs yet; call start_app"):
        scene.results()
    with pytest.raises(ExperimentError, match=r"has no program; call set_app\(\) or set_task\(\) first"):
        drone.start_app()
    drone.set_app("pilot.py")
    with pytest.raises(ExperimentError, match=r"has no start position; call set_pos\(\)"):
        drone.start_app()
    drone.set_pos(HOME)
    with pytest.raises(ExperimentError, match=r"needs a flight plan: call either set_plan\(\) or set_manifests\(\)"):
        drone.start_app()
    drone.set_camera(World(seed=1))
    other = scene.vDrone("vDrone-2")
    other.set_pos(HOME)
    other.set_camera(World(seed=2))
    with pytest.raises(ExperimentError, match="pass the same World"):
        drone.start_app()
    other.set_task(*TASK)
    with pytest.raises(ExperimentError, match="flies vehicles alone, so all drones need it; missing: vDrone-1"):
        drone.start_app()


def test_running_autopilot_needs_a_program(scene: Scene) -> None:
    drone = scene.vDrone("vDrone-1", connection="tcp:127.0.0.1:1")
    drone.set_pos(HOME)
    drone.set_task(*TASK)
    with pytest.raises(ExperimentError, match=r"needs a program; use set_app\(\) instead of set_task\(\)"):
        drone.start_app()


@pytest.mark.parametrize(
    "connection", ["udp:127.0.0.1:14550", "127.0.0.1:5760", "tcp:127.0.0.1", "tcp:127.0.0.1:70000"]
)
def test_connection_other_than_tcp_is_refused_with_a_remedy(scene: Scene, connection: str) -> None:
    drone = scene.vDrone("vDrone-1", connection=connection)
    drone.set_pos(HOME)
    drone.set_plan(FlightPlan(path=PATH))
    drone.set_app("pilot.py")
    with pytest.raises(
        ExperimentError,
        match=rf"vehicles\[0\]\.connection: must be tcp:HOST:PORT, not '{connection}'; .*MAVProxy or mavlink-router",
    ):
        drone.start_app()


def test_invalid_fault_and_name_are_refused_with_their_field(scene: Scene) -> None:
    drone = scene.vDrone("v drone")
    drone.set_pos(HOME)
    drone.set_task(*TASK)
    with pytest.raises(ExperimentError, match=r"vehicles\[0\]\.name"):
        drone.start_app()
    drone.node = "vdrone"
    drone.add_fault("gpsLos", at=1)
    with pytest.raises(ExperimentError, match="did you mean gpsLoss"):
        drone.start_app()


def test_configuration_cannot_change_after_the_start(scene: Scene) -> None:
    drone = scene.vDrone("vDrone-1")
    drone.set_pos(HOME)
    drone.set_task(*TASK)
    drone.start_app()
    with pytest.raises(ExperimentError, match=r"set_pos\(\) must be called before the first start_app\(\)"):
        drone.set_pos(HOME)


@pytest.mark.parametrize(
    ("speedup", "highest", "expected"), [(None, None, 4), (None, 1, 1), (8, 2, 2), (1, 2, 1), (8, None, 8)]
)
def test_speedup_of_services_is_limited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, speedup: float | None, highest: float | None, expected: float
) -> None:
    monkeypatch.setattr(fractus_testing.scene, "ExperimentRun", lambda *_arguments, **_options: Mock())
    scene = Scene(tmp_path / "scene", speedup=speedup, max_speedup=highest)
    drone = scene.vDrone("vDrone-1")
    drone.set_pos(HOME)
    drone.set_plan(FlightPlan(path=PATH))
    drone.set_app("pilot.py")
    scene.start()
    assert load(scene.folder / "experiment.yaml").speedup == expected


@pytest.mark.parametrize(("speedup", "expected"), [(None, 0), (8, 2)])
def test_vehicles_alone_stay_in_lockstep_if_the_speedup_is_limited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, speedup: float | None, expected: float
) -> None:
    monkeypatch.setattr(fractus_testing.scene, "ExperimentRun", lambda *_arguments, **_options: Mock())
    scene = Scene(tmp_path / "scene", speedup=speedup, max_speedup=2)
    drone = scene.vDrone("vDrone-1")
    drone.set_pos(HOME)
    drone.set_task(*TASK)
    scene.start()
    assert load(scene.folder / "experiment.yaml").speedup == expected


def test_networks_are_written_to_the_experiment(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fractus_testing.scene, "require_networks", lambda: None)
    controller = scene.vController()
    drone = scene.vDrone("vDrone-1")
    drone.set_pos(HOME)
    drone.set_plan(FlightPlan(path=PATH))
    drone.set_app("pilot.py")
    edge = scene.vNode("Edge-1", HOME)
    edge.set_app("collector.py", component="Collector", port=7000)
    scene.NetSim(Network(range=50, loss=0.1)).add_participants(controller, drone, edge)
    scene.NetSim(LTE).add_participants(controller)
    with pytest.raises(ExperimentError, match="the name edge-1 is used twice"):
        scene.vNode("edge-1")
    monkeypatch.setattr(fractus_testing.scene, "ExperimentRun", lambda *_arguments, **_options: Mock())
    scene.start()
    experiment = load(scene.folder / "experiment.yaml")
    (network,) = experiment.networks
    assert (network.participants, network.range, network.loss) == (("vdrone-1", "edge-1"), 50, 0.1)
    assert [(program.node, program.port) for program in experiment.programs] == [(None, None), ("edge-1", 7000)]
    assert controller.place is None


def test_test_is_skipped_if_networks_cannot_be_simulated(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise NetworksUnavailable("simulated networks need root; run the test as root")

    monkeypatch.setattr(fractus_testing.scene, "require_networks", refuse)
    with pytest.raises(SkipTest, match="run the test as root"):
        scene.NetSim(WIFI)


def test_data_sent_without_a_network_is_refused_with_a_remedy(scene: Scene) -> None:
    drone = scene.vDrone("vDrone-1")
    drone.set_pos(HOME)
    drone.set_task(*TASK)
    drone.start_app()
    with pytest.raises(ExperimentError, match=r"was not measured; add the drone to a NetSim before start_app\(\)"):
        scene.results().get_data_sent("vDrone-1")


class PlannedFlight:
    """A drone with a flight plan at its start position, and a run that only records the issued Grants."""

    def __init__(self, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
        self.run = Mock(now_s=0.0, flights={"vdrone-1": Mock(samples=[])})
        monkeypatch.setattr(fractus_testing.scene, "ExperimentRun", lambda *_arguments, **_options: self.run)
        self.controller = scene.vController()
        self.drone = scene.vDrone("vDrone-1")
        self.drone.set_pos(HOME)
        self.drone.set_plan(FlightPlan(path=PATH))
        self.drone.set_app("pilot.py")
        scene.start()

    def fly_to(self, waypoint: tuple[float, float, float]) -> None:
        self.run.flights["vdrone-1"].samples.append(Sample(0.0, Place(*waypoint), 1.0, "GUIDED", True, 1.0))

    def issued(self) -> GrantSpec:
        """Return the Grant of the current plan of the drone, as the controller issues it."""
        self.controller.update_restrictions()
        ((grant,),) = self.run.testbed.reissue.call_args.args
        return grant


@pytest.fixture
def planned(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> PlannedFlight:
    return PlannedFlight(scene, monkeypatch)


HOSPITALS = tuple(no_fly("hospital", circle(50.8650, 4.6785, radius)) for radius in (20, 30))


def test_smaller_flight_plan_replaces_the_first(planned: PlannedFlight) -> None:
    before = planned.issued()
    planned.controller.set_plan(planned.drone, FlightPlan(path=PATH[:1]))
    assert planned.issued().control_points != before.control_points
    planned.controller.set_plan(planned.drone, FlightPlan(path=PATH))
    assert planned.issued() == before, "the area of the first plan is permitted again"


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (FlightPlan(path=PATH[:1], restrictions=HOSPITALS), "two restrictions are named hospital"),
        (FlightPlan(path=[(51.9, 4.6785, 10.0)]), "cannot be planned"),
        (FlightPlan(path=[(50.8642, 4.6785, 10.0)]), "m2 outside of the first plan"),
        (FlightPlan(region=circle(50.8640, 4.6785, 60)), "m2 outside of the first plan"),
    ],
)
def test_refused_flight_plan_leaves_the_old_one(planned: PlannedFlight, plan: FlightPlan, message: str) -> None:
    before = planned.issued()
    with pytest.raises(ExperimentError, match=message):
        planned.controller.set_plan(planned.drone, plan)
    assert planned.drone.waypoints == PATH
    assert planned.issued() == before


def test_flight_plan_whose_grants_cannot_be_issued_leaves_the_old_one(planned: PlannedFlight) -> None:
    before = planned.issued()
    planned.run.testbed.reissue.side_effect = ExperimentError("the disk is full")
    with pytest.raises(ExperimentError, match="the disk is full"):
        planned.controller.set_plan(planned.drone, FlightPlan(path=PATH[:1]))
    planned.run.testbed.reissue.side_effect = None
    assert planned.drone.waypoints == PATH
    assert planned.issued() == before


def test_flight_plan_that_contradicts_a_restriction_is_refused_without_contact(planned: PlannedFlight) -> None:
    planned.controller.update_restrictions(HOSPITALS[0])
    planned.controller.lose_contact(planned.drone, 10.0)
    with pytest.raises(ExperimentError, match="hospital"):
        planned.controller.set_plan(planned.drone, FlightPlan(path=PATH[:1], restrictions=HOSPITALS[1:]))
    assert planned.drone.waypoints == PATH


def test_refused_restrictions_leave_the_old_ones(planned: PlannedFlight) -> None:
    with pytest.raises(ExperimentError, match="two restrictions are named hospital"):
        planned.controller.update_restrictions(*HOSPITALS)
    planned.controller.set_plan(planned.drone, FlightPlan(path=PATH[:1]))


def test_waypoints_of_a_new_flight_plan_are_counted_from_its_replacement(planned: PlannedFlight) -> None:
    planned.fly_to(PATH[0])
    assert until(planned.drone, reached=1).fired()
    planned.controller.set_plan(planned.drone, FlightPlan(path=PATH[:1]))
    reached = until(planned.drone, reached=1)
    assert not reached.fired()
    planned.fly_to(PATH[0])
    assert reached.fired()
