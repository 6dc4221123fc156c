"""Drones without Kubernetes: vehicle, mobility service, camera world and camera service as local processes.

    with Standalone(Path("out/field")) as drones:
        drone = drones.add_drone(DroneSetup("drone-1", home=(50.8637, 4.6785, 25.0), camera=CameraSetup()))
        identity = drones.grant(manifest)      # sign a Grant and store it for the services
        drones.run("navigator", [sys.executable, "navigator.py"], identity)
        drones.processes.wait_end("navigator", timeout_s=120.0)

Each program gets the environment variables that a pod would have (FRACTUS_*), so programs that use the SDK run
unchanged. All processes are stopped at the end of the block.

Files in the directory:

    pki/       keys and certificates (fractus_cli.standalone)
    logs/      NAME.log of each process, DRONE.tlog of each autopilot link in both directions
    DRONE/     grants/, state/, pictures/, node.yaml, mobility.jsonl and camera.jsonl (audit logs)
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import yaml
from fractus_cli.standalone import StandalonePki
from fractus_cluster.ports import free_port
from fractus_core.api import API_VERSION, Drone, Grant
from fractus_core.api.names import address_variable

from fractus_sim.errors import ExperimentError
from fractus_sim.testbeds.link_tap import LinkTap
from fractus_sim.testbeds.local_processes import Processes, listening


@dataclass(frozen=True, slots=True)
class _Program:
    """Start command of a program. It is kept to start the program again when its node is powered on."""

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

    def revoke(self, node: str) -> None:
        """Remove all Grants of a drone. The system takes the drone and brings it home.

        Raises:
            ExperimentError: The drone is unknown.
        """
        for file in self._drone(node).grants.glob("*.json"):
            file.unlink()

    def node_of_identity(self, identity: str) -> str:
        """Return the drone of a component instance.

        Raises:
            ExperimentError: The identity has no Grant.
        """
        return self._grant_of(identity).spec.node

    def environment(self, identity: str) -> dict[str, str]:
        """Return the FRACTUS_* variables of a component's pod: identity, service addresses and control points.

        Args:
            identity: Identity returned by `grant`.

        Raises:
            ExperimentError: The identity has no Grant.
        """
        spec = self._grant_of(identity).spec
        drone = self._drone(spec.node)
        variables = {
            "FRACTUS_NODE": spec.node,
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
        return variables

    def run(
        self,
        name: str,
        command: Sequence[str],
        identity: str | None = None,
        *,
        environment: Mapping[str, str] | None = None,
        services: Mapping[str, str] | None = None,
        folder: Path | None = None,
        namespace: Path | None = None,
    ) -> None:
        """Start a program. Its output is written to `logs/NAME.log`.

        If its Grant permits MAVLink, the variable FRACTUS_VEHICLE contains the MAVLink connection of the gateway.

        Args:
            name: Name of the program.
            command: Program and arguments.
            identity: Identity returned by `grant`. None for a program that uses no system service, such as a component in
                the cloud.
            environment: Additional environment variables.
            services: host:port of each component that the program may call, by component name.
            folder: Working directory.
            namespace: Network namespace of the program. None: that of this process.

        Raises:
            ExperimentError: The program cannot be started, or the identity has no Grant.
        """
        variables = {**base_environment(), "FRACTUS_HOST_IP": LOOPBACK}
        node = ""
        if identity is None:
            variables["FRACTUS_INSTANCE"] = name
        else:
            variables |= self.environment(identity)
            node = self._grant_of(identity).spec.node
            variables |= self._connect_gateway(name, identity, node, namespace)
        for component, address in (services or {}).items():
            variables[address_variable(component)] = address
        variables |= environment or {}
        self._start(name, _Program(node, tuple(within(namespace, command)), variables, folder))

    def _connect_gateway(self, name: str, identity: str, node: str, namespace: Path | None) -> dict[str, str]:
        """Connect a program to the gateway of its drone. Return variables with the MAVLink connection, if it may use one."""
        gateway = self._drone(node).gateway_address
        if gateway is None or "mavlink" not in self._grant_of(identity).spec.interfaces("mobility"):
            return {}
        port = free_port()
        command = [
            *_module("fractus_cli"), "gateway", "connect", "--gateway", gateway, "--node", node,
            "--tls", str(self.pki.component(identity)), "--tcp", str(port), "--udp", str(free_port()),
        ]  # fmt: skip
        sidecar = f"{name}-sidecar"
        self._start(sidecar, _Program(node, tuple(within(namespace, command)), base_environment(), None))
        # A connection attempt would look like a program, so the log is read instead.
        log = self.processes.log(sidecar)
        self.processes.wait(sidecar, lambda: b"waiting for MAVLink programs" in log.read_bytes(), START_TIMEOUT_S)
        return {"FRACTUS_VEHICLE": f"tcp:{LOOPBACK}:{port}"}

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
            wait: Start the programs only after the services listen. False: start them immediately.

        Raises:
            ExperimentError: A process did not start.
        """
        drone = self._drone(node)
        drone.power_on(wait=wait)
        for name in self._off.pop(node, ()):
            self._start(name, self._programs[name])

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
            self.processes.stop(*drone.service_processes)

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

    def _grant_of(self, identity: str) -> Grant:
        if identity not in self._grants:
            raise ExperimentError(f"{identity} has no Grant; call grant() first")
        return self._grants[identity]


START_TIMEOUT_S = 30.0
MOBILITY_STOP_TIMEOUT_S = 40.0
"""Time for which a stopped mobility service may restore the fence and the parameters of the vehicle's owner, as in the chart."""

LOOPBACK = "127.0.0.1"
GATEWAY_SOCKET = "gateway.sock"
"""Unix socket between mobility service and gateway, relative to their working directory because its path must be short."""

_CAMERA_METHODS = ("CaptureImage", "RetrieveImage", "ListImages", "DeleteImage")
_MOBILITY_METHODS = (
    "Arm", "Disarm", "Takeoff", "Land", "Goto", "Hover", "SetSpeed", "GetSpeed", "SetVelocity", "GetPosition",
    "ReturnToLaunch",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class CameraSetup:
    """A camera of a drone, with its own camera world.

    Attributes:
        world: Additional arguments of `fractus camera-world`, such as `("--seed", "7")`. None: no camera world. The
            camera service then uses its test picture.
        features: Camera fields of the drone description, in addition to `resolution` and `methods`.
    """

    world: Sequence[str] | None = ()
    features: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DroneSetup:
    """Configuration of one drone.

    Attributes:
        name: Name of the node.
        home: Latitude and longitude in degrees, ground height in metres above mean sea level.
        parameters: Autopilot parameters by ArduPilot name.
        description: Spec of the Drone manifest. Connections are added automatically.
        camera: Camera configuration. None: neither camera world nor camera service.
        vehicle_arguments: Additional arguments of `fractus-vehicle`, such as `("--wind", "4,270,1")`.
        service_arguments: Additional arguments of `fractus mobility serve`.
        autopilot: `tcp:HOST:PORT` of a running autopilot. None: a simulated autopilot is started.
        state: State directory of the mobility service. None: a directory in the directory of the drone. For a running autopilot,
            use a directory that outlives the drone, because it contains the values of the vehicle's owner until they are restored.
        service_host: Address of this machine at which the services listen.
        gateway: Start the gateway for programs that speak MAVLink.
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
    state: Path | None = None
    service_host: str = LOOPBACK
    gateway: bool = False


class RunningDrone:
    """A running drone.

    Attributes:
        station_link: MAVLink endpoint for the ground station of the experiment, such as `tcp:127.0.0.1:21235`.
        guest_link: MAVLink endpoint for QGroundControl, Mission Planner or MAVProxy.
        mobility_address: host:port of the mobility service.
        camera_address: host:port of the camera service, or None.
        gateway_address: host:port of the gateway for programs that speak MAVLink, or None.
        world_url: URL of the camera world, or None.
        grants: Directory of the Grants.
        audit: Audit log of the mobility service. The camera service writes `camera.jsonl` in the same directory.
        tlog: Traffic between mobility service and autopilot.
    """

    def __init__(self, setup: DroneSetup, folder: Path, tls: Path, processes: Processes) -> None:
        self.setup = setup
        self.folder = folder / setup.name
        self.grants = self.folder / "grants"
        self.audit = self.folder / "mobility.jsonl"
        self._state = (setup.state or self.folder / "state").absolute()
        self.tlog = folder / "logs" / f"{setup.name}.tlog"
        self._processes = processes
        self._tls = tls
        self._vehicle_port = free_port()
        station = free_port()
        guest = free_port()
        self._tap_port = free_port()
        self._mobility_port = free_port()
        self._camera_port = free_port() if setup.camera is not None else None
        self.gateway_address = f"{setup.service_host}:{free_port()}" if setup.gateway else None
        self._world_port = free_port() if setup.camera is not None and setup.camera.world is not None else None
        self.station_link = setup.autopilot or f"tcp:{LOOPBACK}:{station}"
        self.guest_link = setup.autopilot or f"tcp:{LOOPBACK}:{guest}"
        self.mobility_address = f"{setup.service_host}:{self._mobility_port}"
        self.camera_address = f"{setup.service_host}:{self._camera_port}" if self._camera_port else None
        self.world_url = f"http://{LOOPBACK}:{self._world_port}" if self._world_port else None
        self._tap: LinkTap | None = None

    @property
    def name(self) -> str:
        """Name of the node."""
        return self.setup.name

    def process(self, role: str) -> str:
        """Return the process name of a role: vehicle, world, mobility or camera."""
        return f"{self.name}-{role}"

    def start(self) -> None:
        """Start the drone and wait until its services listen.

        Raises:
            ExperimentError: A process did not start.
        """
        for folder in (self.grants, self._state):
            folder.mkdir(parents=True, exist_ok=True)
        self._write_description()
        if self.setup.autopilot is None:
            self._processes.start(self.process("vehicle"), self._vehicle_command(), base_environment())
            self._wait_listening("vehicle", self._vehicle_port)
        self._tap = LinkTap.between(self._tap_port, self._autopilot_address(), self.tlog)
        if self._world_port is not None:
            self._processes.start(self.process("world"), self._world_command(), base_environment())
            self._wait_listening("world", self._world_port)
        self.power_on()

    def power_on(self, *, wait: bool = True) -> None:
        """Start the mobility and camera services of the companion computer.

        Args:
            wait: Wait until the services listen.

        Raises:
            ExperimentError: A service did not start.
        """
        self._processes.start(
            self.process("mobility"),
            self._mobility_command(),
            base_environment(),
            self.folder,
            stop_timeout_s=MOBILITY_STOP_TIMEOUT_S,
        )
        if self._camera_port is not None:
            self._processes.start(self.process("camera"), self._camera_command(), base_environment())
        if self.gateway_address is not None:
            self._processes.start(self.process("gateway"), self._gateway_command(), base_environment(), self.folder)
        if wait:
            self._wait_listening("mobility", self._mobility_port, self.setup.service_host)
        if wait and self._camera_port is not None:
            self._wait_listening("camera", self._camera_port, self.setup.service_host)

    def power_off(self) -> None:
        """Kill the services of the companion computer. The vehicle keeps flying."""
        self._processes.stop(*self.service_processes, kill=True)

    def set_link(self, *, connected: bool) -> None:
        """Cut or restore the link between companion computer and autopilot."""
        if self._tap is not None:
            self._tap.set_link(connected=connected)

    @property
    def service_processes(self) -> tuple[str, ...]:
        """Names of the processes of the services, in the order in which they are stopped."""
        return tuple(self.process(role) for role in ("gateway", "camera", "mobility"))

    @property
    def autopilot_bytes(self) -> int:
        """Bytes of MAVLink that the autopilot sent to the services."""
        return self._tap.received_bytes if self._tap is not None else 0

    def close(self) -> None:
        """Close the link tap after the processes have ended."""
        if self._tap is not None:
            self._tap.close()

    def _wait_listening(self, role: str, port: int, host: str = LOOPBACK) -> None:
        self._processes.wait(self.process(role), lambda: listening(port, host), START_TIMEOUT_S)

    def _write_description(self) -> None:
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
            # These values are the defaults of the camera world.
            camera.setdefault("horizontalFieldOfView", 62.2)
            camera.setdefault("lens", {"model": "pinhole"})
            camera.setdefault("mount", {"pitch": -90, "stabilised": True})
            camera.update(self.setup.camera.features)
            if self.world_url is not None:
                camera["connection"] = f"{self.world_url}/snapshot.jpg"
        manifest = {"apiVersion": API_VERSION, "kind": "Drone", "metadata": {"name": self.name}, "spec": spec}
        Drone.from_body(manifest)
        (self.folder / "node.yaml").write_text(yaml.safe_dump(manifest, sort_keys=False))

    def _autopilot_address(self) -> tuple[str, int]:
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
            "--ready-after", f"{setup.ready_after_s:g}", "--throttle", "1500",
        ]  # fmt: skip
        for name, value in setup.parameters.items():
            command += ["--param", f"{name}={value:.9g}"]
        return [*command, *setup.vehicle_arguments]

    def _world_command(self) -> list[str]:
        camera = self.setup.camera
        arguments = (camera.world or ()) if camera is not None else ()
        lat, lon, alt = self.setup.home
        return [
            *_module("fractus_world"), "--vehicle", self.station_link, "--listen", f"{LOOPBACK}:{self._world_port}",
            "--origin", f"{lat:.7f},{lon:.7f}", "--ground", f"{alt:g}", *arguments,
        ]  # fmt: skip

    def _mobility_command(self) -> list[str]:
        gateway = ["--gateway-socket", GATEWAY_SOCKET] if self.setup.gateway else []
        return [
            *_module("fractus_services.mobility"), "serve", "--grants", str(self.grants), "--tls", str(self._tls),
            "--state", str(self._state), "--audit", str(self.audit), "--node", self.name,
            "--autopilot", f"tcp:{LOOPBACK}:{self._tap_port}", "--listen", self.mobility_address,
            "--description", str(self.folder / "node.yaml"), *gateway, *self.setup.service_arguments,
        ]  # fmt: skip

    def _gateway_command(self) -> list[str]:
        return [
            *_module("fractus_cli"), "gateway", "serve", "--tls", str(self._tls),
            "--mobility-socket", GATEWAY_SOCKET, "--listen", str(self.gateway_address),
            "--state", str(self.folder / "gateway"), "--audit", str(self.folder / "gateway.jsonl"),
        ]  # fmt: skip

    def _camera_command(self) -> list[str]:
        return [
            *_module("fractus_services.camera"), "serve", "--grants", str(self.grants), "--tls", str(self._tls),
            "--state", str(self.folder / "pictures"), "--audit", str(self.folder / "camera.jsonl"), "--node", self.name,
            "--description", str(self.folder / "node.yaml"), "--mobility", self.mobility_address,
            "--listen", f"{self.setup.service_host}:{self._camera_port}",
        ]  # fmt: skip


def _module(name: str) -> list[str]:
    return [sys.executable, "-m", name]


def within(namespace: Path | None, command: Sequence[str]) -> list[str]:
    """Return a command that runs a program in a network namespace."""
    return list(command) if namespace is None else ["nsenter", f"--net={namespace}", "--", *command]


def base_environment() -> dict[str, str]:
    """Return the environment of the current process without FRACTUS_* variables."""
    variables = {name: value for name, value in os.environ.items() if not name.startswith("FRACTUS_")}
    return {**variables, "PYTHONUNBUFFERED": "1", "MALLOC_ARENA_MAX": "2"}
