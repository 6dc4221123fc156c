"""One drone without Kubernetes: vehicle, services and camera world as local processes."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from fractus_cluster.ports import free_port
from fractus_core.api import API_VERSION, Drone

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
    """A camera of a drone, with its own camera world.

    Attributes:
        world: Additional arguments of `fractus camera-world`, such as `("--seed", "7")`. None: no camera world, the
            driver's test picture.
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
    """A running drone.

    Attributes:
        station_link: MAVLink endpoint for the ground station of the experiment, such as `tcp:127.0.0.1:21235`.
        guest_link: MAVLink endpoint for QGroundControl, Mission Planner or MAVProxy.
        mobility_address: host:port of the mobility service.
        camera_address: host:port of the camera service, or None.
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
        self.tlog = folder / "logs" / f"{setup.name}.tlog"
        self._processes = processes
        self._tls = tls
        self._vehicle_port = free_port()
        station = free_port()
        guest = free_port()
        self._tap_port = free_port()
        self._mobility_port = free_port()
        self._camera_port = free_port() if setup.camera is not None else None
        self._world_port = free_port() if setup.camera is not None and setup.camera.world is not None else None
        self.station_link = f"tcp:{LOOPBACK}:{station}"
        self.guest_link = f"tcp:{LOOPBACK}:{guest}"
        self.mobility_address = f"{LOOPBACK}:{self._mobility_port}"
        self.camera_address = f"{LOOPBACK}:{self._camera_port}" if self._camera_port else None
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
        for folder in (self.grants, self.folder / "state"):
            folder.mkdir(parents=True, exist_ok=True)
        self._describe()
        if self.setup.autopilot is None:
            self._processes.start(self.process("vehicle"), self._vehicle_command(), base_environment())
            self._await("vehicle", self._vehicle_port)
        self._tap = LinkTap.between(self._tap_port, self._autopilot(), self.tlog)
        if self._world_port is not None:
            self._processes.start(self.process("world"), self._world_command(), base_environment())
            self._await("world", self._world_port)
        self.power_on()

    def power_on(self, *, wait: bool = True) -> None:
        """Start the mobility and camera services of the companion computer.

        Args:
            wait: Wait until the services listen.

        Raises:
            ExperimentError: A service did not start.
        """
        self._processes.start(self.process("mobility"), self._mobility_command(), base_environment())
        if self._camera_port is not None:
            self._processes.start(self.process("camera"), self._camera_command(), base_environment())
        if wait:
            self._await("mobility", self._mobility_port)
        if wait and self._camera_port is not None:
            self._await("camera", self._camera_port)

    def power_off(self) -> None:
        """Kill the services of the companion computer. The vehicle keeps flying."""
        self._processes.stop(self.process("mobility"), self.process("camera"), kill=True)

    def cut_link(self) -> None:
        """Cut the link between companion computer and autopilot."""
        if self._tap is not None:
            self._tap.cut()

    def heal_link(self) -> None:
        """Restore the link between companion computer and autopilot."""
        if self._tap is not None:
            self._tap.heal()

    def close(self) -> None:
        """Close the link tap after the processes have ended."""
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
            # Defaults of the camera world.
            camera.setdefault("horizontalFieldOfView", 62.2)
            camera.setdefault("lens", {"model": "pinhole"})
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
            "--ready-after", f"{setup.ready_after_s:g}", "--throttle", "1500",
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


def _module(name: str) -> list[str]:
    return [sys.executable, "-m", name]


def base_environment() -> dict[str, str]:
    """Return the environment of the current process without FRACTUS_* variables."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("FRACTUS_")}
    return {**kept, "PYTHONUNBUFFERED": "1", "MALLOC_ARENA_MAX": "2"}
