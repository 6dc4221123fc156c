"""Actions of the control state machine: the service carries them out after a transition, in order."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from fractus_core.control.state import ControlEvent, SystemTask


class StopKind(Enum):
    """Class of error that the caller of a stopped motion receives.

    ABORTED: the motion itself was wrong, or another motion replaced it. LOST: the caller no longer has control.
    PASSING: the same call may succeed in a moment.
    """

    ABORTED = "aborted"
    LOST = "lost"
    PASSING = "passing"


@dataclass(frozen=True, slots=True)
class StopMotion:
    """End a motion and report the reason to its caller."""

    motion_id: int
    kind: StopKind
    code: str
    reason: str
    policies: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SendEvent:
    """Send an event on a control stream."""

    lease_id: int
    event: ControlEvent


@dataclass(frozen=True, slots=True)
class EndStream:
    """End a control stream without an event."""

    lease_id: int


@dataclass(frozen=True, slots=True)
class RefuseStream:
    """Refuse a control stream that was opened: the driver may neither command the vehicle nor wait for control."""

    lease_id: int
    code: str
    reason: str


@dataclass(frozen=True, slots=True)
class StartSystemTask:
    """Start a system task: hover, return or land. The task runs until it is complete or stopped."""

    task: SystemTask


@dataclass(frozen=True, slots=True)
class StopSystemTask:
    """Cancel a system task, unless the task itself reported the event that stops it."""

    task_id: int


@dataclass(frozen=True, slots=True)
class Brake:
    """Brake until the vehicle is at rest. Control authority does not change."""


@dataclass(frozen=True, slots=True)
class HoldPosition:
    """Hover while the driver keeps control. A motion or system task that begins replaces the hover."""


@dataclass(frozen=True, slots=True)
class RecordAudit:
    """Write a change of control to the audit log.

    Attributes:
        kind: `control`, or `takeover` if the vehicle is taken from its controller.
        action: Action of the entry.
        controller: Party that has control authority after the change.
        reason: Reason in plain text.
        code: Code of the reason; empty if there is none.
        policies: Names of the policies that caused the change.
    """

    kind: str
    action: str
    controller: str
    reason: str
    code: str = ""
    policies: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SaveJournal:
    """Write the missions to the journal."""


@dataclass(frozen=True, slots=True)
class WakeWaiters:
    """Wake every task that waits for a change of control."""


@dataclass(frozen=True, slots=True)
class SetStreamRates:
    """Request telemetry at the rates for a flying vehicle or for a vehicle on the ground."""

    flying: bool


Action = (
    StopMotion | SendEvent | EndStream | RefuseStream | StartSystemTask | StopSystemTask | Brake | HoldPosition
    | RecordAudit | SaveJournal | WakeWaiters | SetStreamRates
)  # fmt: skip
"""Every action of the state machine."""
