"""What stands beside a node and keeps its own power: the simulated vehicle of a drone."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

from fractus_sim.cluster.errors import ClusterError
from fractus_sim.cluster.spec import NodeSpec

_PROGRAM = "fractus-vehicle"


def vehicle_command(node: NodeSpec) -> list[str] | None:
    """Return the command that runs a node's vehicle, or None when it has none.

    Raises:
        ClusterError: It has one, but nothing says where it stands, or the simulator is not installed.
    """
    vehicle = node.vehicle()
    if vehicle is None:
        return None
    home, listen, arguments = vehicle
    return [_program(), "--listen", listen, "--home", f"{home.lat},{home.lon},{home.alt}", *arguments]


def vehicle_environment() -> dict[str, str]:
    """Return the environment of a vehicle."""
    return {
        "PATH": os.environ.get("PATH", "/usr/bin:/bin"),
        "HOME": "/root",
        "LANG": "C.UTF-8",
        "PYTHONUNBUFFERED": "1",
    }


def _program() -> str:
    beside = Path(sys.executable).with_name(_PROGRAM)
    found = str(beside) if os.access(beside, os.X_OK) else shutil.which(_PROGRAM)
    if found is None:
        raise ClusterError(
            f"{_PROGRAM} is not installed, so drones have no vehicle; install the package with its extra `sim`"
        )
    return found
