"""Experiment mode standalone: drones with the services of Fractus as local processes, and Grants from manifests."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterable, Sequence
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
from fractus_sim.testbeds.detections import DETECTIONS_FILE, DETECTIONS_VARIABLE, TruthWatch, read_detections
from fractus_sim.testbeds.ground_station import TcpLink
from fractus_sim.testbeds.node_networks import NodeNetworks
from fractus_sim.testbeds.resource_meter import ResourceMeter
from fractus_sim.testbeds.standalone_drones import LOOPBACK, CameraSetup, DroneSetup, Standalone
from fractus_sim.testbeds.testbed import Moment, Testbed, program_command, wind_argument

TICK_S = 0.02
CONNECT_S = 10.0


class StandaloneTestbed(Testbed):
    """Drones with their services. Programs run as components of the manifests."""

    def __init__(self, experiment: Experiment, folder: Path, base: Path, report: Callable[[str], None]) -> None:
        super().__init__(experiment, folder, base, report)
        for name in ("pki", *(setup.name for setup in experiment.setups())):
            shutil.rmtree(folder / name, ignore_errors=True)
        for log in (folder / "logs").glob("*.log"):
            log.unlink()
        self._manifests = read_all_manifests([base / path for path in experiment.manifests])
        self._drones = self.keep(Standalone(folder))
        self.processes = self._drones.processes
        self._identities: dict[str, str] = {}
        self._meter = ResourceMeter()
        self._networks = NodeNetworks(experiment, self.processes, folder)
        self._watches: list[TruthWatch] = []
        self._detections = folder / DETECTIONS_FILE
        self._detections.unlink(missing_ok=True)
        self._began_s = time.monotonic()

    def set_up(self) -> None:
        """Plan the applications, start the drones, and issue the planned Grants.

        Raises:
            ExperimentError: An application cannot be planned, or a process did not start.
        """
        grants = list(planned_grants(self._manifests))
        drone_manifests = self._manifests.of(Drone)
        self._networks.set_up()
        mavlink_nodes = {spec.node for spec in grants if "mavlink" in spec.interfaces("mobility")}
        for setup in self.experiment.setups():
            description = self._setup(setup, drone_manifests.get(setup.name), gateway=setup.name in mavlink_nodes)
            drone = self._drones.add_drone(description)
            host, port = drone.station_link.removeprefix("tcp:").rsplit(":", 1)
            self.observe(setup, TcpLink.connect(host, int(port), CONNECT_S))
            self.endpoints[setup.name] = drone.guest_link
            if drone.world_url is not None:
                truths = self.folder / "logs" / f"{setup.name}-truth.jsonl"
                self._watches.append(self.keep(TruthWatch(drone.world_url, truths)))
        self._networks.start({drone.name: drone.station_link for drone in self._drones.drones.values()})
        self.reissue(grants)
        self._began_s = time.monotonic()

    def tick(self) -> Moment:
        """Sleep for 20 ms.

        Raises:
            ExperimentError: A vehicle or a service has ended.
        """
        time.sleep(TICK_S)
        self._drones.check()
        if self._meter.measure():
            self.findings.usages = self._meter.usages
            self._measure_data()
        return Moment((time.monotonic() - self._began_s) * self.experiment.pace, time.time_ns() // 1000)

    def begin(self, program: Program | None = None) -> None:
        """Start a program as its component, or all programs."""
        for each in self.experiment.programs if program is None else (program,):
            self._start_program(each)

    def reissue(self, grants: Iterable[GrantSpec]) -> None:
        """Sign Grants of the drones of this experiment, and replace earlier Grants of the same instances."""
        for spec in grants:
            if spec.node in self._drones.drones:
                self._identities[spec.component] = self._drones.grant(grant_manifest(spec))

    def revoke(self, vehicle: str) -> None:
        """Remove the Grants of a drone."""
        self._drones.revoke(vehicle)

    @property
    def required_flights(self) -> list[str]:
        """All vehicles, or none if foreground programs determine the end of the experiment."""
        if any(not program.background for program in self.experiment.programs):
            return []
        return list(self.observers)

    def set_link(self, vehicle: str, *, connected: bool) -> None:
        """Cut or restore the link between companion computer and autopilot."""
        self._drones.drones[vehicle].set_link(connected=connected)

    def set_power(self, node: str, *, on: bool) -> None:
        """Kill or restart services and programs of a drone."""
        if on:
            self._drones.power_on(node, wait=False)
        else:
            self._drones.power_off(node)

    def collect(self) -> None:
        """Stop programs and services, and read their audit logs."""
        super().collect()
        self._measure_data()
        self._drones.stop_services()
        if self._detections.exists():
            self.findings.detections = read_detections(self._detections.read_text().splitlines())
        for watch in self._watches:
            watch.close()
            self.findings.truths += watch.objects
        for drone in self._drones.drones.values():
            self.read_audit_logs(drone.name, drone.folder)

    def _setup(self, setup: VehicleSetup, manifest: Drone | None, *, gateway: bool) -> DroneSetup:
        if manifest is None:
            raise ExperimentError(f"the manifests contain no Drone {setup.name}; add one")
        if setup.home is None:
            raise ExperimentError(f"{setup.name} has no start position; set `home`")
        entry = setup.entry
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
            description=manifest.spec.to_dict(),
            camera=camera,
            vehicle_arguments=("--wind", wind_argument(self.experiment)),
            autopilot=entry.connection,
            service_host=self._networks.service_host(setup.name) or LOOPBACK,
            gateway=gateway,
        )

    def _start_program(self, program: Program) -> None:
        port = {"PORT": str(program.port)} if program.port is not None else {}
        identity = self._identities.get(program.component or "") if program.node is None else None
        components = {component.name for app in self._manifests.applications() for component in app.spec.components}
        if identity is None and program.node is None and program.component not in components:
            raise ExperimentError(
                f"program {program.name}: no application has a component {program.component}; known:"
                f" {', '.join(sorted(components))}"
            )
        environment = {DETECTIONS_VARIABLE: str(self._detections.absolute()), **port, **program.environment}
        node = self._node(program)
        self._drones.run(
            program.name,
            program_command(program),
            identity,
            environment=environment,
            services=self._addresses(program, node),
            folder=self.base,
            namespace=self._networks.namespace(node),
        )
        self._meter.add(program.name, node, self._drones.processes.pid(program.name))

    def _node(self, program: Program) -> str:
        """Return the node of a program. Empty for a component in the cloud without an entry in `nodes`."""
        identity = self._identities.get(program.component or "")
        if program.node is not None or identity is None:
            return program.node or ""
        return self._drones.node_of_identity(identity)

    def _addresses(self, program: Program, node: str) -> dict[str, str]:
        """Return the address of each other component that a program can reach."""
        addresses = {}
        for each in self.experiment.programs:
            host = self._networks.address(node, self._node(each))
            if each.component not in {None, program.component} and each.port is not None and host is not None:
                addresses[each.component] = f"{host}:{each.port}"
        return addresses

    def _measure_data(self) -> None:
        sent = self._networks.measure()
        for drone in self._drones.drones.values():
            sent.setdefault(drone.name, {})["autopilot"] = drone.autopilot_bytes
        self.findings.data_sent = sent


def read_all_manifests(paths: Sequence[Path]) -> Manifests:
    """Read the manifests of files and directories.

    Raises:
        ExperimentError: A manifest cannot be read.
    """
    try:
        return read_manifests(paths)
    except BadManifest as error:
        raise ExperimentError(str(error)) from None


def planned_grants(manifests: Manifests, changed: Manifests | None = None) -> Iterable[GrantSpec]:
    """Yield the Grants that the operator would create.

    Args:
        manifests: Manifests from which the applications are planned.
        changed: Manifests of a later time with other policies. The plan stays, as for a drone in flight. None: `manifests`.

    Raises:
        ExperimentError: An application cannot be planned.
    """
    settings = Settings()
    try:
        decisions = plan_all(manifests, settings)
    except BadManifest as error:
        raise ExperimentError(str(error)) from None
    for decision in decisions:
        name = decision.application.name
        if decision.plan is None:
            raise ExperimentError(f"Application {name} cannot be planned: {decision.refusal}")
        yield from compile_grants(decision.application, decision.plan, (changed or manifests).inventory(), settings)


def grant_manifest(spec: GrantSpec) -> dict[str, Any]:
    """Return the Grant object as the operator would create it."""
    metadata = {"name": spec.instance, "uid": f"uid-{spec.instance}"}
    return {"apiVersion": API_VERSION, "kind": "Grant", "metadata": metadata, "spec": spec.to_dict()}
