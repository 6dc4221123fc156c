"""Command-line options of the services. Node, autopilot and camera default to the node description."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol


class CannotServe(Exception):
    """A service cannot run with its options. The message contains the problem and the remedy."""


class LockedOptions(Protocol):
    """Options of a process that holds the lock of its state directory and audit log."""

    @property
    def state(self) -> Path:
        """State directory."""

    @property
    def audit(self) -> Path:
        """Audit log."""

    @property
    def lock_timeout(self) -> float:
        """Seconds to wait for another process that holds the lock."""


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
        """File with the latest Grant of each component instance."""
        return self.state / "grants-seen.json"

    @property
    def recording_problem(self) -> Path:
        """File with the reason why recording fails. It exists only while recording fails. The agent reads it."""
        return self.state / "recording.problem"


@dataclass(frozen=True, slots=True, kw_only=True)
class MobilityOptions(ServiceOptions):
    """Options of `fractus mobility serve`."""

    autopilot: str | None
    driver_grace: float
    boarding: float
    flat_terrain: bool
    gateway_socket: Path | None = None
    gateway_user: int | None = None
