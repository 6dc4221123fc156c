"""Experiment mode standalone: drones with the services of Fractus as local processes, and Grants from manifests."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fractus_cli.manifests import BadManifest, Manifests, read_manifests
from fractus_cli.offline_planner import plan_all
from fractus_core.api import API_VERSION, Drone
from fractus_core.api.grants import GrantSpec
from fractus_core.planning import Settings
from fractus_core.planning.grant_compiler import compile_grants

from fractus_sim.errors import ExperimentError
from fractus_sim.experiment.definition import Experiment, Program, VehicleSetup
from fractus_sim.report.audit_logs import read_audit
from fractus_sim.testbeds.detections import FILE, VARIABLE, TruthWatch, read_detections
from fractus_sim.testbeds.ground_station import TcpLink
from fractus_sim.testbeds.standalone_drones import CameraSetup, DroneSetup, Standalone
from fractus_sim.testbeds.testbed import Moment, Testbed
from fractus_sim.testbeds.vehicle_testbed import command_of

TICK_S = 0.02
CONNECT_S = 10.0


class ServiceTestbed(Testbed):
    """Drones with their services. Programs run as components of the manifests."""

    def __init__(self, experiment: Experiment, folder: Path, base: Path, tell: Callable[[str], None]) -> None:
        super().__init__(experiment, folder, base, tell)
        for name in ("pki", *(setup.name for setup in experiment.setups())):
            shutil.rmtree(folder / name, ignore_errors=True)
        for log in (folder / "logs").glob("*.log"):
            log.unlink()
        self._manifests = read([base / path for path in experiment.manifests])
        self._ground = self.keep(Standalone(folder))
        self._identities: dict[str, str] = {}
        self._watches: list[TruthWatch] = []
        self._detections = folder / FILE
        self._detections.unlink(missing_ok=True)
        self._began_s = time.monotonic()

    def set_up(self) -> None:
        """Plan the applications, start the drones, and issue the planned Grants.

        Raises:
            ExperimentError: An application cannot be planned, or a process did not start.
        """
        grants = list(granted(self._manifests))
        described = self._manifests.of(Drone)
        for setup in self.experiment.setups():
            drone = self._ground.add_drone(self._setup(setup, described.get(setup.name)))
            host, port = drone.station_link.split(":")[1:]
            self.observe(setup, TcpLink.connect(host, int(port), CONNECT_S))
            self.endpoints[setup.name] = drone.guest_link
            if drone.world_url is not None:
                truths = self.folder / "logs" / f"{setup.name}-truth.jsonl"
                self._watches.append(self.keep(TruthWatch(drone.world_url, truths)))
        for spec in grants:
            if spec.node in self._ground.drones:
                self._identities[spec.component] = self._ground.grant(grant_manifest(spec))
        self._began_s = time.monotonic()

    def tick(self) -> Moment:
        """Sleep for 20 ms.

        Raises:
            ExperimentError: A vehicle or a service has ended.
        """
        time.sleep(TICK_S)
        self._ground.check()
        return Moment((time.monotonic() - self._began_s) * self.experiment.pace, time.time_ns() // 1000)

    def begin(self) -> None:
        """Start the programs as their components."""
        addresses = {
            program.component: f"127.0.0.1:{program.port}"
            for program in self.experiment.programs
            if program.component is not None and program.port is not None
        }
        for program in self.experiment.programs:
            self._start(program, addresses)

    @property
    def busy(self) -> bool:
        """True while a foreground program is running."""
        return any(self._ground.processes.running(p.name) for p in self.experiment.programs if not p.background)

    @property
    def flies(self) -> list[str]:
        """All vehicles, or none if foreground programs determine the end of the experiment."""
        return [] if any(not p.background for p in self.experiment.programs) else list(self.observers)

    def cut_link(self, vehicle: str) -> None:
        """Cut the link between companion computer and autopilot."""
        self._ground.drones[vehicle].cut_link()

    def heal_link(self, vehicle: str) -> None:
        """Restore the link between companion computer and autopilot."""
        self._ground.drones[vehicle].heal_link()

    def power_off(self, node: str) -> None:
        """Kill services and programs of a drone."""
        self._ground.power_off(node)

    def power_on(self, node: str) -> None:
        """Restart services and programs of a drone."""
        self._ground.power_on(node, wait=False)

    def collect(self) -> None:
        """Stop programs and services, and read their audit logs."""
        for program in self.experiment.programs:
            self.findings.programs[program.name] = self._ground.processes.exit_code(program.name)
        self._ground.stop_services()
        if self._detections.exists():
            self.findings.detections = read_detections(self._detections.read_text().splitlines())
        for watch in self._watches:
            watch.close()
            self.findings.truths += watch.seen
        for drone in self._ground.drones.values():
            for path in (drone.audit, drone.audit.with_name("camera.jsonl")):
                if path.exists():
                    read_audit(path, f"{drone.name}/{path.name}", self.findings)

    def _setup(self, setup: VehicleSetup, described: Drone | None) -> DroneSetup:
        if described is None:
            raise ExperimentError(f"the manifests contain no Drone {setup.name}; add one")
        if setup.home is None:
            raise ExperimentError(f"{setup.name} has no start position; set `home`")
        entry = setup.entry
        wind = self.experiment.wind
        world = self.experiment.world
        camera = CameraSetup(("--seed", str(world.seed), *world.arguments)) if entry.camera else None
        return DroneSetup(
            setup.name,
            (setup.home.lat, setup.home.lon, setup.home.alt),
            heading_deg=entry.heading,
            system_id=setup.system_id,
            seed=self.experiment.seed,
            speedup=self.experiment.pace,
            ready_after_s=entry.ready_after,
            parameters=entry.parameters,
            description=described.spec.to_dict(),
            camera=camera,
            vehicle_arguments=("--wind", f"{wind.speed},{wind.direction},{wind.turbulence}"),
        )

    def _start(self, program: Program, addresses: Mapping[str, str]) -> None:
        others = {name: address for name, address in addresses.items() if name != program.component}
        own = {"PORT": str(program.port)} if program.port is not None else {}
        identity = self._identities.get(program.component or "")
        environment = {VARIABLE: str(self._detections.absolute()), **own, **program.environment}
        if identity is not None:
            self._ground.run(
                program.name, command_of(program), identity, environment=environment, services=others, folder=self.base
            )
            return
        known = {component.name for app in self._manifests.applications() for component in app.spec.components}
        if program.component not in known:
            raise ExperimentError(
                f"program {program.name}: no application has a component {program.component}; known:"
                f" {', '.join(sorted(known))}"
            )
        self._ground.run_beside(
            program.name, command_of(program), environment=environment, services=others, folder=self.base
        )


def read(paths: Sequence[Path]) -> Manifests:
    """Read the manifests of files and directories.

    Raises:
        ExperimentError: A manifest cannot be read.
    """
    try:
        return read_manifests(paths)
    except BadManifest as error:
        raise ExperimentError(str(error)) from None


def granted(manifests: Manifests) -> Iterable[GrantSpec]:
    """Yield the Grants that the operator would create.

    Raises:
        ExperimentError: An application cannot be planned.
    """
    settings = Settings()
    try:
        decided = plan_all(manifests, settings)
    except BadManifest as error:
        raise ExperimentError(str(error)) from None
    for answer in decided:
        name = answer.application.name
        if answer.plan is None:
            raise ExperimentError(f"Application {name} cannot be planned: {answer.refusal}")
        yield from compile_grants(answer.application, answer.plan, manifests.inventory(), settings)


def grant_manifest(spec: GrantSpec) -> dict[str, Any]:
    """Return the Grant object as the operator would create it."""
    metadata = {"name": spec.instance, "uid": f"uid-{spec.instance}"}
    return {"apiVersion": API_VERSION, "kind": "Grant", "metadata": metadata, "spec": spec.to_dict()}
