"""What the service carries out after an event, in the order given."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from fractus_core.control.values import ControlEvent, SystemTask


class StopKind(Enum):
    """What the caller of a stopped motion can do about it.

    ABORTED: the motion itself was wrong, or another took its place. LOST: the caller does not have the vehicle any more.
    PASSING: the same may work in a moment.
    """

    ABORTED = "aborted"
    LOST = "lost"
    PASSING = "passing"


@dataclass(frozen=True, slots=True)
class StopMotion:
    """End a motion; its caller is told why."""

    motion_id: int
    kind: StopKind
    code: str
    reason: str
    policies: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SendEvent:
    """Tell a stream."""

    lease_id: int
    event: ControlEvent


@dataclass(frozen=True, slots=True)
class EndStream:
    """End a stream without an event."""

    lease_id: int


@dataclass(frozen=True, slots=True)
class RefuseStream:
    """A stream that was opened gets neither the vehicle nor a place to wait for it."""

    lease_id: int
    code: str
    reason: str


@dataclass(frozen=True, slots=True)
class StartSystemTask:
    """Hover, return or land, until done or stopped."""

    task: SystemTask


@dataclass(frozen=True, slots=True)
class StopSystemTask:
    """Cancel a system task, unless it is the one that asked."""

    task_id: int


@dataclass(frozen=True, slots=True)
class Brake:
    """Brake until the vehicle stands; authority stays where it is."""


@dataclass(frozen=True, slots=True)
class HoldPosition:
    """Hover for the driver, unless something else begins before."""


@dataclass(frozen=True, slots=True)
class RecordAudit:
    """Write a change of control down.

    Attributes:
        kind: control, or takeover where the vehicle is taken from who had it.
        action: what happens.
        controller: who commands.
    """

    kind: str
    action: str
    controller: str
    reason: str
    code: str = ""
    policies: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SaveJournal:
    """Write the missions to disk."""


@dataclass(frozen=True, slots=True)
class WakeWaiters:
    """Let everyone that waits for the vehicle look again."""


@dataclass(frozen=True, slots=True)
class SetStreamRates:
    """Ask the autopilot for its telemetry at the rates of a flying vehicle, or of one that stands."""

    flying: bool


Action = (
    StopMotion | SendEvent | EndStream | RefuseStream | StartSystemTask | StopSystemTask | Brake | HoldPosition
    | RecordAudit | SaveJournal | WakeWaiters | SetStreamRates
)  # fmt: skip
"""Everything that control asks for."""
