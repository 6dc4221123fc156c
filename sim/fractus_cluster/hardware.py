"""Simulated hardware of a node that has its own power: the vehicle of a drone, and a camera."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

from fractus_core.api.nodes import CameraMount, NodeServices

from fractus_cluster.errors import ClusterError
from fractus_cluster.spec import NodeSpec, Place, VehicleHardware, camera_address

CAMERA_LINKS = ("tcp:127.0.0.1:5762", "tcp:127.0.0.1:5763")
"""Possible MAVLink endpoints for the camera. The second is used if the first is the endpoint for the services."""

RADIO_LINK = "tcp:127.0.0.1:5765"
"""MAVLink endpoint of the vehicle for the simulated radio, if the node has a WiFi device."""


def hardware_commands(node: NodeSpec, origin: Place | None) -> dict[str, list[str]]:
    """Return the commands of a node's simulated hardware, by log name.

    Args:
        node: The node.
        origin: Centre of the landscape of the cluster's cameras.

    Raises:
        ClusterError: The position of the vehicle is not specified, or the simulator is not installed.
    """
    vehicle = vehicle_command(node)
    camera = camera_command(node, origin)
    commands = {"vehicle": vehicle, "camera": camera}
    return {name: command for name, command in commands.items() if command is not None}


def vehicle_command(node: NodeSpec) -> list[str] | None:
    """Return the command of a node's vehicle, or None without vehicle.

    Raises:
        ClusterError: The position of the vehicle is not specified, or the simulator is not installed.
    """
    vehicle = node.vehicle()
    if vehicle is None:
        return None
    home, listen, arguments = vehicle
    links = ["--listen", listen]
    if node.hardware.camera is not None:
        links += ["--listen", _camera_link(listen)]
    if node.hardware.wifi is not None:
        links += ["--listen", RADIO_LINK]
    charge = (node.hardware.vehicle or VehicleHardware()).charge
    place = f"{home.lat},{home.lon},{home.alt}"
    return [program("fractus-vehicle"), *links, "--home", place, "--charge", f"{charge:g}", *arguments]


def camera_command(node: NodeSpec, origin: Place | None) -> list[str] | None:
    """Return the command of a node's camera, or None without camera.

    Lens, resolution and mount are taken from the camera service in the node's description.

    Raises:
        ClusterError: The simulator is not installed.
    """
    camera = node.hardware.camera
    address = camera_address(node.camera_url)
    if camera is None or address is None:
        return None
    services = NodeServices.model_validate(node.description["services"])
    features = services.camera
    if features is None:
        return None
    mount = features.mount or CameraMount(stabilised=True)
    host = f"[{address[0]}]" if ":" in address[0] else address[0]
    command = [program("fractus-camera-world"), "--listen", f"{host}:{address[1]}", "--seed", str(camera.seed)]
    centre = camera.origin or origin
    if centre is not None:
        command += ["--origin", f"{centre.lat},{centre.lon}"]
    command += ["--resolution", features.resolution, "--mount-pitch", str(mount.pitch), "--mount-yaw", str(mount.yaw)]
    command += ["--stabilised" if mount.stabilised or mount.gimbal else "--fixed-mount"]
    if features.horizontal_field_of_view is not None:
        command += ["--fov", str(features.horizontal_field_of_view)]
    place = node.place()
    vehicle = node.vehicle()
    if vehicle is not None:
        command += ["--vehicle", _camera_link(vehicle[1])]
    elif place is not None:
        command += ["--pose", f"{place.lat},{place.lon},{mount.height or 0.0}"]
    return [*command, *camera.arguments]


def _camera_link(autopilot: str) -> str:
    return next(link for link in CAMERA_LINKS if link != autopilot)


def hardware_environment() -> dict[str, str]:
    """Return the environment of a node's simulated hardware."""
    return {
        "PATH": os.environ.get("PATH", "/usr/bin:/bin"),
        "HOME": "/root",
        "LANG": "C.UTF-8",
        "PYTHONUNBUFFERED": "1",
    }


def program(name: str) -> str:
    """Return the path of a simulator program.

    Raises:
        ClusterError: The program is not installed.
    """
    beside = Path(sys.executable).with_name(name)
    path = str(beside) if os.access(beside, os.X_OK) else shutil.which(name)
    if path is None:
        raise ClusterError(f"{name} is not installed; install the package fractus-sim")
    return path
