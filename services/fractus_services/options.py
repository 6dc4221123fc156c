"""What the command lines of the services say; node, autopilot and camera default to the node's description."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


class CannotServe(Exception):
    """A service cannot run as it is told to; the message names what is wrong and the remedy."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceOptions:
    """Options of both services."""

    grants: Path
    tls: Path
    state: Path
    audit: Path
    node: str | None
    node_object: Path
    description: Path
    listen: str
    lock_timeout: float
    recordings: Path | None
    recordings_mb: int
    metrics: str

    @property
    def grant_memory(self) -> Path:
        """File that remembers which grants were seen."""
        return self.state / "grants-seen.json"

    @property
    def recording_problem(self) -> Path:
        """File that says why nothing is recorded, while that is so; the node's agent reads it."""
        return self.state / "recording.problem"


@dataclass(frozen=True, slots=True, kw_only=True)
class MobilityOptions(ServiceOptions):
    """Options of `fractus mobility serve`."""

    autopilot: str | None
    driver_grace: float
    boarding: float
    flat_terrain: bool
