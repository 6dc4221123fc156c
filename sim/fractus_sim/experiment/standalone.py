"""Drones without Kubernetes: vehicle, mobility service, camera world and camera service as local processes.

    with Standalone(Path("out/field")) as ground:
        drone = ground.add_drone(DroneSetup("drone-1", home=(50.8637, 4.6785, 25.0), camera=CameraSetup()))
        identity = ground.grant(manifest)      # sign a Grant and store it for the services
        ground.run("navigator", [sys.executable, "navigator.py"], identity)
        ground.wait_program("navigator", timeout_s=120.0)

Each program gets the environment of its pod (FRACTUS_*), so programs that use the SDK run unchanged. All processes end
with the block.

Files in the directory:

    pki/       keys and certificates (fractus_cli.standalone)
    logs/      NAME.log of each process, DRONE.tlog of each autopilot link in both directions
    DRONE/     grants/, state/, pictures/, node.yaml, mobility.jsonl and camera.jsonl (audit logs)
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from fractus_cli.standalone import StandalonePki
from fractus_core.api import Grant
from fractus_core.api.names import address_variable

from fractus_sim.experiment.errors import ExperimentError
from fractus_sim.experiment.processes import Processes
from fractus_sim.experiment.standalone_drone import LOOPBACK, DroneSetup, RunningDrone, base_environment


@dataclass(frozen=True, slots=True)
class _Program:
    """Command of a program, kept to restart the program when its node is powered on."""

    node: str
    command: tuple[str, ...]
    environment: Mapping[str, str]
    folder: Path | None


class Standalone:
    """Drones, their services and programs in one directory. Use it as a context manager."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.absolute()
        self.folder.mkdir(parents=True, exist_ok=True)
        self.pki = StandalonePki.create(self.folder / "pki")
        self.processes = Processes(self.folder / "logs")
        self.drones: dict[str, RunningDrone] = {}
        self._grants: dict[str, Grant] = {}
        self._programs: dict[str, _Program] = {}
        self._off: dict[str, tuple[str, ...]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add_drone(self, setup: DroneSetup) -> RunningDrone:
        """Start a drone and wait until its services listen. The autopilot may not be ready to arm yet.

        Raises:
            ExperimentError: A process did not start, or the name is in use.
            InvalidObject: The description is not a valid Drone.
        """
        if setup.name in self.drones:
            raise ExperimentError(f"the drone name {setup.name} is used twice; names must be unique")
        (self.folder / "logs").mkdir(exist_ok=True)
        drone = RunningDrone(setup, self.folder, self.pki.node(setup.name), self.processes)
        self.drones[setup.name] = drone
        drone.start()
        return drone

    def grant(self, manifest: Mapping[str, Any]) -> str:
        """Sign a Grant and store it for the services of its node. A Grant with the same name is replaced.

        Args:
            manifest: Object of kind Grant. `fractus_core.planning.grant_compiler.compile_grants` creates its spec.

        Returns:
            Identity of the component instance.

        Raises:
            ExperimentError: The node is unknown.
            InvalidObject: The manifest is not a valid Grant.
        """
        grant = Grant.from_body(manifest)
        drone = self._drone(grant.spec.node)
        self.pki.grant(dict(manifest), drone.grants)
        self._grants[grant.spec.identity] = grant
        return grant.spec.identity

    def revoke(self, identity: str) -> None:
        """Remove the Grant of a component instance.

        Raises:
            ExperimentError: The instance has no Grant.
        """
        grant = self._granted(identity)
        (self._drone(grant.spec.node).grants / f"{grant.metadata.name}.json").unlink(missing_ok=True)

    def environment(self, identity: str, services: Mapping[str, str] | None = None) -> dict[str, str]:
        """Return the environment of a component's pod: identity, service addresses and control points.

        Args:
            identity: Identity returned by `grant`.
            services: host:port of each component that this component may call, by component name.

        Raises:
            ExperimentError: The identity has no Grant.
        """
        spec = self._granted(identity).spec
        drone = self._drone(spec.node)
        variables = {
            "FRACTUS_NODE": spec.node,
            "FRACTUS_HOST_IP": LOOPBACK,
            "FRACTUS_NAMESPACE": spec.application.namespace,
            "FRACTUS_APPLICATION": spec.application.name,
            "FRACTUS_COMPONENT": spec.component,
            "FRACTUS_INSTANCE": spec.instance,
            "FRACTUS_TLS_DIR": str(self.pki.component(identity)),
            "FRACTUS_MOBILITY_ADDRESS": drone.mobility_address,
        }
        if drone.camera_address is not None:
            variables["FRACTUS_CAMERA_ADDRESS"] = drone.camera_address
        if spec.control_points:
            points = [point.to_dict() for point in spec.control_points]
            variables["FRACTUS_CONTROL_POINTS"] = json.dumps(points, separators=(",", ":"))
        for component, address in (services or {}).items():
            variables[address_variable(component)] = address
        return {**base_environment(), **variables}

    def run(
        self,
        name: str,
        command: Sequence[str],
        identity: str,
        *,
        environment: Mapping[str, str] | None = None,
        services: Mapping[str, str] | None = None,
        folder: Path | None = None,
    ) -> None:
        """Start a program as a component instance. Its output is written to `logs/NAME.log`.

        Args:
            name: Name of the program.
            command: Program and arguments.
            identity: Identity returned by `grant`.
            environment: Additional environment variables.
            services: See `environment`.
            folder: Working directory.

        Raises:
            ExperimentError: The program cannot be started, or the identity has no Grant.
        """
        variables = {**self.environment(identity, services), **(environment or {})}
        self._start(name, _Program(self._granted(identity).spec.node, tuple(command), variables, folder))

    def run_beside(
        self,
        name: str,
        command: Sequence[str],
        *,
        environment: Mapping[str, str] | None = None,
        services: Mapping[str, str] | None = None,
        folder: Path | None = None,
    ) -> None:
        """Start a program that uses no system service, such as a component in the cloud.

        Args:
            name: Name of the program.
            command: Program and arguments.
            environment: Additional environment variables.
            services: See `environment`.
            folder: Working directory.

        Raises:
            ExperimentError: The program cannot be started.
        """
        variables = {address_variable(c): address for c, address in (services or {}).items()}
        variables |= {"FRACTUS_HOST_IP": LOOPBACK, "FRACTUS_INSTANCE": name}
        variables = {**base_environment(), **variables, **(environment or {})}
        self._start(name, _Program("", tuple(command), variables, folder))

    def power_off(self, node: str) -> None:
        """Power off the companion computer of a drone. Services and programs are killed; the vehicle keeps flying.

        Raises:
            ExperimentError: The drone is unknown.
        """
        programs = [name for name, program in self._programs.items() if program.node == node]
        self._off[node] = tuple(name for name in programs if self.processes.running(name))
        self.processes.stop(*programs, kill=True)
        self._drone(node).power_off()

    def power_on(self, node: str, *, wait: bool = True) -> None:
        """Power on the companion computer of a drone: restart its services and the programs that were running.

        Args:
            node: Name of the drone.
            wait: Start the programs after the services listen instead of immediately.

        Raises:
            ExperimentError: A process did not start.
        """
        drone = self._drone(node)
        drone.power_on(wait=wait)
        for name in self._off.pop(node, ()):
            self._start(name, self._programs[name])

    def wait_program(self, name: str, timeout_s: float) -> int | None:
        """Wait for a program to end. Return its exit code, or None after the timeout."""
        return self.processes.wait_end(name, timeout_s)

    def check(self) -> None:
        """Check that all vehicles and services are running.

        Raises:
            ExperimentError: A process has ended. The message ends with the tail of its log.
        """
        for name, code in self.processes.dead().items():
            if name not in self._programs and not any(name.startswith(f"{node}-") for node in self._off):
                raise ExperimentError(f"{name} ended with exit code {code}: {self.processes.log_tail(name)}")

    def stop_services(self) -> None:
        """Stop programs, then services, so that their logs are complete. Vehicles keep running."""
        self.processes.stop(*self._programs)
        for drone in self.drones.values():
            self.processes.stop(drone.process("camera"), drone.process("mobility"))

    def close(self) -> None:
        """Stop all processes: programs first, then services, then vehicles."""
        with ExitStack() as links:
            for drone in self.drones.values():
                links.callback(drone.close)
            self.processes.stop_all(
                lambda name: name in self._programs, lambda name: not name.endswith(("-vehicle", "-world"))
            )

    def _start(self, name: str, program: _Program) -> None:
        self.processes.start(name, program.command, program.environment, program.folder)
        self._programs[name] = program

    def _drone(self, node: str) -> RunningDrone:
        if node not in self.drones:
            raise ExperimentError(f"no drone {node}; known: {', '.join(self.drones) or 'none'}")
        return self.drones[node]

    def _granted(self, identity: str) -> Grant:
        if identity not in self._grants:
            raise ExperimentError(f"{identity} has no Grant; call grant() first")
        return self._grants[identity]
