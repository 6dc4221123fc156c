"""What stands beside a node and keeps its own power: the simulated vehicle of a drone, a simulated camera."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

from fractus_core.api.nodes import CameraMount, NodeServices

from fractus_cluster.errors import ClusterError
from fractus_cluster.spec import NodeSpec, Place, camera_address

CAMERA_LINKS = ("tcp:127.0.0.1:5762", "tcp:127.0.0.1:5763")
"""Where a camera follows its vehicle: a link of its own, the second if the first is the autopilot's."""


RADIO_LINK = "tcp:127.0.0.1:5765"
"""Where the radio follows a vehicle that carries a station."""


def hardware_commands(node: NodeSpec, origin: Place | None) -> dict[str, list[str]]:
    """Return the commands that run what stands beside a node, by the names of their logs.

    Args:
        node: The node.
        origin: The middle of the landscape of the cluster's cameras.

    Raises:
        ClusterError: Nothing says where its vehicle stands, or the simulator is not installed.
    """
    vehicle, camera = vehicle_command(node), camera_command(node, origin)
    found = {"vehicle": vehicle, "camera": camera}
    return {name: command for name, command in found.items() if command is not None}


def vehicle_command(node: NodeSpec) -> list[str] | None:
    """Return the command that runs a node's vehicle, or None when it has none.

    Raises:
        ClusterError: It has one, but nothing says where it stands, or the simulator is not installed.
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
    return [program("fractus-vehicle"), *links, "--home", f"{home.lat},{home.lon},{home.alt}", *arguments]


def camera_command(node: NodeSpec, origin: Place | None) -> list[str] | None:
    """Return the command that runs a node's camera, or None when it has none.

    Lens, resolution and mount are those that the node's description tells the camera service.

    Raises:
        ClusterError: The simulator is not installed.
    """
    camera, address = node.hardware.camera, camera_address(node.camera_url)
    if camera is None or address is None:
        return None
    services = NodeServices.model_validate(node.description["services"])
    features = services.camera
    if features is None:
        return None
    mount = features.mount or CameraMount(stabilised=True)
    host = f"[{address[0]}]" if ":" in address[0] else address[0]
    command = [program("fractus-camera-world"), "--listen", f"{host}:{address[1]}", "--seed", str(camera.seed)]
    middle = camera.origin or origin
    if middle is not None:
        command += ["--origin", f"{middle.lat},{middle.lon}"]
    command += ["--resolution", features.resolution, "--mount-pitch", str(mount.pitch), "--mount-yaw", str(mount.yaw)]
    command += ["--stabilised" if mount.stabilised or mount.gimbal else "--fixed-mount"]
    if features.horizontal_field_of_view is not None:
        command += ["--fov", str(features.horizontal_field_of_view)]
    place, vehicle = node.place(), node.vehicle()
    if vehicle is not None:
        command += ["--vehicle", _camera_link(vehicle[1])]
    elif place is not None:
        command += ["--pose", f"{place.lat},{place.lon},{mount.height or 0.0}"]
    return [*command, *camera.arguments]


def _camera_link(autopilot: str) -> str:
    return next(link for link in CAMERA_LINKS if link != autopilot)


def hardware_environment() -> dict[str, str]:
    """Return the environment of what stands beside a node."""
    return {
        "PATH": os.environ.get("PATH", "/usr/bin:/bin"),
        "HOME": "/root",
        "LANG": "C.UTF-8",
        "PYTHONUNBUFFERED": "1",
    }


def program(name: str) -> str:
    """Return the path of one of the simulators' programs.

    Raises:
        ClusterError: It is not installed.
    """
    beside = Path(sys.executable).with_name(name)
    found = str(beside) if os.access(beside, os.X_OK) else shutil.which(name)
    if found is None:
        raise ClusterError(f"{name} is not installed; install the package with its extra `sim`")
    return found
