"""Clocks of a node's services that can be stepped, though a machine has one for all: a library that they load adds to it."""

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
"""Where pods of agents and services find it."""


def chart_values() -> list[str]:
    """Values of the chart by which agents and services load the library."""
    return [
        f"{service}.extraEnv[{at}].{key}={value}"
        for service in SERVICES
        for at, (name, path) in enumerate(loaded(_SEEN_AT, service).items())
        for key, value in (("name", name), ("value", path))
    ]


def loaded(folder: Path, service: str) -> dict[str, str]:
    """The environment of a process that loads the library in a folder, and goes by the clock of a service."""
    return {"LD_PRELOAD": str(folder / "clock.so"), "CLOCK_OFFSET": str(_offset(folder, service))}


def furnish(states: Iterable[Path]) -> None:
    """Put the library in the state directories of nodes, whose clocks then go right, also after a run that was broken off.

    Raises:
        ClusterError: it cannot be built.
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
    """Whether the services of a node load the library."""
    return all(_offset(state / _FOLDER, service).exists() for service in SERVICES)


def step(state: Path, services: Iterable[str], offset_s: float) -> None:
    """Set the clocks of some services of a node ahead of the machine's, in place: that also works on a full disk."""
    for service in services:
        file = os.open(_offset(state / _FOLDER, service), os.O_WRONLY)
        try:
            os.pwrite(file, struct.pack("=q", round(offset_s * 1e9)), 0)
        finally:
            os.close(file)


def _offset(folder: Path, service: str) -> Path:
    return folder / f"{service}.offset"
