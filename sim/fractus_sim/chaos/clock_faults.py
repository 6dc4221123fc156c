"""Clock faults: a preloaded library adds an offset to the clock of single services of a node."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable
from pathlib import Path

from fractus_cluster.commands import run

SERVICES = ("agent", "mobility", "camera")
_FOLDER = "chaos"
_SOURCE = Path(__file__).with_name("clock.c")
_POD_FOLDER = Path("/var/lib/fractus") / _FOLDER
"""Folder of the library and the offset files in pods of agents and services."""


def chart_values() -> list[str]:
    """Return chart values that make agents and services load the library."""
    return [
        f"{service}.extraEnv[{index}].{key}={value}"
        for service in SERVICES
        for index, (name, path) in enumerate(library_environment(_POD_FOLDER, service).items())
        for key, value in (("name", name), ("value", path))
    ]


def library_environment(folder: Path, service: str) -> dict[str, str]:
    """Return the environment of a process that loads the library and uses the clock offset of a service.

    Args:
        folder: Folder of the library and the offset files.
        service: Name of the service.
    """
    return {"LD_PRELOAD": str(folder / "clock.so"), "CLOCK_OFFSET": str(_offset_file(folder, service))}


def install_library(states: Iterable[Path]) -> None:
    """Install the library in the state directories of nodes, and reset all clock offsets.

    Raises:
        ClusterError: The library cannot be built.
    """
    for state in states:
        folder = state / _FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        scratch = folder / "clock.new"
        run(["gcc", "-shared", "-fPIC", "-O2", "-Wall", "-Werror", _SOURCE, "-o", scratch])
        scratch.replace(folder / "clock.so")
        for service in SERVICES:
            _offset_file(folder, service).touch()
            set_offset(state, (service,), 0.0)


def can_step(state: Path) -> bool:
    """Return True if the library is installed on a node."""
    return all(_offset_file(state / _FOLDER, service).exists() for service in SERVICES)


def set_offset(state: Path, services: Iterable[str], offset_s: float) -> None:
    """Set the clock offset of services of a node. The file is written in place, so this also works on a full disk."""
    for service in services:
        file = os.open(_offset_file(state / _FOLDER, service), os.O_WRONLY)
        try:
            os.pwrite(file, struct.pack("=q", round(offset_s * 1e9)), 0)
        finally:
            os.close(file)


def _offset_file(folder: Path, service: str) -> Path:
    return folder / f"{service}.offset"
