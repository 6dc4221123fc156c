"""Who flies the drone: the driver that holds the lease, the system, or a human pilot.

`fractus_core.control` decides; here its one state is held, told of what happens, and what it asks for is carried out.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from dataclasses import replace
from typing import Any

from fractus_core.control import Authority, ControlState, Mission
from fractus_core.control.actions import Action, RecordAudit
from fractus_core.control.events import (
    BrakeDemanded,
    CruiseSpeedSet,
    Event,
    GrantChanged,
    GrantRef,
    MotionBegan,
    MotionCancelled,
    MotionFailed,
    MotionFinished,
    MotionStopped,
    SystemFlightBegan,
    SystemFlightEnded,
    TakeoverDemanded,
    TourBegan,
    TransitBegan,
)
from fractus_core.policy.compiled_grant import CompiledGrant, compile_transit_grant
from fractus_core.policy.decision_types import Verdict
from fractus_runtime.audit import AuditLog

from fractus_services.grant_files import ActiveGrant, GrantFiles
from fractus_services.mobility.authority.journal import Journal, record_of
from fractus_services.mobility.authority.leases import FlightConstraints, Lease, Motion
from fractus_services.mobility.authority.machine import Machine
from fractus_services.mobility.authority.performer import ModeCommands, Performer
from fractus_services.mobility.autopilot import Approach, Autopilot, Checked, Permit, always

CORRECTION = "Correction"
"""What the motions are called with which the monitor leads a driver's drone back."""

DEFAULT_SPEED_MPS = 5.0
"""Legs are taken to be flown so fast while the vehicle's parameters are not known."""


class Control:
    """The one holder of a drone's control state; all others ask it, and tell it what happens.

    Args:
        autopilot: the link.
        modes: changes modes and brakes; it tells this control of each change.
        approach: flies to where the autopilot's own return is legal.
        journal: what survives a restart.
        grants: grants of this node.
        audit: where takeovers are written.
        grace_s: how long a lost driver may take to come back.
        state: to begin with; by default what the journal remembers, and nothing else.

    Attributes:
        leases: streams of drivers by lease, while they are open.
        tasks: what runs beside the calls.
        wait: waits until something changed that drivers wait for, or the time is over.
        wake: lets everyone that waits look again.
        hold: brakes and hovers.
        undisturbed: permits what a driver's drone does after its motion: nothing else has begun.
    """

    def __init__(
        self,
        autopilot: Autopilot,
        journal: Journal,
        grants: GrantFiles,
        audit: AuditLog,
        *,
        modes: ModeCommands,
        approach: Approach,
        grace_s: float,
        state: ControlState | None = None,
    ) -> None:
        self.autopilot = autopilot
        self.audit = audit
        self._checked: Checked | None = None
        self._journal = journal
        self._grants = grants
        known = replace(
            state or ControlState(),
            grace_s=grace_s,
            missions=journal.record.missions,
            active=journal.record.active,
            armed_by_others=journal.record.armed_by_others,
            grants=frozenset(grant.key for grant in grants.active.values()),
        )
        self._constraints: FlightConstraints | None = None
        self._removed: ActiveGrant | None = None
        self._transit: tuple[ActiveGrant, CompiledGrant] | None = None
        self.modes = modes
        # Each needs the other, so one is looked up when it is called.
        self._machine = Machine(autopilot, known, lambda actions: self._performer.perform(actions))  # noqa: PLW0108
        performer = self._performer = Performer(self._machine, autopilot, modes, approach, audit=audit, journal=journal)
        self.tasks, self.leases, self.taken_because = performer.tasks, performer.leases, performer.taken_because
        self.wait, self.wake = performer.wait, performer.wake
        self.hold, self.undisturbed = performer.hold, performer.undisturbed
        grants.listen(self._grant_changed)

    # The state machine

    @property
    def state(self) -> ControlState:
        """Everything that decides who commands the drone, with the drone as it is now."""
        return self._machine.state

    def dispatch(self, event: Event) -> tuple[Action, ...]:
        """Tell the state machine what happened, see `Machine`."""
        return self._machine.dispatch(event)

    def close(self) -> None:
        """Let no deadline act any more: the service ends, and the autopilot's failsafe takes its place."""
        self._machine.close()

    # What is known

    @property
    def authority(self) -> Authority:
        """Who may command."""
        return self._machine.known.authority

    @property
    def lease(self) -> Lease | None:
        """The lease of the driver that has the drone or waits for it."""
        lease = self._machine.known.lease
        return self._performer.leases.get(lease.lease_id) if lease is not None else None

    @property
    def motion(self) -> Motion | None:
        """The motion under way."""
        known, motion = self._machine.known.motion, self._performer.motion
        return motion if known is not None and motion is not None and motion.motion_id == known.motion_id else None

    @property
    def constraints(self) -> FlightConstraints | None:
        """The fences under which the system flies an application's drone; None while it does not."""
        known, constraints = self._machine.known.flight, self._constraints
        return constraints if constraints and known and constraints.flight_id == known.flight_id else None

    @property
    def mission_grant(self) -> ActiveGrant | None:
        """The grant under which the drone is in the air."""
        lease, mission = self.lease, self._machine.known.mission
        if lease is not None:
            return lease.grant
        grant = self._grants.of(mission.identity) if mission is not None else None
        return grant if grant is not None and mission is not None and grant.key == mission.key else None

    @property
    def last_grant(self) -> ActiveGrant | None:
        """The grant whose fences hold on the way home: the mission's, or what it was before it was taken away."""
        return self.mission_grant or (self._removed if self._machine.known.removed is not None else None)

    @property
    def checked(self) -> Checked | None:
        """The autopilot's failsafes, as they were set and verified last; None while they are not."""
        return self._checked

    def set_checked(self, checked: Checked | None) -> None:
        """The failsafes were set or verified, or what is known of them does not hold any more."""
        self._checked = checked

    @property
    def retraces(self) -> bool:
        """Whether the autopilot can fly home on the path that it came."""
        capable = self._checked is not None and self._checked.airframe.retraces
        return capable and not self.autopilot.vehicle.path_lost

    @property
    def cruise_mps(self) -> float:
        """The speed of legs that name none: the driver's on what the driver flies, else the vehicle's own."""
        state = self._machine.known
        corrects = state.motion is not None and state.motion.kind == CORRECTION
        if state.speed_mps is not None and state.authority is Authority.DRIVER and not corrects:
            return state.speed_mps
        return self._checked.speed_mps if self._checked is not None else DEFAULT_SPEED_MPS

    def mission(self, grant: ActiveGrant) -> Mission:
        """The mission of a grant; a new one, when nothing is known of it yet."""
        return self._machine.known.missions.get(grant.key) or Mission(grant.key, grant.identity)

    def valid(self, grant: ActiveGrant) -> bool:
        """Whether a grant is still in force."""
        now = self._grants.of(grant.identity)
        return now is not None and now.key == grant.key

    def note(self, action: str, reason: str, code: str = "") -> None:
        """Write down what the system does."""
        self._performer.perform((RecordAudit("control", action, "system", reason, code),))

    # What survives a restart

    async def save(self, timeout_s: float | None = None) -> str:
        """Write the missions to disk; why that failed, or nothing."""
        await self._journal.save(record_of(self._machine.known), timeout_s)
        return self._journal.failure

    # The system flies for an application

    def begin_transit(self, grant: ActiveGrant) -> FlightConstraints:
        """The system flies for an application, under its fences."""
        constraints = self._constraints_of(grant)
        self.dispatch(TransitBegan(constraints.flight_id, grant.key, grant.identity))
        return constraints

    def begin_system_flight(self, grant: ActiveGrant) -> FlightConstraints:
        """What the system flies from now on keeps to the fences of a grant, as they are at each moment."""
        constraints = self._constraints_of(grant)
        self.dispatch(SystemFlightBegan(constraints.flight_id, grant.key))
        return constraints

    def end_system_flight(self, constraints: FlightConstraints) -> None:
        """The system has stopped flying under these constraints."""
        self.dispatch(SystemFlightEnded(constraints.flight_id))

    def begin_tour(self, grant: ActiveGrant, work: Coroutine[Any, Any, None]) -> None:
        """Fly a mission without a driver, by a task that tells control how it ends."""
        self.dispatch(TourBegan(grant.key))
        if self._machine.known.task is not None:
            self._performer.run(self._machine.known.task, work)

    def _constraints_of(self, grant: ActiveGrant) -> FlightConstraints:
        self._constraints = FlightConstraints(grant, self.for_transit(grant))
        return self._constraints

    def for_transit(self, grant: ActiveGrant) -> CompiledGrant:
        """The fences of a grant for what the system flies."""
        if self._transit is None or self._transit[0] is not grant:
            self._transit = grant, compile_transit_grant(grant.spec, flat_terrain=grant.compiled.flat_terrain)
        return self._transit[1]

    # Motions

    def cruise(self, speed_mps: float, leg_mps: float) -> None:
        """Fly legs with this speed from now on, and the one under way with another: what is allowed all along it."""
        self.dispatch(CruiseSpeedSet(speed_mps))
        motion = self.motion
        if motion is not None and motion.speed_mps is not None:
            motion.speed_mps = leg_mps

    def begin(self, kind: str, permit: Callable[[Motion], Permit] = lambda _motion: always) -> Motion:
        """Start a motion, if its permit allows it; the one under way is replaced."""
        motion = Motion(kind)
        permit(motion)()
        self.dispatch(MotionBegan(motion.motion_id, kind))
        self._performer.motion = motion
        return motion

    def finish(self, motion: Motion) -> None:
        """A motion is complete, or over."""
        self.dispatch(MotionFinished(motion.motion_id))

    def cancelled(self, motion: Motion) -> None:
        """The caller of a motion gave it up: hover, unless the driver is gone and the drone comes home anyway."""
        self.dispatch(MotionCancelled(motion.motion_id))

    def failed(self, motion: Motion) -> None:
        """A motion ended with an error, and the autopilot may fly on for it: hover."""
        self.dispatch(MotionFailed(motion.motion_id))

    def stop_motion(self, verdict: Verdict) -> None:
        """End the motion under way, for one that follows it."""
        self.dispatch(MotionStopped(verdict.code, verdict.reason, verdict.policies))

    # Policies and grants

    def brake(self, verdict: Verdict) -> None:
        """Stop the present motion; the driver keeps the drone."""
        self.dispatch(BrakeDemanded(verdict.code, verdict.reason, verdict.policies))

    def take_over(self, verdict: Verdict) -> None:
        """The system takes the drone from its driver, as a policy or the monitor says."""
        self.dispatch(TakeoverDemanded(verdict.takeover or "hover", verdict.code, verdict.reason, verdict.policies))

    def _grant_changed(self, old: ActiveGrant | None, new: ActiveGrant | None) -> None:
        lease, constraints = self.lease, self.constraints
        if old is not None and new is not None and old.key == new.key:
            if lease is not None and lease.key == new.key:
                lease.grant = new
            if constraints is not None and constraints.grant.key == new.key:
                constraints.grant, constraints.compiled = new, self.for_transit(new)
        self.dispatch(GrantChanged(_reference(old), _reference(new)))
        if old is not None and self._machine.known.removed == old.key:
            self._removed = old


def _reference(grant: ActiveGrant | None) -> GrantRef | None:
    if grant is None:
        return None
    return GrantRef(grant.key, commands_vehicle=grant.spec.class_ == "driver" or bool(grant.spec.tour))
