"""Working copy of the control state during one transition, and the steps that transitions are composed of."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from fractus_core.control.actions import (
    Action,
    RecordAudit,
    SaveJournal,
    SendEvent,
    StartSystemTask,
    StopKind,
    StopMotion,
    StopSystemTask,
    WakeWaiters,
)
from fractus_core.control.state import (
    Authority,
    ControlEvent,
    ControlState,
    Grace,
    Mission,
    Outcome,
    OutcomeKind,
    StreamState,
    SystemTask,
    TaskKind,
)

MAX_MISSIONS = 200
"""Maximum number of missions that the state contains."""

DRIVER_LOST = "driver lost"
GRANT_REMOVED = "the grant was removed"

POSITION_UNKNOWN = "PositionUnknown"
"""Code of the reaction to an unknown position: the vehicle hovers until the position is known again."""


class StateUpdate:
    """Collects the changes and actions of one event. Nothing is visible outside before the transition is complete.

    Attributes:
        state: State with the changes so far.
        actions: Actions so far, in order of execution.
        now: Time of the event in monotonic seconds.
    """

    def __init__(self, state: ControlState, now: float) -> None:
        self.state = state
        self.actions: list[Action] = []
        self.now = now

    def set(self, **changes: Any) -> None:
        """Change fields of the state."""
        self.state = replace(self.state, **changes)

    def act(self, action: Action) -> None:
        """Add an action."""
        self.actions.append(action)

    def audit(
        self,
        kind: str,
        action: str,
        controller: str,
        reason: str,
        code: str = "",
        *,
        policies: tuple[str, ...] = (),
    ) -> None:
        """Record a change of control in the audit log."""
        self.act(RecordAudit(kind, action, controller, reason, code, policies))

    # Missions

    def mission(self, key: str, identity: str) -> Mission:
        """Return the mission of a grant. Create a missing mission, and keep the latest `MAX_MISSIONS`."""
        mission = self.state.missions.get(key)
        if mission is None:
            mission = Mission(key, identity)
            missions = {**self.state.missions, key: mission}
            for oldest in list(missions)[: max(len(missions) - MAX_MISSIONS, 0)]:
                del missions[oldest]
            self.set(missions=missions)
        return mission

    def update_mission(self, mission: Mission, **changes: Any) -> Mission:
        """Change fields of a mission, and return the changed mission."""
        changed = replace(mission, **changes)
        self.set(missions={**self.state.missions, mission.key: changed})
        return changed

    def end_mission(self, mission: Mission | None, kind: OutcomeKind, reason: str) -> Mission | None:
        """Set and save the outcome of a mission that has none, and end the grace period of its driver."""
        if mission is None or mission.outcome is not None:
            return mission
        if self.state.grace is not None and self.state.grace.key == mission.key:
            self.set(grace=None)
        self.act(SaveJournal())
        return self.update_mission(mission, outcome=Outcome(kind, reason))

    def adopt(self, mission: Mission) -> None:
        """Make a mission the active mission, for which the vehicle flies from now on."""
        if self.state.active != mission.key:
            self.set(speed_mps=None)
        self.set(active=mission.key, removed=None)
        self.act(SaveJournal())

    # Motions and leases

    def stop_motion(self, kind: StopKind, code: str, reason: str, policies: tuple[str, ...] = ()) -> None:
        """End the current motion."""
        if self.state.motion is not None:
            self.act(StopMotion(self.state.motion.motion_id, kind, code, reason, policies))
            self.set(motion=None)

    def lose_lease(self, reason: str, code: str = "", policies: tuple[str, ...] = ()) -> None:
        """Take the lease from a driver that has control or waits for control, and report the reason to the driver.

        Args:
            reason: Reason in plain text.
            code: Code of the verdict, if a policy takes the vehicle.
            policies: Policies that demand the takeover.
        """
        lease = self.state.lease
        self.stop_motion(StopKind.LOST, "ControlLost", reason, policies)
        self.drop_lease()
        if lease is not None:
            lost = ControlEvent(StreamState.LOST, reason=reason, code=code, policies=policies)
            self.act(SendEvent(lease.lease_id, lost))
        self.act(WakeWaiters())

    def drop_lease(self) -> None:
        """Remove the lease, and end the control authority of the driver."""
        self.set(lease=None)
        if self.state.authority is Authority.DRIVER:
            self.set(authority=Authority.SYSTEM)

    # The system

    def start(self, kind: TaskKind, *, begun_by_others: bool = False) -> None:
        """Start a system task in place of the current task.

        If the task brings the vehicle down, the vehicle counts as returning from now on. Otherwise the monitor or the
        supervisor could intervene before the task runs.
        """
        self.stop_task()
        task = SystemTask(self.state.last_task_id + 1, kind, begun_by_others=begun_by_others)
        self.set(task=task, last_task_id=task.task_id)
        self.set(returning=kind is not TaskKind.HOVER and self.state.vehicle.armed)
        self.act(StartSystemTask(task))

    def stop_task(self) -> None:
        """Stop the system task.

        If the autopilot itself is returning, the return continues, but no system task supervises it.
        """
        if self.state.task is not None:
            self.act(StopSystemTask(self.state.task.task_id))
        self.set(task=None, returning=False)

    def begin_grace(self, mission: Mission, reason: str, code: str = "DriverLost") -> None:
        """Start the grace period of a mission whose driver or position is lost.

        A disarmed drone that has not flown for the mission needs no grace period. If the grace period of the mission is
        already running, its deadline stays. Otherwise a driver that is lost repeatedly could keep the drone in the air.
        """
        current = self.state.grace
        until = self.now + self.state.grace_s
        if current is not None and current.key == mission.key:
            until = min(current.until, until)
        waits = mission.flown or self.state.vehicle.armed
        self.set(grace=Grace(until, mission.key, reason, code) if waits else None)

    def follow_descent(self, kind: TaskKind, *, begun_by_others: bool = False) -> None:
        """Start a system task for a descent that the autopilot started by itself. The task completes the descent."""
        self.set(authority=Authority.SYSTEM)
        self.start(kind, begun_by_others=begun_by_others)
        self.set(returning=True)

    def take_back(self, mission: Mission) -> None:
        """Handle a flight whose driver or pilot no longer has control authority.

        If the mission continues, the drone hovers and waits for its driver. If the mission has ended, the drone
        returns.
        """
        if mission.outcome is not None or not self.state.grant_in_force:
            self.end_mission(mission, OutcomeKind.REVOKED, GRANT_REMOVED)
            self.start(TaskKind.RETURN if mission.land_at is None else TaskKind.LAND_AT)
        else:
            self.start(TaskKind.HOVER)
            self.begin_grace(mission, DRIVER_LOST)

    def seize(
        self, kind: TaskKind, code: str, reason: str, policies: tuple[str, ...], outcome: OutcomeKind | None
    ) -> None:
        """Take the vehicle from its driver and start a system task.

        If the mission has no outcome after the takeover, its grace period starts.
        """
        mission = self.state.mission
        self.audit("takeover", kind.value, "system", reason, code, policies=policies)
        self.lose_lease(reason, code, policies)
        self.set(authority=Authority.SYSTEM)
        if outcome is not None:
            mission = self.end_mission(mission, outcome, reason)
        self.start(kind)
        if mission is not None and mission.outcome is None:
            self.begin_grace(mission, reason)

    def plan_landing(self, mission: Mission | None, land_at: tuple[float, float] | None) -> TaskKind:
        """Store the landing place of a mission that is about to end. Return the task that brings the drone down."""
        if mission is None or land_at is None:
            return TaskKind.RETURN
        self.update_mission(mission, land_at=land_at)
        return TaskKind.LAND_AT

    def give_to_pilot(self, event: str) -> None:
        """Give control authority to a human pilot. Applications lose it at once, and the system sends no more commands.

        Args:
            event: Action of the pilot, as the end of the sentence "a human pilot ...".
        """
        reason = f"a human pilot {event}"
        if self.state.authority is not Authority.PILOT:
            self.audit("takeover", "pilot", "pilot", reason, "PilotTookOver")
        self.stop_task()
        self.lose_lease(reason)
        self.set(authority=Authority.PILOT, grace=None)
