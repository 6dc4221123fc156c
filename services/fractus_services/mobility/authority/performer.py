"""Carries out what the state machine of control asks for: streams, motions, system tasks, audit log, journal."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine, Sequence
from typing import Any, Protocol, assert_never

from fractus_core.control import Authority, ControlState
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
from fractus_core.control.events import Event, SystemTaskEnded
from fractus_core.control.state import FlightMode, SystemTask, TaskKind
from fractus_core.control.state_update import DRIVER_LOST
from fractus_runtime.audit import AuditLog

from fractus_services.background import Background
from fractus_services.errors import Aborted, AutopilotError, PreconditionFailed, Refused, Unavailable
from fractus_services.mobility.authority.journal import Journal, record_of
from fractus_services.mobility.authority.leases import Lease, Motion
from fractus_services.mobility.autopilot import Approach, Autopilot, Permit

log = logging.getLogger(__name__)


class Holder(Protocol):
    """The holder of the state."""

    @property
    def state(self) -> ControlState:
        """As it is now."""

    def dispatch(self, event: Event) -> Sequence[Action]:
        """Tell the state machine."""


class ModeCommands(Protocol):
    """What `ModeController` does with the drone."""

    async def change_mode(self, mode: FlightMode, permit: Permit = ...) -> None:
        """Change the flight mode."""

    async def enter_guided(self, permit: Permit = ...) -> None:
        """Change to the mode in which the autopilot obeys."""

    async def hold(self, permit: Permit = ...) -> None:
        """Brake and hover."""

    async def settle(self) -> None:
        """Keep braking until the drone stands."""

    async def carry_out(self, kind: TaskKind, wanted: Callable[[], bool], approach: Approach) -> None:
        """Do what the system wants, however often the link fails."""


class Performer:
    """Holds the live things that the state knows by their numbers.

    Args:
        machine: told when a system task is over.
        autopilot: the link.
        modes: brakes, hovers, brings the drone down.
        approach: flies the way home to where the autopilot does the rest.
        audit: where changes of control are written.
        journal: where missions are written.

    Attributes:
        tasks: what runs beside the calls.
        leases: streams of drivers by lease, while they are open.
        motion: the motion that began last.
    """

    def __init__(
        self,
        machine: Holder,
        autopilot: Autopilot,
        modes: ModeCommands,
        approach: Approach,
        *,
        audit: AuditLog,
        journal: Journal,
    ) -> None:
        self.tasks = Background()
        self.leases: dict[int, Lease] = {}
        self.motion: Motion | None = None
        self._machine = machine
        self._autopilot = autopilot
        self._modes = modes
        self._approach = approach
        self._audit = audit
        self._journal = journal
        self._running: dict[int, asyncio.Task[None]] = {}
        self._changed = asyncio.Event()
        self._taken_because = ""

    def taken_because(self) -> str:
        """Why no driver has control; empty while one has, or where that is not known."""
        return self._taken_because

    def perform(self, actions: Sequence[Action]) -> None:
        """Carry out everything, in order.

        The state says already that all of this happens: what fails, an audit log that takes no entry, must not keep the rest
        from happening, a flight home least of all.

        Raises:
            Exception: the first failure, when all is done.
        """
        failure: Exception | None = None
        for action in actions:
            try:
                self._perform(action)
            except Exception as error:
                log.exception("control: an action failed (action=%s)", type(action).__name__)
                failure = failure or error
        if failure is not None:
            raise failure

    def _perform(self, action: Action) -> None:
        match action:
            case StopMotion():
                if self.motion is not None and self.motion.motion_id == action.motion_id:
                    self.motion.stop(_refusal(action))
            case SendEvent() | EndStream() | RefuseStream():
                self._tell(action)
            case StartSystemTask() | StopSystemTask():
                self._switch(action)
            case Brake() | HoldPosition():
                self._stop(action)
            case RecordAudit():
                self._record(action)
            case SaveJournal():
                self._journal.save_soon(record_of(self._machine.state))
            case WakeWaiters():
                self.wake()
            case SetStreamRates(flying):
                self.tasks.spawn(self.tasks.attempt(self._autopilot.set_rates, flying=flying))
            case _:
                assert_never(action)

    def _tell(self, action: SendEvent | EndStream | RefuseStream) -> None:
        """Tell a stream; one that is refused learns it from the transition itself."""
        lease = self.leases.get(action.lease_id)
        if lease is not None and not isinstance(action, RefuseStream):
            lease.tell(action.event if isinstance(action, SendEvent) else None)

    def _switch(self, action: StartSystemTask | StopSystemTask) -> None:
        if isinstance(action, StartSystemTask):
            self.run(action.task, self._carry_out(action.task))
        else:
            self.tasks.drop(self._running.pop(action.task_id, None))

    def _stop(self, action: Brake | HoldPosition) -> None:
        if isinstance(action, Brake):
            self._autopilot.stop()
            self.tasks.spawn(self._modes.settle())
        else:
            self.tasks.spawn(self.tasks.attempt(self.hold, self.undisturbed))

    # System tasks

    def run(self, task: SystemTask, work: Coroutine[Any, Any, None]) -> None:
        """Run a system task; however it ends, control is told, so that no task counts that is dead."""
        running = self._running[task.task_id] = self.tasks.spawn(work)

        def ended(_done: asyncio.Task[None]) -> None:
            self._running.pop(task.task_id, None)
            self._machine.dispatch(SystemTaskEnded(task.task_id, finished=False))

        running.add_done_callback(ended)

    async def _carry_out(self, task: SystemTask) -> None:
        """What the system wants, as long as it has the drone and wants this."""
        await self._modes.carry_out(task.kind, lambda: self._counts(task), self._approach)
        self._machine.dispatch(SystemTaskEnded(task.task_id, finished=True))

    def _counts(self, task: SystemTask) -> bool:
        """Whether a task may still command: one that stopped itself, or is not cancelled yet, must not fly against the next."""
        state = self._machine.state
        return state.task == task and state.authority is Authority.SYSTEM

    # Motions of the driver

    async def hold(self, permit: Callable[[], None]) -> None:
        """Brake and hover."""
        await self._modes.hold(permit)
        self.tasks.spawn(self._modes.settle())

    def undisturbed(self) -> None:
        """Permits what a driver's drone does after its motion: nothing else has begun.

        Raises:
            AutopilotError: something else flies by now.
        """
        state = self._machine.state
        if state.motion is not None or state.authority is not Authority.DRIVER:
            raise AutopilotError("something else flies by now")

    # Waiting

    async def wait(self, timeout_s: float) -> None:
        """Wait until something changed that is waited for, or the time is over."""
        try:
            async with asyncio.timeout(timeout_s):
                await self._changed.wait()
        except TimeoutError:
            return

    def wake(self) -> None:
        """Let everyone that waits look again."""
        self._changed.set()
        self._changed = asyncio.Event()

    # The audit log

    def _record(self, entry: RecordAudit) -> None:
        if entry.kind == "takeover" or entry.action in {"returned", DRIVER_LOST}:
            self._taken_because = entry.reason or "its driver returned control"
        elif entry.action in {"granted", "landed"}:
            self._taken_because = ""
        vehicle = self._autopilot.vehicle
        self._audit.append(
            entry.kind,
            {
                "action": entry.action, "controller": entry.controller, "reason": entry.reason, "code": entry.code,
                "policies": list(entry.policies), "lat": vehicle.lat, "lon": vehicle.lon, "alt": vehicle.altitude_m,
            },
        )  # fmt: skip


def _refusal(stop: StopMotion) -> Refused:
    """What the caller of a stopped motion is told."""
    match stop.kind:
        case StopKind.ABORTED:
            return Aborted(stop.code, stop.reason, stop.policies)
        case StopKind.LOST:
            return PreconditionFailed(stop.code, stop.reason)
        case StopKind.PASSING:
            return Unavailable("AutopilotUnavailable", stop.reason)
        case _:
            assert_never(stop.kind)
