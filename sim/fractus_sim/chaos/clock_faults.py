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
_SEEN_AT = Path("/var/lib/fractus") / _FOLDER
"""Path of the library in pods of agents and services."""


def chart_values() -> list[str]:
    """Return chart values that make agents and services load the library."""
    return [
        f"{service}.extraEnv[{at}].{key}={value}"
        for service in SERVICES
        for at, (name, path) in enumerate(loaded(_SEEN_AT, service).items())
        for key, value in (("name", name), ("value", path))
    ]


def loaded(folder: Path, service: str) -> dict[str, str]:
    """Return the environment of a process that loads the library from a folder with the clock of a service."""
    return {"LD_PRELOAD": str(folder / "clock.so"), "CLOCK_OFFSET": str(_offset(folder, service))}


def furnish(states: Iterable[Path]) -> None:
    """Install the library in the state directories of nodes, and reset all clock offsets.

    Raises:
        ClusterError: The library cannot be built.
    """
    for state in states:
        folder = state / _FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        making = folder / "clock.new"
        run(["gcc", "-shared", "-fPIC", "-O2", "-Wall", "-Werror", _SOURCE, "-o", making])
        making.replace(folder / "clock.so")
        for service in SERVICES:
            _offset(folder, service).touch()
            step(state, (service,), 0.0)


def can_step(state: Path) -> bool:
    """True if the services of a node load the library."""
    return all(_offset(state / _FOLDER, service).exists() for service in SERVICES)


def step(state: Path, services: Iterable[str], offset_s: float) -> None:
    """Set the clock offset of services of a node. The file is written in place, so this also works on a full disk."""
    for service in services:
        file = os.open(_offset(state / _FOLDER, service), os.O_WRONLY)
        try:
            os.pwrite(file, struct.pack("=q", round(offset_s * 1e9)), 0)
        finally:
            os.close(file)


def _offset(folder: Path, service: str) -> Path:
    return folder / f"{service}.offset"
