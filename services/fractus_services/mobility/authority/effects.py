"""Actions of the control state machine, and the leases, motions and system tasks that the state refers to by id."""

from __future__ import annotations

import asyncio
import itertools
import logging
import math
from collections.abc import Coroutine, Sequence
from dataclasses import dataclass, field
from typing import Any, assert_never

from fractus_core.control import Authority, ControlEvent, StreamState
from fractus_core.control.actions import (
    Action,
    Brake,
    EndStream,
    HoldPosition,
    RecordAudit,
    RefuseStream,
    SaveJournal,
    SendEvent,
    SetStreamRates,
    StartSystemTask,
    StopKind,
    StopMotion,
    StopSystemTask,
    WakeWaiters,
)
from fractus_core.control.events import SystemTaskEnded
from fractus_core.control.state import CONTACT_LOST, SystemTask
from fractus_core.control.state_update import DRIVER_LOST
from fractus_core.control.vehicle_events import MOTORS_STOPPED
from fractus_core.policy.compiled_grant import CompiledGrant
from fractus_core.policy.decision_types import GotoArgs, Verdict
from fractus_runtime.audit import AuditLog

from fractus_services.background import Background
from fractus_services.errors import Aborted, AutopilotError, PreconditionFailed, Refused, Unavailable
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.journal import Journal, record_of
from fractus_services.mobility.authority.mode_controller import ControlAccess, ModeController
from fractus_services.mobility.autopilot import Approach, Autopilot, Permit

log = logging.getLogger(__name__)


_ids = itertools.count(1)


class Lease:
    """Control lease of one driver: its grant, and the events that its control stream still has to send.

    Attributes:
        lease_id: Id in the control state.
        key: Key of the mission.
        grant: Current Grant of the driver. Its key does not change.
        responded: True if the driver has answered the last liveness request.
        called_at: Time of the driver's last motion call, or of the begin of its control.
    """

    def __init__(self, grant: ActiveGrant) -> None:
        self.lease_id = next(_ids)
        self.key = grant.key
        self.grant = grant
        self._events: asyncio.Queue[ControlEvent | None] = asyncio.Queue()
        self._ping = 0
        self.responded = True
        self.called_at = math.inf

    def send(self, event: ControlEvent | None) -> None:
        """Queue an event for the driver. None ends the stream without an event."""
        self._events.put_nowait(event)

    def next_ping(self) -> ControlEvent:
        """Return a liveness request, which the driver has to answer. An unanswered request is returned again."""
        if self.responded:
            self._ping += 1
            self.responded = False
        return ControlEvent(StreamState.PING, ping=self._ping)

    def confirm(self, ping: int) -> None:
        """Store the answer of the driver to a liveness request. An answer to an earlier request has no effect."""
        self.responded = self.responded or ping == self._ping

    async def receive(self, timeout_s: float) -> ControlEvent | None:
        """Return the next event, or None at the end of the stream.

        Raises:
            TimeoutError: No event was queued in time.
        """
        async with asyncio.timeout(timeout_s):
            return await self._events.get()


@dataclass(eq=False, slots=True)
class FlightConstraints:
    """Flight constraints of a system flight. If the grant changes, the constraints change too."""

    grant: ActiveGrant
    compiled: CompiledGrant
    flight_id: int = field(default_factory=_ids.__next__)


@dataclass(eq=False, slots=True)
class Motion:
    """Motion call in progress, until it completes or is stopped.

    Attributes:
        kind: Name of the method.
        motion_id: Id in the control state.
        braking: True while the drone comes to rest before the motion, so that the monitor does not stop the motion.
        leg: Leg being flown; None if there is none.
        under_way: True if the autopilot acknowledged the leg.
        speed_mps: Speed of the leg.
        binding: Verdict whose geofences corrected the target; None if no geofence did. Until the target is reached, the
            driver may only hover, land or return.
        binding_until: Time at which the driver may request other motions even if the target was not reached.
    """

    kind: str
    motion_id: int = field(default_factory=_ids.__next__)
    braking: bool = False
    leg: GotoArgs | None = None
    under_way: bool = False
    speed_mps: float | None = None
    binding: Verdict | None = None
    binding_until: float = -math.inf
    _refusal: Refused | None = None

    def stop(self, refusal: Refused) -> None:
        """End the motion with a refusal. If it is called again, the motion keeps its first refusal."""
        self._refusal = self._refusal or refusal

    def check(self) -> None:
        """Check that the motion may continue.

        Raises:
            Refused: The motion was stopped.
        """
        if self._refusal is not None:
            raise self._refusal


class ChangeSignal:
    """Wakes every task that waits for a change of control."""

    def __init__(self) -> None:
        self._event = asyncio.Event()

    async def wait(self, timeout_s: float) -> None:
        """Wait for the next change, at most `timeout_s` seconds."""
        try:
            async with asyncio.timeout(timeout_s):
                await self._event.wait()
        except TimeoutError:
            return

    def notify(self) -> None:
        """Wake all waiting tasks."""
        self._event.set()
        self._event = asyncio.Event()


class EffectRunner:
    """Owns the runtime objects (streams, motions, tasks) that the state machine refers to by id.

    Args:
        control: State and events of the state machine.
        autopilot: Autopilot interface.
        modes: Mode changes, braking and descent.
        approach: Return flight up to the final descent.
        audit: Audit log for changes of control.
        journal: Journal of missions.
        changes: Signal for waiting tasks.

    Attributes:
        tasks: Background tasks.
        leases: Leases of open control streams, by id.
        motion: Latest motion.
        takeover_reason: Reason why no driver has control. Empty while a driver has control or if the reason is unknown.
    """

    def __init__(
        self,
        control: ControlAccess,
        autopilot: Autopilot,
        modes: ModeController,
        approach: Approach,
        *,
        audit: AuditLog,
        journal: Journal,
        changes: ChangeSignal,
    ) -> None:
        self.tasks = Background()
        self.leases: dict[int, Lease] = {}
        self.motion: Motion | None = None
        self.takeover_reason = ""
        self._control = control
        self._autopilot = autopilot
        self._modes = modes
        self._approach = approach
        self._audit = audit
        self._journal = journal
        self._changes = changes
        self._running: dict[int, asyncio.Task[None]] = {}

    def run_all(self, actions: Sequence[Action]) -> None:
        """Carry out all actions in order.

        The state already reflects all of them. A failed action, for example of the audit log, must not prevent the others,
        above all a return flight.

        Raises:
            Exception: The first failure, after all actions were tried.
        """
        failure: Exception | None = None
        for action in actions:
            try:
                self._run(action)
            except Exception as error:
                log.exception("control: action failed (action=%s)", type(action).__name__)
                failure = failure or error
        if failure is not None:
            raise failure

    def _run(self, action: Action) -> None:
        match action:
            case StopMotion():
                if self.motion is not None and self.motion.motion_id == action.motion_id:
                    self.motion.stop(_refusal(action))
            case SendEvent() | EndStream() | RefuseStream():
                self._send(action)
            case StartSystemTask(task):
                self.run_task(task, self._carry_out(task))
            case StopSystemTask(task_id):
                self.tasks.drop(self._running.pop(task_id, None))
            case Brake():
                self._autopilot.stop()
                self.tasks.spawn(self._modes.settle())
            case HoldPosition():
                self.tasks.spawn(self.tasks.attempt(self.hover, self.require_undisturbed))
            case RecordAudit():
                self._record(action)
            case SaveJournal():
                self._journal.save_soon(record_of(self._control.state))
            case WakeWaiters():
                self._changes.notify()
            case SetStreamRates(flying):
                self.tasks.spawn(self.tasks.attempt(self._autopilot.set_rates, flying=flying))
            case _:
                assert_never(action)

    def _send(self, action: SendEvent | EndStream | RefuseStream) -> None:
        """Send an event to a control stream, or end the stream.

        A refusal is not sent, because `open_lease` reads it from the result of the state transition.
        """
        lease = self.leases.get(action.lease_id)
        if lease is not None and not isinstance(action, RefuseStream):
            lease.send(action.event if isinstance(action, SendEvent) else None)

    # System tasks

    def run_task(self, task: SystemTask, work: Coroutine[Any, Any, None]) -> None:
        """Run a system task.

        The end of the task is dispatched even if the task fails. Otherwise a failed task would count as running.
        """
        running = self._running[task.task_id] = self.tasks.spawn(work)

        def ended(_done: asyncio.Task[None]) -> None:
            self._running.pop(task.task_id, None)
            self._control.dispatch(SystemTaskEnded(task.task_id, finished=False))

        running.add_done_callback(ended)

    async def _carry_out(self, task: SystemTask) -> None:
        await self._modes.carry_out(task.kind, lambda: self._is_current(task), self._approach)
        self._control.dispatch(SystemTaskEnded(task.task_id, finished=True))

    def _is_current(self, task: SystemTask) -> bool:
        """Return True if a task is current and may send commands."""
        state = self._control.state
        return state.task == task and state.authority is Authority.SYSTEM

    # Hovering after a motion

    async def hover(self, permit: Permit) -> None:
        """Brake and hover."""
        await self._modes.hold(permit)
        self.tasks.spawn(self._modes.settle())

    def require_undisturbed(self) -> None:
        """Check that the drone may hover after a driver's motion.

        Raises:
            AutopilotError: Another motion has begun, or the driver has lost control.
        """
        state = self._control.state
        if state.motion is not None or state.authority is not Authority.DRIVER:
            raise AutopilotError("another motion has begun")

    # The audit log

    def _record(self, entry: RecordAudit) -> None:
        if entry.kind == "takeover" or entry.action in {"returned", DRIVER_LOST}:
            self.takeover_reason = entry.reason or "its driver returned control"
        elif entry.action in {"granted", "landed", MOTORS_STOPPED}:
            self.takeover_reason = ""
        vehicle = self._autopilot.vehicle
        self._audit.append(
            entry.kind,
            {
                "action": entry.action, "controller": entry.controller, "reason": entry.reason, "code": entry.code,
                "policies": list(entry.policies), "lat": vehicle.lat, "lon": vehicle.lon, "alt": vehicle.altitude_m,
            },
        )  # fmt: skip


def _refusal(stop: StopMotion) -> Refused:
    """Return the error for the caller of a stopped motion."""
    match stop.kind:
        case StopKind.ABORTED:
            return Aborted(stop.code, stop.reason, stop.policies)
        case StopKind.LOST:
            return PreconditionFailed(stop.code, stop.reason)
        case StopKind.PASSING:
            code = CONTACT_LOST if stop.code == CONTACT_LOST else "AutopilotUnavailable"
            return Unavailable(code, stop.reason)
        case _:
            assert_never(stop.kind)
