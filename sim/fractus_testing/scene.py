"""Scene of one test: virtual drones, a virtual controller, and the experiment that runs them.

    with Scene(Path("out/square")) as scene:
        drone = scene.vDrone("vDrone-1")
        drone.set_pos((50.8637, 4.6785, 25))
        drone.set_plan(FlightPlan(path=[(50.8640, 4.6785, 10)]))
        drone.set_app("square.py")
        drone.start_app()
        drone.wait_landed(120)
        scene.results().check_landed("vDrone-1", near_home=3)

With pytest, the fixture `fractus` is the scene. A scene builds the same `Experiment` as an experiment file, and writes
it to `experiment.yaml` of its folder, so `fractus experiment run` repeats the flight of a test without its actions.
"""

from __future__ import annotations

import itertools
import math
import re
import shutil
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self
from unittest import SkipTest

import yaml
from fractus_cli.manifests import Manifests
from fractus_core.api import Application
from fractus_core.api.geometry import Point
from fractus_core.api.grants import GrantSpec
from fractus_core.api.methods import Interface
from fractus_core.api.model import InvalidObject
from fractus_core.geo import LocalFrame, area_polygon, geodesic_m
from fractus_sim.errors import ExperimentError
from fractus_sim.experiment import parse
from fractus_sim.experiment.definition import NamedZone, Program
from fractus_sim.progress import Progress
from fractus_sim.report.flight_record import policy_decisions
from fractus_sim.report.track import Sample
from fractus_sim.runner import ExperimentRun, Outcome
from fractus_sim.runner.telemetry_recording import Flight
from fractus_sim.testbeds.node_networks import NetworksUnavailable, require_networks
from fractus_sim.testbeds.standalone_testbed import planned_grants, read_all_manifests
from shapely import Polygon, union_all
from shapely.geometry.base import BaseGeometry

from fractus_testing.applications import App, app_of
from fractus_testing.flight_plan import (
    MIN_RESOURCES,
    FlightPlan,
    Manifest,
    Resources,
    Restriction,
    Waypoint,
    circle,
    drone_manifests,
    merged,
    no_fly,
)
from fractus_testing.network import Network
from fractus_testing.records import record_of_run
from fractus_testing.results import Results
from fractus_testing.triggers import Trigger
from fractus_testing.world import World

SITL = "sitl"
Ardupilot = "ardupilot"
Builtin = "builtin"
app = "app"
runtime = "runtime"
autopilot = "autopilot"
_LOGS = (app, runtime, autopilot)

DEFINITION = "experiment.yaml"
DEFAULT_SPEEDUP = 4.0
AS_FAST_AS_POSSIBLE = 0.0
TRIGGER_TIMEOUT_S = 300.0
MAX_DURATION_S = 7200.0
SETTLE_S = 600.0
"""Seconds without an event after which an experiment ends. The test ends its experiment earlier."""

STEP_S = 0.25
PROGRAM_END_S = 5.0
"""Real time for which a program may continue to run after the landing of its drone, seconds."""

AREA_TOLERANCE_M = 0.5
"""Distance by which rounding may move the border of an area that two plans share."""

RECORDING_S = 0.5
"""Time for which a landed vehicle is recorded, seconds of the vehicle."""

EMERGENCY_RADIUS_M = 5000.0
_LOG_LINES = 15
_MAX_VERDICTS = 10


class VirtualDrone:
    """A virtual drone: simulated vehicle, services of Fractus and programs under test, as local processes.

    Attributes:
        name: Name in the test.
        node: Name of the node: the name in lower case.
        plan_begin: Number of positions before the current flight plan applied.
    """

    def __init__(self, scene: Scene, name: str, setup: Resources, connection: str | None) -> None:
        self.name = name
        self.node = name.lower()
        self.resources = setup
        self.connection = connection
        self.home: tuple[float, float, float] | None = None
        self.plan: FlightPlan | None = None
        self.plan_begin = 0
        self.manifests: tuple[Path, ...] = ()
        self.apps: list[App] = []
        self.task: list[dict[str, Any]] = []
        self.faults: list[dict[str, Any]] = []
        self.parameters: dict[str, float] = {}
        self.world: World | None = None
        self.logs: tuple[str, ...] = (app,)
        self._scene = scene

    def set_pos(self, home: tuple[float, float, float]) -> None:
        """Set the start and home position: latitude, longitude, ground height in metres above mean sea level."""
        self._scene.require_not_started("set_pos")
        self.home = home

    def set_plan(self, plan: FlightPlan) -> None:
        """Set the approved flight plan and its restrictions."""
        self._scene.require_not_started("set_plan")
        self.plan = plan

    def set_manifests(self, *paths: str | Path) -> None:
        """Use manifests instead of a flight plan: files or folders with the Application, Drone, Depot and policies.

        Args:
            paths: Paths, relative to the file of the test. A Drone must have the name of this drone in lower case.
        """
        self._scene.require_not_started("set_manifests")
        self.manifests = tuple(self._scene.base / path for path in paths)

    def set_app(
        self,
        program: App | str,
        params: Mapping[str, object] | None = None,
        component: str | None = None,
        port: int | None = None,
        interface: Interface | None = None,
    ) -> None:
        """Set a program under test. It runs as a component of the application, with the environment of its pod.

        Args:
            program: Path of a Python program, relative to the file of the test, or an App.
            params: Environment variables of the program. Values other than text are passed as JSON.
            component: Component that the program implements. Only needed with `set_manifests`.
            port: Port at which the program listens. Programs of other nodes get the address by the component.
            interface: `mavlink` for a program that speaks MAVLink: the variable FRACTUS_VEHICLE contains the connection.
                None: the interface of the App, by default `grpc` for the SDK. Only used with `set_plan`.
        """
        self._scene.require_not_started("set_app")
        self.apps.append(app_of(program, params or {}, component, port, interface))

    def set_task(self, *steps: Mapping[str, object]) -> None:
        """Let a ground station fly the vehicle alone, without services and programs.

        Args:
            steps: Task steps as in experiment files, such as `{"do": "takeoff", "alt": 10}`.
        """
        self._scene.require_not_started("set_task")
        self.task = [dict(step) for step in steps]

    def set_camera(self, world: World) -> None:
        """Add a camera, and the world that it sees."""
        self._scene.require_not_started("set_camera")
        self.world = world

    def set_parameters(self, **parameters: float) -> None:
        """Set parameters of the autopilot, such as `WPNAV_SPEED=500`."""
        self._scene.require_not_started("set_parameters")
        self.parameters |= parameters

    def set_logs(self, *logs: str) -> None:
        """Select the logs whose last lines a failed test shows: app (the default), runtime, autopilot. All are always written.

        Raises:
            ExperimentError: A log is unknown.
        """
        unknown = [log for log in logs if log not in _LOGS]
        if unknown:
            raise ExperimentError(f"set_logs: unknown log {unknown[0]}; known: {', '.join(_LOGS)}")
        self.logs = logs

    def add_fault(self, fault: str, **fields: Any) -> None:
        """Inject a fault in time, as in experiment files: `add_fault("gpsLoss", at=10, duration=5)`.

        Args:
            fault: Kind of fault.
            fields: Fields of the fault. `at` is in seconds after the takeoff.
        """
        self._scene.require_not_started("add_fault")
        self.faults.append({"fault": fault, "vehicles": [self.node], **fields})

    def start_app(self) -> None:
        """Start the programs of this drone. The first call starts all drones and waits until they are ready.

        Raises:
            ExperimentError: A drone has no program, or a part did not start.
        """
        if not self.apps and not self.task:
            raise ExperimentError(f"{self.name} has no program; call set_app() or set_task() first")
        self._scene.start()
        for program in self._scene.programs(self):
            self._scene.run.begin(program)

    def wait_landed(self, timeout: float) -> None:
        """Wait until the drone has flown, and is landed and disarmed. Its programs get a few seconds to end.

        Args:
            timeout: Seconds of the vehicle.

        Raises:
            AssertionError: The drone has not landed in time.
            ExperimentError: A service or vehicle ended.
        """
        __tracebackhide__ = True
        flight = self._scene.flight(self)

        def landed() -> bool:
            return flight.track.landing_s is not None and not flight.armed_at_end

        def cannot_fly() -> bool:
            return flight.track.takeoff_s is None and self._scene.programs_ended(self)

        if not self._scene.advance_until(lambda: landed() or cannot_fly(), timeout) or not landed():
            raise AssertionError(f"{self.name} has not landed within {timeout:g} s: {self._scene.describe(self)}")
        # The recording contains the state of the motors with the next position.
        self._scene.advance(RECORDING_S)
        self._scene.wait_programs_end(self)

    def wait(self, trigger: Trigger, timeout: float = TRIGGER_TIMEOUT_S) -> None:
        """Wait for a moment of the flight.

        Args:
            trigger: Moment, from `until`.
            timeout: Seconds of the vehicle.

        Raises:
            AssertionError: The moment did not come in time.
        """
        __tracebackhide__ = True
        self._scene.wait(trigger, timeout)

    @property
    def samples(self) -> Sequence[Sample]:
        """Positions so far, in order."""
        return self._scene.flight(self).samples

    @property
    def plan_samples(self) -> Sequence[Sample]:
        """Positions since the current flight plan applies, in order."""
        return self.samples[self.plan_begin :]

    @property
    def waypoints(self) -> Sequence[Waypoint]:
        """Waypoints of the flight plan, or of the driver in the manifests."""
        if self.plan is not None:
            return tuple(self.plan.path)
        return self._scene.manifest_waypoints()

    @property
    def now_s(self) -> float:
        """Seconds since all vehicles were ready."""
        return self._scene.run.now_s


class VirtualNode:
    """An edge node or the cloud, with programs that other programs can call. It has no services of Fractus.

    Attributes:
        name: Name in the test.
        node: Name of the node: the name in lower case.
        place: Latitude and longitude in degrees, metres above mean sea level. None: ranges do not apply, as for the cloud.
    """

    def __init__(self, scene: Scene, name: str, place: tuple[float, float, float] | None) -> None:
        self.name = name
        self.node = name.lower()
        self.place = place
        self.apps: list[App] = []
        self._scene = scene

    def set_app(
        self,
        program: App | str,
        component: str,
        params: Mapping[str, object] | None = None,
        port: int | None = None,
    ) -> None:
        """Add a program.

        Args:
            program: Path of a Python program, relative to the file of the test, or an App.
            component: Name under which programs of other nodes find the program: the variable `FRACTUS_SERVICE_COMPONENT`.
            params: Environment variables of the program. Values other than text are passed as JSON.
            port: Port at which the program listens, also in the variable PORT.
        """
        self._scene.require_not_started("set_app")
        self.apps.append(app_of(program, params or {}, component, port))

    def start_app(self) -> None:
        """Start the programs of this node. The first call of any `start_app` starts all drones.

        Raises:
            ExperimentError: A program or a drone did not start.
        """
        self._scene.start()
        for program in self._scene.programs(self):
            self._scene.run.begin(program)


class NetSim:
    """A simulated network between participants."""

    def __init__(self, scene: Scene, network: Network) -> None:
        self.network = network
        self.participants: list[VirtualDrone | VirtualNode | VirtualController] = []
        self._scene = scene

    def add_participants(self, *participants: VirtualDrone | VirtualNode | VirtualController) -> None:
        """Add drones, nodes or the controller.

        Programs of drones and nodes reach only each other over networks, and the services of their drone. The
        controller reaches a drone only within the range.
        """
        self._scene.require_not_started("add_participants")
        self.participants += participants


class VirtualController:
    """A virtual controller: it plans the flights, signs Grants, and changes restrictions during flights."""

    def __init__(self, scene: Scene) -> None:
        self.place: tuple[float, float, float] | None = None
        self._scene = scene
        self._restrictions: tuple[Restriction, ...] = ()
        self._silent_until_s: dict[str, float] = {}
        self._pending: set[str] = set()
        self._aborted: set[str] = set()

    def set_logs(self, *logs: str) -> None:
        """Select logs for failed tests. The controller has the log `runtime` only: the events of the test."""
        if set(logs) - {runtime}:
            raise ExperimentError("set_logs: the controller has only the log runtime")

    def set_pos(self, place: tuple[float, float, float]) -> None:
        """Set the position: latitude, longitude, metres above mean sea level. Without it, ranges of networks do not apply."""
        self.place = place

    def update_restrictions(self, *restrictions: Restriction, at: Trigger | None = None) -> None:
        """Replace the restrictions that this controller has issued. Restrictions of flight plans stay.

        The new Grants take effect within one second. A drone without contact gets them when the contact returns.

        Args:
            restrictions: Restrictions that apply from now on. None: lift all.
            at: Moment of a flight to wait for.

        Raises:
            AssertionError: The moment did not come.
            ExperimentError: A restriction is invalid. The old ones then stay.
        """
        __tracebackhide__ = True
        if at is not None:
            self._scene.wait(at, TRIGGER_TIMEOUT_S)
        before = self._restrictions
        self._restrictions = restrictions
        try:
            self._issue(self._scene.nodes)
        except Exception:
            self._restrictions = before
            raise
        names = ", ".join(restriction.name for restriction in restrictions) or "none"
        self._scene.run.report("", f"restrictions of the controller: {names}")

    def set_plan(self, drone: VirtualDrone, plan: FlightPlan, at: Trigger | None = None) -> None:
        """Replace the flight plan of a drone in flight: permitted area, waypoints and restrictions.

        The new Grant takes effect within one second. The vehicle's own fence stays around the area of the first plan
        until the drone lands, so the area can only become smaller. The program is not informed: `control.remaining()`
        of the SDK contains the waypoints of the first plan. `until(drone, reached=...)` counts the waypoints of the new
        plan from the replacement on.

        Args:
            drone: Drone with a flight plan.
            plan: New flight plan.
            at: Moment of a flight to wait for.

        Raises:
            AssertionError: The moment did not come.
            ExperimentError: The drone has no flight plan, or the new one cannot be planned or permits an area outside of the
                first plan. The old plan then stays.
        """
        __tracebackhide__ = True
        if at is not None:
            self._scene.wait(at, TRIGGER_TIMEOUT_S)
        self._scene.replan(drone, plan, self._restrictions, lambda: self._issue([drone.node]))
        self._scene.run.report(drone.node, "flight plan replaced by the controller")

    def emergency_landing(self, drone: VirtualDrone, at: Trigger | None = None) -> None:
        """Land a drone at once where it is. The system takes the drone from its program.

        Args:
            drone: Drone to land.
            at: Moment of a flight to wait for.
        """
        __tracebackhide__ = True
        if at is not None:
            self._scene.wait(at, TRIGGER_TIMEOUT_S)
        if not drone.samples:
            raise ExperimentError(f"{drone.name} has no position; start its program first")
        place = drone.samples[-1].place
        area = circle(place.lat, place.lon, EMERGENCY_RADIUS_M)
        closed = no_fly(f"emergency-{drone.node}", area, action="land", priority=1000)
        node = {"nodes": [{"key": "name", "operator": "In", "values": [drone.node]}]}
        self.update_restrictions(
            *self._restrictions, Restriction(closed.name, {**closed.policy, "selector": node}, closed.area)
        )

    def abort(self, drone: VirtualDrone, at: Trigger | None = None) -> None:
        """End the mission of a drone: its Grants are revoked, and the system brings the drone home.

        A drone without contact gets the revocation when the contact returns.

        Args:
            drone: Drone to bring home.
            at: Moment of a flight to wait for.
        """
        __tracebackhide__ = True
        if at is not None:
            self._scene.wait(at, TRIGGER_TIMEOUT_S)
        self._scene.run.report(drone.node, "mission aborted by the controller")
        self._aborted.add(drone.node)
        self._issue([drone.node])

    def lose_contact(self, drone: VirtualDrone, duration: float, at: Trigger | None = None) -> None:
        """Interrupt the contact of this controller to a drone. The drone keeps its Grants and continues its flight.

        Args:
            drone: Drone.
            duration: Seconds of the vehicle.
            at: Moment of a flight to wait for.
        """
        __tracebackhide__ = True
        if at is not None:
            self._scene.wait(at, TRIGGER_TIMEOUT_S)
        self._silent_until_s[drone.node] = self._scene.run.now_s + duration
        self._scene.run.report(drone.node, f"contact to the controller lost for {duration:g} s")

    def poll(self) -> None:
        """Issue pending Grants to drones whose contact has returned."""
        back = {node for node in self._pending if not self._silent(node)}
        if back:
            self._pending -= back
            self._issue(back)

    def _silent(self, node: str) -> bool:
        lost = self._scene.run.now_s < self._silent_until_s.get(node, 0.0)
        return lost or not self._scene.controller_reaches(self, node)

    def _issue(self, nodes: Iterable[str]) -> None:
        reachable = {node for node in nodes if not self._silent(node)}
        self._pending |= set(nodes) - reachable
        for node in reachable & self._aborted:
            self._scene.run.testbed.revoke(node)
        self._scene.reissue(self._restrictions, reachable - self._aborted)


class Scene:
    """A test with its drones. Use it as a context manager.

    Attributes:
        folder: Folder of logs, manifests and report. Files of an earlier run are removed.
        base: Base directory of relative paths of programs and manifests.
    """

    def __init__(
        self,
        folder: Path,
        *,
        base: Path | None = None,
        speedup: float | None = None,
        max_speedup: float | None = None,
        seed: int = 1,
    ) -> None:
        """Create an empty scene.

        Args:
            folder: Output folder. It is emptied.
            base: Base directory of relative paths. Default: the working directory.
            speedup: Factor of real time. Default: 4, and as fast as possible for vehicles alone.
            max_speedup: Highest factor of real time, except for vehicles that fly alone as fast as possible.
            seed: Seed of noise and wind.

        Raises:
            ExperimentError: The folder contains files that are not of an earlier test.
        """
        self.folder = folder.absolute()
        self.base = base or Path.cwd()
        self.speedup = speedup
        self.max_speedup = max_speedup
        self.seed = seed
        self.lines: list[str] = []
        self._drones: list[VirtualDrone] = []
        self._nodes: list[VirtualNode] = []
        self._networks: list[NetSim] = []
        self._controllers: list[VirtualController] = []
        self._run: ExperimentRun | None = None
        self._outcome: Outcome | None = None
        self._began = False
        self._wind: dict[str, float] = {}
        self._issued: list[Restriction] = []
        self._manifest_paths: list[str] = []
        self._first_paths: list[str] = []
        self._changes = itertools.count(1)
        _require_replaceable(self.folder)
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        (self.folder / DEFINITION).touch()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def vController(self) -> VirtualController:  # noqa: N802 - term of the field
        """Return the virtual controller of the test.

        Raises:
            ExperimentError: The test has a controller already.
        """
        if self._controllers:
            raise ExperimentError("a test has one controller; vController() was called before")
        controller = VirtualController(self)
        self._controllers.append(controller)
        return controller

    def vDrone(  # noqa: N802 - term of the field
        self,
        name: str,
        mode: str = SITL,
        *,
        autopilot: str = Ardupilot,
        fdm: str = Builtin,
        setup: Resources = MIN_RESOURCES,
        connection: str | None = None,
    ) -> VirtualDrone:
        """Add a virtual drone.

        Args:
            name: Name of the drone. In lower case, it is the name of its node.
            mode: SITL: simulated vehicle, and services and programs as local processes.
            autopilot: Ardupilot: an ArduCopter-compatible simulated vehicle.
            fdm: Flight dynamics. Builtin: part of the simulated vehicle.
            setup: Resources that the application of the drone declares.
            connection: `tcp:HOST:PORT` of a running autopilot at the start position, such as ArduPilot SITL. Its clock
                must run `speedup` times real time. None: a simulated vehicle is started.

        Raises:
            ExperimentError: The name is used twice, or a mode is not supported.
        """
        self.require_not_started("vDrone")
        for value, only, field in ((mode, SITL, "mode"), (autopilot, Ardupilot, "autopilot"), (fdm, Builtin, "fdm")):
            if value != only:
                raise ExperimentError(f"vDrone {name}: {field} {value} is not supported; use {only}")
        drone = VirtualDrone(self, name, setup, connection)
        if drone.node in self.nodes:
            raise ExperimentError(f"the drone name {name} is used twice; names must be unique in lower case")
        self._drones.append(drone)
        return drone

    def vNode(self, name: str, pos: tuple[float, float, float] | None = None) -> VirtualNode:  # noqa: N802 - term of the field
        """Add an edge node, or the cloud.

        Args:
            name: Name of the node.
            pos: Latitude and longitude in degrees, metres above mean sea level. None: the ranges of networks do not apply.

        Raises:
            ExperimentError: The name is used twice.
        """
        self.require_not_started("vNode")
        node = VirtualNode(self, name, pos)
        if node.node in (*self.nodes, *(other.node for other in self._nodes)):
            raise ExperimentError(f"the name {name} is used twice; names must be unique in lower case")
        self._nodes.append(node)
        return node

    def NetSim(self, network: Network) -> NetSim:  # noqa: N802 - term of the field
        """Add a simulated network.

        Raises:
            SkipTest: The user is not root, or a program is missing. pytest then skips the test with the reason.
        """
        self.require_not_started("NetSim")
        try:
            require_networks()
        except NetworksUnavailable as error:
            raise SkipTest(str(error)) from None
        simulation = NetSim(self, network)
        self._networks.append(simulation)
        return simulation

    def set_wind(self, speed: float, direction: float = 270.0, turbulence: float = 0.0) -> None:
        """Set the wind: speed in m/s, direction in degrees that it comes from, turbulence in m/s (1 sigma)."""
        self.require_not_started("set_wind")
        self._wind = {"speed": speed, "direction": direction, "turbulence": turbulence}

    def advance(self, seconds: float) -> None:
        """Let the flights continue for some seconds of the vehicles."""
        self.advance_until(lambda: False, seconds)

    def results(self) -> Results:
        """Return queries and assertions about this test. Each query reads the state at the time of its call."""
        run = self.run
        declared = {drone.node: drone.resources for drone in self._drones if drone.plan is not None}
        return Results(lambda: record_of_run(run), declared, self._zones())

    def close(self) -> None:
        """Stop all processes."""
        if self._run is not None:
            self._run.close()

    def write_report(self) -> list[str]:
        """End the run, and write report and figures to the folder.

        Returns:
            Lines for the report of a failed test: folder, map, last verdicts, and the selected logs.
        """
        lines = [f"folder: {self.folder}"]
        if self._run is None or not self._began:
            return lines
        from fractus_sim.runner.experiment_report import write_outcome  # noqa: PLC0415 - draws figures

        if self._outcome is None:
            self._outcome = self._run.result()
            write_outcome(self._outcome)
        if (self.folder / "map.png").exists():
            lines.append(f"map: {self.folder / 'map.png'}")
        if self._outcome.problem:
            lines.append(f"problem: {self._outcome.problem}")
        decisions = [call for call in self._outcome.decisions if call.action]
        lines += [
            f"{call.time_s:7.1f} s  {call.caller} {call.method}: {call.action} {call.code}: {call.reason}"
            for call in decisions[-_MAX_VERDICTS:]
        ] or ["verdicts: policies changed no call"]
        for drone in self._drones:
            lines += self._log_lines(drone)
        return lines

    @property
    def run(self) -> ExperimentRun:
        """The running experiment.

        Raises:
            ExperimentError: No program was started.
        """
        if self._run is None:
            raise ExperimentError("nothing runs yet; call start_app() first")
        return self._run

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of the nodes of all drones."""
        return tuple(drone.node for drone in self._drones)

    def require_not_started(self, method: str) -> None:
        """Check that no program was started.

        Raises:
            ExperimentError: The experiment runs already.
        """
        if self._run is not None:
            raise ExperimentError(f"{method}() must be called before the first start_app()")

    def start(self) -> None:
        """Start all drones and wait until they are ready, unless they run already.

        Raises:
            ExperimentError: A part did not start. The message says what to do.
        """
        if self._run is not None:
            return
        try:
            content = self._experiment()
            (self.folder / DEFINITION).write_text(yaml.safe_dump(content, sort_keys=False))
            experiment = parse({**content, "settle": SETTLE_S})
        except InvalidObject as error:
            raise ExperimentError(str(error)) from None
        self._run = ExperimentRun(experiment, self.folder, base=self.folder, progress=Progress(self.lines.append))
        self._run.start()
        self._began = True

    def programs(self, drone: VirtualDrone | VirtualNode) -> list[Program]:
        """Return the programs that the experiment runs for a drone or node."""
        names = {f"{drone.node}-{number}" for number in range(len(drone.apps))}
        return [program for program in self.run.experiment.programs if program.name in names]

    def flight(self, drone: VirtualDrone) -> Flight:
        """Return the recording of a drone."""
        return self.run.flights[drone.node]

    def wait(self, trigger: Trigger, timeout: float) -> None:
        """Let the flights continue until a moment.

        Raises:
            AssertionError: The moment did not come in time.
        """
        __tracebackhide__ = True
        if not self.advance_until(trigger.fired, timeout):
            states = "; ".join(f"{drone.name}: {self.describe(drone)}" for drone in self._drones)
            raise AssertionError(f"not within {timeout:g} s: {trigger.title} ({states})")

    def advance_until(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Let the flights continue until a condition is true. Return False after the timeout.

        Raises:
            ExperimentError: A service or vehicle ended.
        """
        run = self.run
        end_s = run.now_s + timeout
        while not condition():
            if run.problem:
                raise ExperimentError(run.problem)
            if run.now_s >= end_s or not run.advance(min(STEP_S, end_s - run.now_s)):
                return condition()
            for controller in self._controllers:
                controller.poll()
        return True

    def programs_ended(self, drone: VirtualDrone) -> bool:
        """Return True if the drone has programs, and all of them have ended."""
        processes = self.run.testbed.processes
        names = [program.name for program in self.programs(drone)]
        return processes is not None and bool(names) and not any(map(processes.running, names))

    def wait_programs_end(self, drone: VirtualDrone) -> None:
        """Give the programs of a drone some real time to end."""
        deadline = time.monotonic() + PROGRAM_END_S
        while drone.apps and not self.programs_ended(drone) and time.monotonic() < deadline:
            self.run.advance(STEP_S)

    def describe(self, drone: VirtualDrone) -> str:
        """Describe the state of a drone for error messages."""
        samples = drone.samples
        if not samples:
            return "no position received"
        last = samples[-1]
        state = "in the air" if last.in_air else "on the ground"
        text = f"{state} in mode {last.mode}, {last.place.alt_m:.1f} m above home"
        decisions = policy_decisions(record_of_run(self.run).entries.get(drone.node, ()))
        if decisions:
            text += f"; last verdict: {decisions[-1].method} {decisions[-1].code}: {decisions[-1].reason}"
        processes = self.run.testbed.processes
        for program in self.programs(drone):
            if processes is not None and processes.started(program.name) and not processes.running(program.name):
                code = processes.exit_code(program.name)
                text += f"; program ended with exit code {code}: {processes.log_tail(program.name)}"
        return text

    def replan(
        self, drone: VirtualDrone, plan: FlightPlan, restrictions: Sequence[Restriction], issue: Callable[[], None]
    ) -> None:
        """Replace the flight plan of a drone.

        Args:
            drone: Drone with a flight plan.
            plan: New flight plan.
            restrictions: Additional restrictions that apply to the drone.
            issue: Issues the Grants of the new plan, or notes that the drone gets them later.

        Raises:
            ExperimentError: The drone has no flight plan, or the new one cannot be planned or permits an area outside of the
                first plan. The old plan then stays.
        """
        before = drone.plan
        if before is None:
            raise ExperimentError(
                f"{drone.name} has no flight plan that could be replaced; call its set_plan() before start_app()"
            )
        paths = self._manifest_paths
        drone.plan = plan
        try:
            self._manifest_paths = self._manifests(f"plan-{next(self._changes)}.yaml")
            self._require_within_first_plan(drone)
            # A drone without contact gets its Grants later, so they are compiled here to report errors now.
            self._compile_grants(restrictions)
            issue()
        except Exception:
            drone.plan = before
            self._manifest_paths = paths
            raise
        drone.plan_begin = len(drone.samples)

    def reissue(self, restrictions: Sequence[Restriction], nodes: Iterable[str]) -> None:
        """Replace the Grants of drones by Grants with additional restrictions. The plans stay.

        Raises:
            ExperimentError: A restriction is invalid.
        """
        chosen = set(nodes)
        if not chosen:
            return
        grants = [spec for spec in self._compile_grants(restrictions) if spec.node in chosen]
        self._issued += restrictions
        self.run.testbed.reissue(grants)

    def _compile_grants(self, restrictions: Sequence[Restriction]) -> list[GrantSpec]:
        """Return the Grants of all drones for their current plans, with additional restrictions."""
        paths = [self.folder / path for path in self._manifest_paths]
        planned = read_all_manifests(paths)
        manifests = [manifest for restriction in restrictions for manifest in restriction.manifests()]
        if manifests:
            paths.append(self._write(f"restrictions-{next(self._changes)}.yaml", manifests))
        return list(planned_grants(planned, read_all_manifests(paths)))

    def _require_within_first_plan(self, drone: VirtualDrone) -> None:
        """Check that the current plan of a drone permits no area outside of its first plan."""
        outside = self._permitted_area(drone, self._manifest_paths).difference(
            self._permitted_area(drone, self._first_paths).buffer(AREA_TOLERANCE_M)
        )
        if not outside.is_empty:
            raise ExperimentError(
                f"{drone.name}: the new flight plan permits {outside.area:.0f} m2 outside of the first plan, but the vehicle's"
                " own fence stays around the first plan; choose a plan within its area"
            )

    def _permitted_area(self, drone: VirtualDrone, paths: Sequence[str]) -> BaseGeometry:
        """Return the area in which a plan permits flights, in metres east and north of the start position."""
        if drone.home is None:
            return Polygon()
        frame = LocalFrame(drone.home[0], drone.home[1])
        specs = planned_grants(read_all_manifests([self.folder / path for path in paths]))
        areas = [area for spec in specs if spec.node == drone.node for area in (*spec.operation_area, *spec.corridor)]
        return union_all([area_polygon(frame, area) for area in areas])

    def controller_reaches(self, controller: VirtualController, node: str) -> bool:
        """Return True if a drone is in range of the controller in a common network, or if the controller has no network."""
        drone = next(drone for drone in self._drones if drone.node == node)
        networks = [each for each in self._networks if controller in each.participants]
        ranges = [each.network.range for each in networks if drone in each.participants]
        if not networks or any(limit is None for limit in ranges):
            return True
        if controller.place is None or drone.home is None or not drone.samples:
            return bool(ranges)
        place = drone.samples[-1].place
        lat, lon, alt = controller.place
        ground_m = geodesic_m(place.ground, Point(lat=lat, lon=lon))
        distance_m = math.hypot(ground_m, drone.home[2] + place.alt_m - alt)
        return any(limit is not None and distance_m <= limit for limit in ranges)

    def manifest_waypoints(self) -> tuple[Waypoint, ...]:
        """Return the waypoints of the first driver in the manifests of the drones."""
        paths = [path for drone in self._drones for path in drone.manifests]
        return _driver_waypoints(read_all_manifests(paths)) if paths else ()

    def _experiment(self) -> dict[str, Any]:
        if not self._drones:
            raise ExperimentError("the scene has no drone; call vDrone() first")
        alone = [drone for drone in self._drones if drone.task]
        if alone and len(alone) < len(self._drones):
            others = ", ".join(drone.name for drone in self._drones if not drone.task)
            raise ExperimentError(f"set_task() flies vehicles alone, so all drones need it; missing: {others}")
        speedup = self.speedup
        if speedup is None:
            speedup = AS_FAST_AS_POSSIBLE if alone else DEFAULT_SPEEDUP
        if self.max_speedup is not None:
            speedup = min(speedup, self.max_speedup)
        content: dict[str, Any] = {
            "name": _slug(self.folder.name), "mode": "vehicles" if alone else "standalone", "seed": self.seed,
            "speedup": speedup, "timeout": MAX_DURATION_S, "wind": self._wind,
            "vehicles": [self._vehicle(drone) for drone in self._drones],
            "faults": [fault for drone in self._drones for fault in drone.faults],
        }  # fmt: skip
        worlds = {drone.world for drone in self._drones if drone.world is not None}
        if len(worlds) > 1:
            raise ExperimentError("set_camera: all drones of a test see the same world; pass the same World")
        content["world"] = worlds.pop().to_dict() if worlds else {}
        if not alone:
            self._manifest_paths = self._manifests("manifests.yaml")
            self._first_paths = self._manifest_paths
            content["manifests"] = self._manifest_paths
            content["programs"] = [program for drone in self._drones for program in self._program_entries(drone)]
            content["programs"] += [
                {**self._program_entry(node, number, program), "node": node.node, "background": True}
                for node in self._nodes
                for number, program in enumerate(node.apps)
            ]
            content["nodes"] = [_node_entry(node) for node in self._nodes]
            content["networks"] = _network_entries(self._networks)
        elif self._networks:
            raise ExperimentError("NetSim: vehicles that set_task() flies alone have no programs; use set_app()")
        return {name: value for name, value in content.items() if value not in ({}, [])}

    def _vehicle(self, drone: VirtualDrone) -> dict[str, Any]:
        if drone.home is None:
            raise ExperimentError(f"{drone.name} has no start position; call set_pos()")
        lat, lon, alt = drone.home
        entry: dict[str, Any] = {
            "name": drone.node, "home": {"lat": lat, "lon": lon, "alt": alt}, "readyAfter": 1 if drone.task else 3,
        }  # fmt: skip
        if drone.connection is not None and drone.task:
            raise ExperimentError(
                f"{drone.name}: a running autopilot needs a program; use set_app() instead of set_task()"
            )
        optional = {
            "connection": drone.connection,
            "parameters": drone.parameters,
            "task": drone.task,
            "camera": drone.world is not None,
        }
        return entry | {name: value for name, value in optional.items() if value}

    def _manifests(self, file: str) -> list[str]:
        """Write the manifests of flight plans to a file, and return the paths of all manifests."""
        paths = []
        manifests: list[Manifest] = []
        for drone in self._drones:
            if (drone.plan is None) == (not drone.manifests):
                raise ExperimentError(f"{drone.name} needs a flight plan: call either set_plan() or set_manifests()")
            paths += [str(path.absolute()) for path in drone.manifests]
            if drone.plan is not None and drone.home is not None:
                manifests += drone_manifests(
                    drone.node, _component(drone), drone.home, drone.plan,
                    resources=drone.resources, camera=drone.world is not None,
                    interface=drone.apps[0].interface if drone.apps else "grpc",
                )  # fmt: skip
        if manifests:
            paths.append(self._write(file, manifests).name)
        return list(dict.fromkeys(paths))

    def _program_entries(self, drone: VirtualDrone) -> list[dict[str, Any]]:
        if drone.plan is not None and len(drone.apps) > 1:
            raise ExperimentError(f"{drone.name}: a flight plan has one program; use set_manifests() for several")
        entries = []
        for number, program in enumerate(drone.apps):
            component = _component(drone) if drone.plan is not None else program.component
            if component is None:
                raise ExperimentError(f"{drone.name}: set_app() needs `component` with set_manifests()")
            entries.append({**self._program_entry(drone, number, program), "component": component})
        return entries

    def _program_entry(self, owner: VirtualDrone | VirtualNode, number: int, program: App) -> dict[str, Any]:
        entry: dict[str, Any] = {
            "name": f"{owner.node}-{number}", "component": program.component,
            "command": [self._absolute(word) for word in program.command], "environment": program.environment,
        }  # fmt: skip
        return entry if program.port is None else {**entry, "port": program.port}

    def _absolute(self, word: str) -> str:
        """Return the absolute path of a file of the test, or any other word unchanged."""
        path = self.base / word
        return str(path.absolute()) if path.is_file() else word

    def _write(self, name: str, manifests: Sequence[Manifest]) -> Path:
        path = self.folder / name
        path.write_text(yaml.safe_dump_all(merged(manifests), sort_keys=False))
        return path

    def _zones(self) -> dict[str, NamedZone]:
        restrictions = [r for drone in self._drones if drone.plan is not None for r in drone.plan.restrictions]
        restrictions += self._issued
        return {
            r.name: NamedZone.model_validate({"name": r.name, "area": r.area})
            for r in restrictions
            if r.area is not None
        }

    def _log_lines(self, drone: VirtualDrone) -> list[str]:
        files = []
        if app in drone.logs:
            files += [f"{drone.node}-{number}" for number in range(len(drone.apps))]
        if runtime in drone.logs:
            files += [f"{drone.node}-mobility", f"{drone.node}-camera", f"{drone.node}-gateway"]
        lines = []
        for name in files:
            path = self.folder / "logs" / f"{name}.log"
            if path.exists():
                lines += [f"--- {path.name}", *path.read_text(errors="replace").splitlines()[-_LOG_LINES:]]
        if autopilot in drone.logs and self._run is not None:
            texts = self._run.flights[drone.node].texts[-_LOG_LINES:]
            lines += [f"--- autopilot of {drone.name}", *(f"{text.time_s:7.1f} s  {text.text}" for text in texts)]
        return lines


def _require_replaceable(folder: Path) -> None:
    """Check that a folder is empty, or that it is the folder of an earlier test.

    Raises:
        ExperimentError: The folder contains other files.
    """
    if folder.exists() and any(folder.iterdir()) and not (folder / DEFINITION).exists():
        raise ExperimentError(f"{folder} contains other files than an earlier test; specify a new folder")


def _node_entry(node: VirtualNode) -> dict[str, Any]:
    if node.place is None:
        return {"name": node.node}
    lat, lon, alt = node.place
    return {"name": node.node, "place": {"lat": lat, "lon": lon, "alt": alt}}


def _network_entries(networks: Sequence[NetSim]) -> list[dict[str, Any]]:
    """Return the networks with drones and nodes. The controller runs in the process of the test."""
    entries = []
    for number, each in enumerate(networks, 1):
        names = [
            participant.node for participant in each.participants if not isinstance(participant, VirtualController)
        ]
        if names:
            entries.append({"name": f"network-{number}", "participants": names, **each.network.to_dict()})
    return entries


def _component(drone: VirtualDrone) -> str:
    """Return the component of the program of a flight plan. Names of drones may begin with a digit."""
    return f"App-{drone.node}"


def _slug(text: str) -> str:
    """Return a text as a name of an experiment."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:60].strip("-") or "test"


def _driver_waypoints(manifests: Manifests) -> tuple[Waypoint, ...]:
    for application in manifests.of(Application).values():
        driver = application.spec.driver
        if driver is not None:
            return tuple(
                (position.lat, position.lon, position.alt or 0.0)
                for point in driver.control_points
                for position in point.path or ()
            )
    return ()
