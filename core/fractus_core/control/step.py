"""One transition under way: the state as it is by now, the actions so far, and the moves that transitions are made of."""

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
from fractus_core.control.values import (
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

REMEMBERED_MISSIONS = 200
DRIVER_LOST = "driver lost"
GRANT_REMOVED = "the grant was removed"


class Step:
    """Collects what one event changes; nothing outside of it sees what is not finished.

    Attributes:
        state: as it is by now.
        actions: to be carried out, in order.
        now: monotonic seconds.
    """

    def __init__(self, state: ControlState, now: float) -> None:
        self.state = state
        self.actions: list[Action] = []
        self.now = now

    def set(self, **changes: Any) -> None:
        """Change the state."""
        self.state = replace(self.state, **changes)

    def act(self, action: Action) -> None:
        """Ask for an action."""
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
        """Write a change of control down."""
        self.act(RecordAudit(kind, action, controller, reason, code, policies))

    # Missions

    def mission(self, key: str, identity: str) -> Mission:
        """The mission of a grant, begun when it is new; the oldest are forgotten."""
        found = self.state.missions.get(key)
        if found is None:
            found = Mission(key, identity)
            missions = {**self.state.missions, key: found}
            for old in list(missions)[: max(len(missions) - REMEMBERED_MISSIONS, 0)]:
                del missions[old]
            self.set(missions=missions)
        return found

    def update_mission(self, mission: Mission, **changes: Any) -> Mission:
        """Change a mission."""
        changed = replace(mission, **changes)
        self.set(missions={**self.state.missions, mission.key: changed})
        return changed

    def end_mission(self, mission: Mission | None, kind: OutcomeKind, reason: str) -> Mission | None:
        """Give a mission its outcome and keep it, unless it has one; no one is waited for any more."""
        if mission is None or mission.outcome is not None:
            return mission
        if self.state.grace is not None and self.state.grace.key == mission.key:
            self.set(grace=None)
        self.act(SaveJournal())
        return self.update_mission(mission, outcome=Outcome(kind, reason))

    def adopt(self, mission: Mission) -> None:
        """The vehicle flies for this mission."""
        if self.state.active != mission.key:
            self.set(speed_mps=None)
        self.set(active=mission.key, removed=None)
        self.act(SaveJournal())

    # Motions and leases

    def stop_motion(self, kind: StopKind, code: str, reason: str, policies: tuple[str, ...] = ()) -> None:
        """End the motion under way."""
        if self.state.motion is not None:
            self.act(StopMotion(self.state.motion.motion_id, kind, code, reason, policies))
            self.set(motion=None)

    def lose_lease(self, reason: str) -> None:
        """Take the vehicle from the driver, or from who waits for it, and say why."""
        lease = self.state.lease
        self.stop_motion(StopKind.LOST, "ControlLost", reason)
        self.drop_lease()
        if lease is not None:
            self.act(SendEvent(lease.lease_id, ControlEvent(StreamState.LOST, reason=reason)))
        self.act(WakeWaiters())

    def drop_lease(self) -> None:
        """No driver has or waits for the vehicle any more.

        A driver whose second stream waits has authority without a granted lease: with that stream its authority ends too, or
        a pilot who arms the vehicle would be taken for the driver.
        """
        self.set(lease=None)
        if self.state.authority is Authority.DRIVER:
            self.set(authority=Authority.SYSTEM)

    # The system

    def start(self, kind: TaskKind, *, found: bool = False) -> None:
        """Begin what the system wants of the vehicle; what it did before ends.

        Coming down counts as returning from here on, so that no monitor or supervisor interferes before the task runs.
        """
        self.stop_task()
        task = SystemTask(self.state.last_task_id + 1, kind, found=found)
        self.set(task=task, last_task_id=task.task_id)
        self.set(returning=kind is not TaskKind.HOVER and self.state.vehicle.armed)
        self.act(StartSystemTask(task))

    def stop_task(self) -> None:
        """End what the system does with the vehicle; a way home of the autopilot's own goes on, and is no one's."""
        if self.state.task is not None:
            self.act(StopSystemTask(self.state.task.task_id))
        self.set(task=None, returning=False)

    def begin_grace(self, mission: Mission, reason: str, code: str = "DriverLost") -> None:
        """Give a lost driver or position its time to come back; on the ground, before any flight, there is nothing to save.

        A mission that is waited for already gets no more time: what is lost and found again and again comes home.
        """
        before, until = self.state.grace, self.now + self.state.grace_s
        if before is not None and before.key == mission.key:
            until = min(before.until, until)
        waits = mission.flown or self.state.vehicle.armed
        self.set(grace=Grace(until, mission.key, reason, code) if waits else None)

    def follow_descent(self, kind: TaskKind, *, found: bool = False) -> None:
        """The autopilot comes down by itself: the system watches it to the ground, and does the rest if it stops."""
        self.set(authority=Authority.SYSTEM)
        self.start(kind, found=found)
        self.set(returning=True)

    def take_back(self, mission: Mission) -> None:
        """Hover and wait for the driver of a mission that goes on; fly home otherwise."""
        if mission.outcome is not None or not self.state.grant_in_force:
            self.end_mission(mission, OutcomeKind.REVOKED, GRANT_REMOVED)
            self.start(TaskKind.RETURN)
        else:
            self.start(TaskKind.HOVER)
            self.begin_grace(mission, DRIVER_LOST)

    def seize(
        self, kind: TaskKind, code: str, reason: str, policies: tuple[str, ...], outcome: OutcomeKind | None
    ) -> None:
        """The system takes the vehicle from its driver, or goes on with another task; a mission without outcome gets its grace."""
        mission = self.state.mission
        self.audit("takeover", kind.value, "system", reason, code, policies=policies)
        self.lose_lease(reason)
        self.set(authority=Authority.SYSTEM)
        if outcome is not None:
            mission = self.end_mission(mission, outcome, reason)
        self.start(kind)
        if mission is not None and mission.outcome is None:
            self.begin_grace(mission, reason)

    def give_to_pilot(self, what: str) -> None:
        """A human pilot has the vehicle: applications lose it at once, and the system commands nothing any more."""
        reason = f"a human pilot {what}"
        if self.state.authority is not Authority.PILOT:
            self.audit("takeover", "pilot", "pilot", reason, "PilotTookOver")
        self.stop_task()
        self.lose_lease(reason)
        self.set(authority=Authority.PILOT, grace=None)
