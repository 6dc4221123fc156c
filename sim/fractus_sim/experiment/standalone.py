"""Drones without Kubernetes: vehicle, mobility service, camera world and camera service of each as local processes.

    with Standalone(Path("out/field")) as ground:
        drone = ground.add_drone(DroneSetup("drone-1", home=(50.8637, 4.6785, 25.0), camera=CameraSetup()))
        identity = ground.grant(manifest)            # a Grant: signed, and where the services look for it
        ground.run("navigator", [sys.executable, "navigator.py"], identity)
        ground.wait_program("navigator", timeout_s=120.0)

A program gets the environment that its pod would have (FRACTUS_*), so programs on the SDK run unchanged. All processes
end with the block, whatever happens in it.

The directory that is left:
    pki/           keys and certificates (fractus_cli.standalone)
    logs/          NAME.log of each process, DRONE.tlog of each autopilot link, both directions
    DRONE/         grants/, state/, pictures/, node.yaml, mobility.jsonl and camera.jsonl (audit logs)
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import yaml
from fractus_cli.standalone import StandalonePki
from fractus_cluster.ports import free_port
from fractus_core.api import API_VERSION, Drone, Grant
from fractus_core.api.names import address_variable

from fractus_sim.experiment.errors import ExperimentError
from fractus_sim.experiment.linktap import LinkTap
from fractus_sim.experiment.processes import Processes, listening

START_TIMEOUT_S = 30.0
LOOPBACK = "127.0.0.1"
_CAMERA_METHODS = ("CaptureImage", "RetrieveImage", "ListImages", "DeleteImage")
_MOBILITY_METHODS = (
    "Arm", "Disarm", "Takeoff", "Land", "Goto", "Hover", "SetSpeed", "GetSpeed", "SetVelocity", "GetPosition",
    "ReturnToLaunch",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class CameraSetup:
    """A camera on a drone, looking at a camera world of its own.

    Attributes:
        world: further arguments of `fractus camera-world`, such as `("--seed", "7")`; None: no world, the driver's test
            picture.
        features: what the drone's description says of the camera, over `resolution` and `methods`.
    """

    world: Sequence[str] | None = ()
    features: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DroneSetup:
    """One drone.

    Attributes:
        name: of the node.
        home: latitude and longitude in degrees, ground height in metres above mean sea level.
        parameters: of the autopilot, by ArduPilot's names.
        description: spec of its Drone manifest; connections are filled in here.
        camera: None: neither camera world nor camera service.
        vehicle_arguments: further arguments of `fractus-vehicle`, such as `("--wind", "4,270,1")`.
        service_arguments: further arguments of `fractus mobility serve`.
        autopilot: `tcp:HOST:PORT` of one that runs already; None: a simulated one is started.
    """

    name: str
    home: tuple[float, float, float]
    heading_deg: float = 0.0
    system_id: int = 1
    seed: int = 1
    speedup: float = 1.0
    ready_after_s: float = 3.0
    parameters: Mapping[str, float] = field(default_factory=dict)
    description: Mapping[str, Any] = field(default_factory=dict)
    camera: CameraSetup | None = None
    vehicle_arguments: Sequence[str] = ()
    service_arguments: Sequence[str] = ()
    autopilot: str | None = None


class RunningDrone:
    """A drone that was brought up.

    Attributes:
        station_link: the vehicle's link for a ground station of ours, such as `tcp:127.0.0.1:21235`.
        guest_link: another one, for QGroundControl, Mission Planner or MAVProxy.
        mobility_address: host:port of its mobility service.
        camera_address: host:port of its camera service, if it has one.
        world_url: of its camera world, if it has one.
        grants: directory of its Grants.
        audit: audit log of the mobility service; the camera's is `camera.jsonl` beside it.
        tlog: what passed between service and autopilot.
    """

    def __init__(self, ground: Standalone, setup: DroneSetup, processes: Processes, logs: Path) -> None:
        self.setup = setup
        self.folder = ground.folder / setup.name
        self.grants = self.folder / "grants"
        self.audit = self.folder / "mobility.jsonl"
        self.tlog = logs / f"{setup.name}.tlog"
        self._processes = processes
        self._tls = ground.pki.node(setup.name)
        self._vehicle_port, station, guest = free_port(), free_port(), free_port()
        self._tap_port, self._mobility_port = free_port(), free_port()
        self._camera_port = free_port() if setup.camera is not None else None
        self._world_port = free_port() if setup.camera is not None and setup.camera.world is not None else None
        self.station_link, self.guest_link = f"tcp:{LOOPBACK}:{station}", f"tcp:{LOOPBACK}:{guest}"
        self.mobility_address = f"{LOOPBACK}:{self._mobility_port}"
        self.camera_address = f"{LOOPBACK}:{self._camera_port}" if self._camera_port else None
        self.world_url = f"http://{LOOPBACK}:{self._world_port}" if self._world_port else None
        self._tap: LinkTap | None = None

    @property
    def name(self) -> str:
        """Its node's name."""
        return self.setup.name

    def process(self, role: str) -> str:
        """Name of its process of a role: vehicle, world, mobility or camera."""
        return f"{self.name}-{role}"

    def start(self) -> None:
        """Bring it up and wait until its services listen.

        Raises:
            ExperimentError: a process did not come up.
        """
        for folder in (self.grants, self.folder / "state"):
            folder.mkdir(parents=True, exist_ok=True)
        self._describe()
        if self.setup.autopilot is None:
            self._processes.start(self.process("vehicle"), self._vehicle_command(), _environment())
            self._await("vehicle", self._vehicle_port)
        self._tap = LinkTap.between(self._tap_port, self._autopilot(), self.tlog)
        if self._world_port is not None:
            self._processes.start(self.process("world"), self._world_command(), _environment())
            self._await("world", self._world_port)
        self.power_on()

    def power_on(self, *, wait: bool = True) -> None:
        """Start its companion computer: mobility service and camera service.

        Args:
            wait: return when they listen.

        Raises:
            ExperimentError: one did not come up.
        """
        self._processes.start(self.process("mobility"), self._mobility_command(), _environment())
        if self._camera_port is not None:
            self._processes.start(self.process("camera"), self._camera_command(), _environment())
        if wait:
            self._await("mobility", self._mobility_port)
        if wait and self._camera_port is not None:
            self._await("camera", self._camera_port)

    def power_off(self) -> None:
        """Pull the power of its companion computer: its services die at once, the vehicle flies on."""
        self._processes.stop(self.process("mobility"), self.process("camera"), kill=True)

    def cut_link(self) -> None:
        """Cut the wire between companion computer and autopilot."""
        if self._tap is not None:
            self._tap.cut()

    def heal_link(self) -> None:
        """Mend it."""
        if self._tap is not None:
            self._tap.heal()

    def close(self) -> None:
        """Close what is left when its processes have ended."""
        if self._tap is not None:
            self._tap.close()

    def _await(self, role: str, port: int) -> None:
        self._processes.wait(self.process(role), lambda: listening(port), START_TIMEOUT_S)

    def _describe(self) -> None:
        spec: dict[str, Any] = json.loads(json.dumps(dict(self.setup.description)))
        services = spec.setdefault("services", {})
        mobility = services.setdefault("mobility", {})
        mobility.setdefault("maxAltitude", 120)
        mobility.setdefault("maxSpeed", 15)
        mobility.setdefault("maxFlightTime", 15)
        mobility.setdefault("methods", list(_MOBILITY_METHODS))
        mobility["connection"] = f"tcp:{LOOPBACK}:{self._tap_port}"
        if self.setup.camera is not None:
            camera = services.setdefault("camera", {})
            camera.setdefault("methods", list(_CAMERA_METHODS))
            # The camera world's own, unless it is told otherwise.
            camera.setdefault("horizontalFieldOfView", 62.2)
            camera.setdefault("mount", {"pitch": -90, "stabilised": True})
            camera.update(self.setup.camera.features)
            if self.world_url is not None:
                camera["connection"] = f"{self.world_url}/snapshot.jpg"
        manifest = {"apiVersion": API_VERSION, "kind": "Drone", "metadata": {"name": self.name}, "spec": spec}
        Drone.from_body(manifest)
        (self.folder / "node.yaml").write_text(yaml.safe_dump(manifest, sort_keys=False))

    def _autopilot(self) -> tuple[str, int]:
        if self.setup.autopilot is None:
            return LOOPBACK, self._vehicle_port
        host, _, port = self.setup.autopilot.removeprefix("tcp:").rpartition(":")
        return host, int(port)

    def _vehicle_command(self) -> list[str]:
        setup = self.setup
        command = [
            *_module("fractus_vehicle"),
            "--listen", f"tcp:{LOOPBACK}:{self._vehicle_port}", "--listen", self.station_link,
            "--listen", self.guest_link,
            "--home", ",".join(f"{value:.7f}" for value in setup.home), "--heading", f"{setup.heading_deg:g}",
            "--sysid", str(setup.system_id), "--seed", str(setup.seed), "--speedup", f"{setup.speedup:g}",
            "--ready-after", f"{setup.ready_after_s:g}",
        ]  # fmt: skip
        for name, value in setup.parameters.items():
            command += ["--param", f"{name}={value:.9g}"]
        return [*command, *setup.vehicle_arguments]

    def _world_command(self) -> list[str]:
        camera = self.setup.camera
        further = camera.world or () if camera is not None else ()
        lat, lon, alt = self.setup.home
        return [
            *_module("fractus_world"), "--vehicle", self.station_link, "--listen", f"{LOOPBACK}:{self._world_port}",
            "--origin", f"{lat:.7f},{lon:.7f}", "--ground", f"{alt:g}", *further,
        ]  # fmt: skip

    def _mobility_command(self) -> list[str]:
        return [
            *_module("fractus_services.mobility"), "serve", "--grants", str(self.grants), "--tls", str(self._tls),
            "--state", str(self.folder / "state"), "--audit", str(self.audit), "--node", self.name,
            "--autopilot", f"tcp:{LOOPBACK}:{self._tap_port}", "--listen", self.mobility_address,
            "--description", str(self.folder / "node.yaml"), *self.setup.service_arguments,
        ]  # fmt: skip

    def _camera_command(self) -> list[str]:
        return [
            *_module("fractus_services.camera"), "serve", "--grants", str(self.grants), "--tls", str(self._tls),
            "--state", str(self.folder / "pictures"), "--audit", str(self.folder / "camera.jsonl"), "--node", self.name,
            "--description", str(self.folder / "node.yaml"), "--mobility", self.mobility_address,
            "--listen", f"{LOOPBACK}:{self._camera_port}",
        ]  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Program:
    """A program as it was started, to be started again when its node gets its power back."""

    node: str
    command: tuple[str, ...]
    environment: Mapping[str, str]
    folder: Path | None


class Standalone:
    """Drones, their services, and programs that use them, in one directory; a context manager."""

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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def add_drone(self, setup: DroneSetup) -> RunningDrone:
        """Bring a drone up; returns when its services listen (its autopilot may not be ready to arm yet).

        Raises:
            ExperimentError: a process did not come up, or the name is taken.
            InvalidObject: its description is no Drone's.
        """
        if setup.name in self.drones:
            raise ExperimentError(f"there are two drones {setup.name}; give each its own name")
        logs = self.folder / "logs"
        logs.mkdir(exist_ok=True)
        drone = RunningDrone(self, setup, self.processes, logs)
        self.drones[setup.name] = drone
        drone.start()
        return drone

    def grant(self, manifest: Mapping[str, Any]) -> str:
        """Sign a Grant and put it where the services of its node find it; replaces the one of the same name.

        Args:
            manifest: of kind Grant; `fractus_core.policy.grants.compile_grants` makes the spec.

        Returns:
            The identity of the component instance that it is for.

        Raises:
            ExperimentError: its node is none of the drones here.
            InvalidObject: it is no Grant.
        """
        grant = Grant.from_body(manifest)
        drone = self._drone(grant.spec.node)
        self.pki.grant(dict(manifest), drone.grants)
        self._grants[grant.spec.identity] = grant
        return grant.spec.identity

    def revoke(self, identity: str) -> None:
        """Take the Grant of a component instance away.

        Raises:
            ExperimentError: it has none.
        """
        grant = self._granted(identity)
        (self._drone(grant.spec.node).grants / f"{grant.metadata.name}.json").unlink(missing_ok=True)

    def environment(self, identity: str, services: Mapping[str, str] | None = None) -> dict[str, str]:
        """The environment of a component's pod: who it is, where its services are, what it flies.

        Args:
            identity: as `grant` returned it.
            services: host:port of each component that it may call, by the component's name.

        Raises:
            ExperimentError: no Grant was given to it.
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
        return {**_environment(), **variables}

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
        """Start a program as a component instance; its output goes to `logs/NAME.log`.

        Args:
            name: of the program.
            command: the program and its arguments.
            identity: as `grant` returned it.
            environment: further variables.
            services: see `environment`.
            folder: its working directory.

        Raises:
            ExperimentError: it cannot be started, or no Grant was given to the identity.
        """
        variables = {**self.environment(identity, services), **(environment or {})}
        program = _Program(self._granted(identity).spec.node, tuple(command), variables, folder)
        self.processes.start(name, program.command, program.environment, program.folder)
        self._programs[name] = program

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
            name: of the program.
            command: the program and its arguments.
            environment: further variables.
            services: see `environment`.
            folder: its working directory.

        Raises:
            ExperimentError: it cannot be started.
        """
        variables = {address_variable(c): address for c, address in (services or {}).items()}
        variables |= {"FRACTUS_HOST_IP": LOOPBACK, "FRACTUS_INSTANCE": name}
        program = _Program("", tuple(command), {**_environment(), **variables, **(environment or {})}, folder)
        self.processes.start(name, program.command, program.environment, program.folder)
        self._programs[name] = program

    def power_off(self, node: str) -> None:
        """Pull the power of a drone's companion computer: services and programs die at once, the vehicle flies on.

        Raises:
            ExperimentError: there is no such drone.
        """
        programs = [name for name, program in self._programs.items() if program.node == node]
        self._off[node] = tuple(name for name in programs if self.processes.running(name))
        self.processes.stop(*programs, kill=True)
        self._drone(node).power_off()

    def power_on(self, node: str, *, wait: bool = True) -> None:
        """Give the power back: services start again, and the programs that ran when it went.

        Args:
            node: the drone.
            wait: start the programs when services listen, rather than at once.

        Raises:
            ExperimentError: one did not come up.
        """
        drone = self._drone(node)
        drone.power_on(wait=wait)
        for name in self._off.pop(node, ()):
            program = self._programs[name]
            self.processes.start(name, program.command, program.environment, program.folder)

    def wait_program(self, name: str, timeout_s: float) -> int | None:
        """Wait for a program to end; its exit code, None when it runs on."""
        return self.processes.wait_end(name, timeout_s)

    def check(self) -> None:
        """Make sure that vehicles and services run.

        Raises:
            ExperimentError: one has ended; the message ends with its last words.
        """
        for name, code in self.processes.dead().items():
            if name not in self._programs and not any(name.startswith(f"{node}-") for node in self._off):
                raise ExperimentError(f"{name} ended with {code}: {self.processes.last_words(name)}")

    def stop_services(self) -> None:
        """End programs and services in good order, so that their logs are complete; vehicles go on."""
        self.processes.stop(*self._programs)
        for drone in self.drones.values():
            self.processes.stop(drone.process("camera"), drone.process("mobility"))

    def close(self) -> None:
        """End every process: programs first, then services, then vehicles."""
        with ExitStack() as links:
            for drone in self.drones.values():
                links.callback(drone.close)
            self.processes.stop_all(
                lambda name: name in self._programs, lambda name: not name.endswith(("-vehicle", "-world"))
            )

    def _drone(self, node: str) -> RunningDrone:
        if node not in self.drones:
            raise ExperimentError(f"there is no drone {node}; there are {', '.join(self.drones) or 'none'}")
        return self.drones[node]

    def _granted(self, identity: str) -> Grant:
        if identity not in self._grants:
            raise ExperimentError(f"{identity} has no Grant; call grant() first")
        return self._grants[identity]


def _module(name: str) -> list[str]:
    return [sys.executable, "-m", name]


def _environment() -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith("FRACTUS_")}
    return {**kept, "PYTHONUNBUFFERED": "1", "MALLOC_ARENA_MAX": "2"}
