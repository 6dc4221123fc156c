"""Holder of the control state: the driver that has the lease, the system, or a human pilot.

`fractus_core.control` makes the decisions. The store applies events to the state. `Effects` carries out the resulting
actions.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Coroutine
from dataclasses import replace
from typing import Any

from fractus_core.api.names import component_name
from fractus_core.control import Authority, ControlState, Mission
from fractus_core.control.actions import Action, RecordAudit, RefuseStream
from fractus_core.control.events import (
    BrakeDemanded,
    ContactLost,
    ContactRestored,
    ControlReturned,
    CruiseSpeedSet,
    DriverUnresponsive,
    Event,
    GrantChanged,
    GrantControl,
    GrantRef,
    MotionBegan,
    MotionCancelled,
    MotionFailed,
    MotionFinished,
    MotionStopped,
    StreamClosed,
    StreamOpened,
    SystemFlightBegan,
    SystemFlightEnded,
    TakeoverDemanded,
    Tick,
    TourBegan,
    TransitBegan,
    WaypointsDone,
)
from fractus_core.control.machine import CORRECTION, transition
from fractus_core.control.readiness import NOT_CONNECTED, Readiness, not_ready_reason
from fractus_core.control.state import CONTACT_LOST, VehicleFacts
from fractus_core.geo import LocalFrame
from fractus_core.policy.compiled_grant import CompiledGrant, compile_transit_grant
from fractus_core.policy.decision_types import Home, Verdict, deny
from fractus_runtime.audit import AuditLog

from fractus_services.errors import AutopilotError, PreconditionFailed, Unavailable
from fractus_services.grant_files import ActiveGrant, GrantFiles
from fractus_services.mobility.authority.contact import Contact
from fractus_services.mobility.authority.effects import ChangeSignal, EffectRunner, FlightConstraints, Lease, Motion
from fractus_services.mobility.authority.flown_grant import FlownGrantFile
from fractus_services.mobility.authority.journal import Journal, record_of
from fractus_services.mobility.authority.mode_controller import ModeController
from fractus_services.mobility.autopilot import BEING_SET, Approach, Autopilot, FailsafeStatus, Permit, always
from fractus_services.mobility.settings import SETTINGS

NO_CONTACT = deny(CONTACT_LOST, "the drone has no contact with the API server, on which the application depends")


class ControlStore:
    """The only holder of a drone's control state.

    Args:
        autopilot: Autopilot interface. Its clock is the clock of the events.
        journal: Journal of missions, from which the state is restored.
        grants: Grants of this node.
        audit: Audit log for changes of control.
        approach: Return flight up to the final descent.
        grace_s: Seconds within which a lost driver may come back.
        contact: Contact of the node with the API server.
        flown_grant: Grant of the flight in progress on disk; None if it is not stored.
        state: Initial state; by default only what the journal contains.

    Attributes:
        contact: Contact of the node with the API server.
        modes: Mode changes, braking and descent.
        changes: Signal of changes that drivers and passengers wait for.
        effects: Execution of the state machine's actions.
        tasks: Background tasks.
        failsafe_status: Result of the last failsafe verification; None if it is outdated.
        stopping: True once the service stops. The drone is then not armed any more.
    """

    def __init__(
        self,
        autopilot: Autopilot,
        journal: Journal,
        grants: GrantFiles,
        audit: AuditLog,
        *,
        approach: Approach,
        grace_s: float,
        contact: Contact,
        flown_grant: FlownGrantFile | None = None,
        state: ControlState | None = None,
    ) -> None:
        self.autopilot = autopilot
        self.contact = contact
        self.audit = audit
        self.modes = ModeController(autopilot, self)
        self.changes = ChangeSignal()
        self.effects = EffectRunner(
            self, autopilot, self.modes, approach, audit=audit, journal=journal, changes=self.changes
        )
        self.tasks = self.effects.tasks
        self._journal = journal
        self._grants = grants
        self._flown_grant = flown_grant
        stored = flown_grant.grant if flown_grant is not None else None
        self._removed = stored if stored is not None and stored.key == journal.record.active else None
        self._state = replace(
            state or ControlState(),
            grace_s=grace_s,
            missions=journal.record.missions,
            active=journal.record.active,
            removed=self._removed.key if self._removed is not None else None,
            armed_by_others=journal.record.armed_by_others,
            grants=frozenset(grant.key for grant in grants.active.values()),
        )
        self._timer: asyncio.TimerHandle | None = None
        self._closed = False
        self.failsafe_status: FailsafeStatus | None = None
        self.stopping = False
        self._constraints: FlightConstraints | None = None
        self._transit: tuple[ActiveGrant, CompiledGrant] | None = None
        self._update_contact_demand()
        grants.listen(self._grant_changed)

    # The state machine

    @property
    def state(self) -> ControlState:
        """The control state with the current state of the vehicle."""
        vehicle = self.autopilot.vehicle
        facts = VehicleFacts(
            connected=self.autopilot.connected,
            armed=vehicle.armed,
            in_air=vehicle.in_air,
            mode=vehicle.mode,
            failsafe=vehicle.failsafe,
            failsafe_text=vehicle.failsafe_text,
            failsafe_text_at=vehicle.failsafe_text_at,
            silent_s=vehicle.heartbeat_gap_s * self.autopilot.pace,
            stopped_in_air=vehicle.stopped_in_air,
        )
        self._state = self._state.observed(facts)
        return self._state

    def dispatch(self, event: Event) -> tuple[Action, ...]:
        """Apply an event to the state and carry out the resulting actions.

        Raises:
            Exception: An action failed. All other actions were carried out.
        """
        self._state, actions = transition(self.state, event, self.autopilot.now)
        try:
            self.effects.run_all(actions)
        finally:
            self._set_timer()
        return actions

    def close(self) -> None:
        """Disable all deadlines, because the service ends and the autopilot's failsafe takes over."""
        self._closed = True
        self._set_timer()

    def _set_timer(self) -> None:
        """Schedule a Tick for the next deadline of the state."""
        deadline = None if self._closed else self._state.deadline
        if self._timer is not None and self._timer.when() == deadline and not self._timer.cancelled():
            return
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if deadline is not None:
            self._timer = asyncio.get_running_loop().call_at(deadline, self._tick)

    def _tick(self) -> None:
        self._timer = None
        self.dispatch(Tick())

    # Queries

    @property
    def authority(self) -> Authority:
        """Party that may command the vehicle."""
        return self._state.authority

    @property
    def lease(self) -> Lease | None:
        """Lease of the driver that has control or waits for it."""
        lease = self._state.lease
        return self.effects.leases.get(lease.lease_id) if lease is not None else None

    @property
    def motion(self) -> Motion | None:
        """Current motion."""
        active = self._state.motion
        motion = self.effects.motion
        if active is None or motion is None or motion.motion_id != active.motion_id:
            return None
        return motion

    @property
    def suspension(self) -> Verdict | None:
        """Reason why new motions of the driver must wait; None if there is none.

        Its code is `ContactLost`, or the code of the correction of the leg that must be completed first.
        """
        if self._state.contact_lost:
            return NO_CONTACT
        active = self._state.motion
        motion = self.motion
        if active is None or motion is None or active.hover_at is not None:
            return None
        return motion.binding if self.autopilot.now < motion.binding_until else None

    @property
    def landing_place(self) -> tuple[float, float] | None:
        """Latitude and longitude at which the system lands the drone of the active mission; None: at home."""
        mission = self._state.mission
        return mission.land_at if mission is not None else None

    @property
    def constraints(self) -> FlightConstraints | None:
        """Constraints of the current system flight, or None."""
        flight = self._state.flight
        constraints = self._constraints
        if flight is None or constraints is None or constraints.flight_id != flight.flight_id:
            return None
        return constraints

    @property
    def mission_grant(self) -> ActiveGrant | None:
        """Grant of the current lease. Without a lease, Grant of the active mission if this Grant is in force."""
        lease = self.lease
        mission = self._state.mission
        if lease is not None:
            return lease.grant
        grant = self._grants.active.get(mission.identity) if mission is not None else None
        return grant if grant is not None and mission is not None and grant.key == mission.key else None

    @property
    def last_grant(self) -> ActiveGrant | None:
        """Grant of the mission, even if it was removed in flight or before a restart. Its constraints apply to the return flight."""
        return self.mission_grant or (self._removed if self._state.removed is not None else None)

    @property
    def retraces(self) -> bool:
        """True if the autopilot can return on the path it flew (SmartRTL)."""
        capable = self.failsafe_status is not None and self.failsafe_status.airframe.retraces
        return capable and not self.autopilot.vehicle.path_lost

    @property
    def cruise_mps(self) -> float:
        """Default speed of legs: the speed that the driver has set for its legs, otherwise the vehicle's parameter."""
        state = self._state
        corrects = state.motion is not None and state.motion.kind == CORRECTION
        if state.speed_mps is not None and state.authority is Authority.DRIVER and not corrects:
            return state.speed_mps
        return self.failsafe_status.speed_mps if self.failsafe_status is not None else SETTINGS.default_speed_mps

    def mission(self, grant: ActiveGrant) -> Mission:
        """Return the mission of a grant, or a new one if it is unknown."""
        return self._state.missions.get(grant.key) or Mission(grant.key, grant.identity)

    def is_valid(self, grant: ActiveGrant) -> bool:
        """Return True if the grant is still in force."""
        current = self._grants.active.get(grant.identity)
        return current is not None and current.key == grant.key

    def latest(self, grant: ActiveGrant) -> ActiveGrant:
        """Return the latest version of a grant; the given grant if it was removed."""
        return self._grants.active[grant.identity] if self.is_valid(grant) else grant

    def not_ready_reason(self, key: str) -> str | None:
        """Return why the drone cannot fly for a mission now, or None if it can."""
        vehicle = self.autopilot.vehicle
        located = vehicle.lat is not None and vehicle.home is not None and not vehicle.position_problem
        # In flight, a known status is sufficient, even if the failsafes cannot be verified at the moment.
        problem = "" if self.failsafe_status is None or vehicle.armed else self.failsafe_status.problem
        unverified = BEING_SET if self.failsafe_status is None else problem
        readiness = Readiness(
            unverified,
            vehicle.arming_refusal(self.autopilot.now),
            located,
            self.autopilot.link_problem,
            vehicle.identity_problem,
            self.awaited(key),
            NO_CONTACT.reason if self._state.contact_lost or self._depends_on_lost_contact(key) else "",
        )
        return not_ready_reason(self.state, key, readiness)

    def _depends_on_lost_contact(self, key: str) -> bool:
        grant = next((grant for grant in self._grants.active.values() if grant.key == key), None)
        return grant is not None and self.contact.lost(grant.spec.contact_lost)

    def awaited(self, key: str) -> str:
        """Return why a mission must not begin yet, or an empty string if it may begin or has begun."""
        mission = self._state.missions.get(key)
        if mission is not None and mission.flown:
            return ""
        return next((grant.spec.awaited for grant in self._grants.active.values() if grant.key == key), "")

    @property
    def arming_problem(self) -> str:
        """Reason why the motors could not be armed now by any caller; empty if there is none."""
        vehicle = self.autopilot.vehicle
        if not self.autopilot.connected:
            return vehicle.identity_problem or NOT_CONNECTED
        unverified = BEING_SET if self.failsafe_status is None else self.failsafe_status.problem
        if unverified:
            return f"the autopilot's failsafes are not verified: {unverified}"
        return vehicle.arming_refusal(self.autopilot.now) or self.autopilot.link_problem

    def note(self, action: str, reason: str, code: str = "") -> None:
        """Record an action of the system in the audit log."""
        self.effects.run_all((RecordAudit("control", action, "system", reason, code),))

    async def save(self, timeout_s: float | None = None) -> str:
        """Write the missions to the journal and return the reason of a failure, or an empty string."""
        await self._journal.save(record_of(self._state), timeout_s)
        return self._journal.failure

    # Drivers

    def open_lease(self, grant: ActiveGrant) -> Lease:
        """Create a lease for a driver that requests control.

        Raises:
            PreconditionFailed: The mission has ended, or another application has the drone.
        """
        lease = Lease(grant)
        self.effects.leases[lease.lease_id] = lease
        for action in self.dispatch(StreamOpened(lease.lease_id, grant.key, grant.identity)):
            if isinstance(action, RefuseStream):
                del self.effects.leases[lease.lease_id]
                raise PreconditionFailed(action.code, action.reason)
        return lease

    def grant_control(self, lease: Lease) -> None:
        """Grant control to a waiting driver."""
        if self.lease is lease:
            self.dispatch(GrantControl(lease.lease_id))

    def close_lease(self, lease: Lease) -> None:
        """End the lease of a driver whose stream ended."""
        self.dispatch(StreamClosed(lease.lease_id))
        self.effects.leases.pop(lease.lease_id, None)

    def drop_unresponsive_driver(self, lease: Lease, waited_s: float) -> None:
        """Take the drone from a driver that did not answer a liveness request for `waited_s` seconds."""
        self.dispatch(DriverUnresponsive(lease.lease_id, waited_s))

    def confirm_alive(self, grant: ActiveGrant, ping: int) -> None:
        """Store the answer of a driver to a liveness request. A driver without control needs no answer."""
        lease = self.lease
        if lease is not None and lease.key == grant.key:
            lease.confirm(ping)

    def require_control(self, grant: ActiveGrant) -> Lease:
        """Return the lease of a caller that moves the drone.

        Raises:
            PreconditionFailed: The caller does not have control.
            Unavailable: The autopilot is not connected.
        """
        lease = self.lease
        state = self.state
        if lease is None or lease.key != grant.key or not state.drives:
            reason = f"you do not have control of the drone, {component_name(state.controller)} has it; call GetControl first"
            raise PreconditionFailed("NotInControl", reason)
        if not self.autopilot.connected:
            raise Unavailable("AutopilotUnavailable", "the autopilot is not connected")
        return lease

    def driver_permit(self, grant: ActiveGrant, motion: Motion | None = None) -> Permit:
        """Return a permit that is valid while the driver has control.

        Args:
            grant: Grant of the driver.
            motion: Motion that sends the commands; None for calls that are not motions.
        """
        lease = self.lease

        def check() -> None:
            if motion is not None:
                motion.check()
            if self.require_control(grant) is not lease or not self.is_valid(grant):
                raise PreconditionFailed("ControlLost", "you do not have control of the drone any more")

        return check

    def transit_permit(self, lease: Lease, motion: Motion) -> Permit:
        """Return a permit for transit flights.

        The permit is valid while the driver that requested the transit is waiting.
        """

        def check() -> None:
            motion.check()
            if self.lease is not lease or self.authority is not Authority.SYSTEM or not self.is_valid(lease.grant):
                raise PreconditionFailed("ControlLost", "the driver no longer waits for the drone")

        return check

    def system_permit(self, constraints: FlightConstraints, motion: Motion) -> Permit:
        """Return a permit for flights without a driver. The permit is valid while no other party has the drone."""

        def check() -> None:
            motion.check()
            if (
                self.constraints is not constraints
                or self.authority is not Authority.SYSTEM
                or not self.is_valid(constraints.grant)
            ):
                raise PreconditionFailed("ControlLost", "the system no longer flies this mission")

        return check

    async def return_control(self, grant: ActiveGrant) -> bool:
        """End the control point of a driver. Return True if it was the last control point of the mission.

        Raises:
            Refused: The driver does not have control.
        """
        self.require_control(grant)
        points = len(grant.spec.control_points)
        paths = any(point.path for point in grant.spec.control_points)
        done = self.mission(grant).points_done
        path = grant.spec.control_points[done].path if done < points else None
        self.dispatch(ControlReturned(grant.key, points, paths, len(path or ())))
        last = self.mission(grant).points_done >= points
        await self.save()
        return last

    async def report_waypoints(self, grant: ActiveGrant, waypoints: int) -> None:
        """Record the number of waypoints that a driver has completed at its control point, and save it in the journal.

        Raises:
            Refused: The driver does not have control.
        """
        self.require_control(grant)
        self.dispatch(WaypointsDone(grant.key, waypoints))
        await self.save()

    def count_leg(self, grant: ActiveGrant, lat: float, lon: float, *, corrected: bool) -> None:
        """Record the end of a driver's leg, and the next waypoint of the path if the leg ended near it.

        Args:
            grant: Grant of the driver.
            lat: Latitude of the target.
            lon: Longitude of the target.
            corrected: True if a policy corrected the leg.
        """
        mission = self.mission(grant)
        points = grant.spec.control_points
        path = points[mission.points_done].path if mission.points_done < len(points) else None
        ahead = (path or ())[mission.waypoints : mission.waypoints + 1]
        near = any(
            math.hypot(*LocalFrame(lat, lon).xy(point.lat, point.lon)) <= SETTINGS.waypoint_radius_m for point in ahead
        )
        self.dispatch(WaypointsDone(grant.key, mission.waypoints + near, leg=True, corrected=corrected))

    def count_velocity_flight(self, grant: ActiveGrant) -> None:
        """Record a velocity setpoint of a driver. It counts as a completed leg, because a velocity flight has no target."""
        mission = self.mission(grant)
        if not mission.legs:
            self.dispatch(WaypointsDone(grant.key, mission.waypoints, leg=True))

    # Home: the position where the mission armed for its first takeoff. Altitudes are relative to home, and return flights end at home.

    @property
    def home_moved(self) -> bool:
        """True if another station moved home while the drone is in flight.

        It is False while a pilot has control, because a pilot may move home.

        Until home is restored, neither the altitude above home nor the destination of the autopilot's return is known.
        """
        vehicle = self.autopilot.vehicle
        state = self.state
        mission = state.mission
        if vehicle.home is None or mission is None or mission.home is None:
            return False
        if not vehicle.in_air or state.authority is Authority.PILOT:
            return False
        return _is_elsewhere(vehicle.home, mission.home)

    @property
    def home_altitude_inconsistent(self) -> bool:
        """True if altitudes are not measured from the ground at the start of the flight, because home is elsewhere.

        It is also True if home was not reported since the vehicle armed, and if a pilot moved home.
        """
        vehicle = self.autopilot.vehicle
        state = self.state
        ground = vehicle.ground_home
        if vehicle.home is None or not vehicle.in_air:
            return False
        origin = state.mission.home if state.mission is not None and not state.armed_by_others else None
        if origin is None and ground is not None:
            origin = ground.lat, ground.lon, ground.amsl_m
        return origin is None or _is_elsewhere(vehicle.home, origin)

    async def restore_home(self) -> None:
        """If home was moved, set it back to the position where the mission armed for its first takeoff.

        Raises:
            AutopilotError: The autopilot refused, or reported no new home.
        """
        mission = self.state.mission
        if mission is None or mission.home is None or not self.home_moved:
            return
        await self.autopilot.set_home(*mission.home)
        await self.autopilot.request_home()
        deadline = self.autopilot.now + SETTINGS.home_timeout_s
        while self.home_moved:
            if self.autopilot.now > deadline:
                raise AutopilotError("autopilot acknowledged DO_SET_HOME but sent no HOME_POSITION", link=True)
            await self.autopilot.update(SETTINGS.home_timeout_s)

    # System flights

    def begin_transit(self, grant: ActiveGrant) -> FlightConstraints:
        """Begin a transit flight for an application, and return the flight constraints."""
        constraints = self._constrain(grant)
        self.dispatch(TransitBegan(constraints.flight_id, grant.key, grant.identity))
        return constraints

    def begin_system_flight(self, grant: ActiveGrant) -> FlightConstraints:
        """Begin a flight of the system, and return its flight constraints, which follow from the grant."""
        constraints = self._constrain(grant)
        self.dispatch(SystemFlightBegan(constraints.flight_id, grant.key))
        return constraints

    def end_system_flight(self, constraints: FlightConstraints) -> None:
        """End the flight of the system that has these flight constraints."""
        self.dispatch(SystemFlightEnded(constraints.flight_id))

    def begin_tour(self, grant: ActiveGrant, work: Coroutine[Any, Any, None]) -> None:
        """Run a mission over points of interest as a system task. `work` dispatches the event that ends the mission."""
        self.dispatch(TourBegan(grant.key))
        if self._state.task is not None:
            self.effects.run_task(self._state.task, work)

    def _constrain(self, grant: ActiveGrant) -> FlightConstraints:
        grant = self.latest(grant)  # The caller may have waited since it read the grant.
        self._constraints = FlightConstraints(grant, self.for_transit(grant))
        return self._constraints

    def for_transit(self, grant: ActiveGrant) -> CompiledGrant:
        """Return the constraints of a grant for system flights."""
        if self._transit is None or self._transit[0] is not grant:
            self._transit = grant, compile_transit_grant(grant.spec, flat_terrain=grant.compiled.flat_terrain)
        return self._transit[1]

    # Motions

    def set_cruise_speed(self, speed_mps: float, leg_mps: float) -> None:
        """Set the speed of later legs to `speed_mps`, and the speed of the current leg to `leg_mps`."""
        self.dispatch(CruiseSpeedSet(speed_mps))
        motion = self.motion
        if motion is not None and motion.speed_mps is not None:
            motion.speed_mps = leg_mps

    def begin_motion(self, kind: str, permit: Callable[[Motion], Permit] = lambda _motion: always) -> Motion:
        """Begin a motion, which replaces the current motion.

        Raises:
            Exception: The permit of the new motion does not hold.
        """
        motion = Motion(kind)
        permit(motion)()
        self.dispatch(MotionBegan(motion.motion_id, kind))
        self.effects.motion = motion
        return motion

    def finish_motion(self, motion: Motion) -> None:
        """End a motion that completed or was stopped."""
        self.dispatch(MotionFinished(motion.motion_id))

    def cancel_motion(self, motion: Motion) -> None:
        """End a motion that its caller cancelled. The drone hovers, unless the driver is lost and the drone returns."""
        self.dispatch(MotionCancelled(motion.motion_id))

    def fail_motion(self, motion: Motion) -> None:
        """End a motion that failed. The drone hovers, because the autopilot may still be executing the motion."""
        self.dispatch(MotionFailed(motion.motion_id))

    def stop_motion(self, verdict: Verdict) -> None:
        """End the current motion, because another one replaces it."""
        self.dispatch(MotionStopped(verdict.code, verdict.reason, verdict.policies))

    # Policies and grants

    def check_contact(self) -> None:
        """React to lost or restored contact with the API server as the current mission requires."""
        grant = self.mission_grant
        demand = grant.spec.contact_lost if grant is not None else None
        self.contact.store(demand)
        if demand is None or demand.action == "continue" or not self.contact.lost(demand):
            self.dispatch(ContactRestored())
            return
        place = (demand.land_at.lat, demand.land_at.lon) if demand.land_at is not None else None
        reason = f"no contact with the API server for {self.contact.age_s:.0f} s"
        self.dispatch(ContactLost(demand.action, reason, place, tour=grant is not None and bool(grant.spec.tour)))

    def _update_contact_demand(self) -> None:
        self.contact.demand(grant.spec.contact_lost for grant in self._grants.active.values())

    def store_flown_grant(self) -> None:
        """Store the Grant of the flight in progress for a service that restarts. Remove it when the motors stop."""
        # Before the vehicle is found, it is unknown whether its motors run.
        if self._flown_grant is None or not self._state.decided:
            return
        if not self.autopilot.vehicle.armed:
            self._flown_grant.keep(None)
        elif self.last_grant is not None:
            self._flown_grant.keep(self.last_grant)

    def brake(self, verdict: Verdict) -> None:
        """Stop the current motion. The driver keeps control."""
        self.dispatch(BrakeDemanded(verdict.code, verdict.reason, verdict.policies))

    def take_over(self, verdict: Verdict) -> None:
        """Take the drone from its driver, as a policy or the monitor requires."""
        self.dispatch(
            TakeoverDemanded(
                verdict.takeover or "hover",
                verdict.code,
                verdict.reason,
                verdict.policies,
                self._landing_place(verdict) if verdict.takeover == "abort" else None,
            )
        )

    def _landing_place(self, verdict: Verdict) -> tuple[float, float] | None:
        """Return the landing place of the most restrictive policy of a verdict with the takeover `abort`."""
        grant = self.mission_grant
        aborting = {
            policy.name: policy.spec.land_at
            for policy in (grant.spec.policies if grant is not None else ())
            if policy.spec.action == "abort"
        }
        place = next((aborting[name] for name in verdict.policies if name in aborting), None)
        return (place.lat, place.lon) if place is not None else None

    def _grant_changed(self, old: ActiveGrant | None, new: ActiveGrant | None) -> None:
        self._update_contact_demand()
        lease = self.lease
        constraints = self.constraints
        if old is not None and new is not None and old.key == new.key:
            if lease is not None and lease.key == new.key:
                lease.grant = new
            if constraints is not None and constraints.grant.key == new.key:
                constraints.grant = new
                constraints.compiled = self.for_transit(new)
        self.dispatch(GrantChanged(_reference(old), _reference(new)))
        if old is not None and self._state.removed == old.key:
            self._removed = old


def _reference(grant: ActiveGrant | None) -> GrantRef | None:
    if grant is None:
        return None
    return GrantRef(grant.key, commands_vehicle=grant.spec.class_ == "driver" or bool(grant.spec.tour))


def _is_elsewhere(home: Home, origin: tuple[float, float, float]) -> bool:
    """Return True if home is farther than `home_moved_m` from the origin (latitude, longitude, metres above mean sea level)."""
    lat, lon, amsl_m = origin
    return math.hypot(*LocalFrame(lat, lon).xy(home.lat, home.lon), home.amsl_m - amsl_m) > SETTINGS.home_moved_m
