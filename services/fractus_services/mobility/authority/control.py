"""Who flies the drone: the driver that holds the lease, the system, or a human pilot (contract of a mission).

The system takes the drone whenever nobody else rightly has it, and never lets go of a flying drone before it is home
or a driver or pilot has it.
"""

from __future__ import annotations

import asyncio
import logging
import math
from typing import Literal

from fractus_core.geo import LocalFrame
from fractus_core.policy.compiled import CompiledGrant, for_transit
from fractus_core.policy.values import Takeover, Verdict

from fractus_services.audit import AuditLog
from fractus_services.background import Background
from fractus_services.errors import Aborted, AutopilotError, PreconditionFailed, Refused, Unavailable
from fractus_services.grants import ActiveGrant, GrantFiles
from fractus_services.mobility.authority.journal import Journal, Mission
from fractus_services.mobility.authority.leases import ControlEvent, ControlState, FlightConstraints, Lease, Motion
from fractus_services.mobility.mavlink.autopilot import Autopilot, Permit, always
from fractus_services.mobility.mavlink.failsafes import Checked
from fractus_services.mobility.mavlink.fence import MissionFence
from fractus_services.mobility.mavlink.mode_controller import ModeController

log = logging.getLogger(__name__)

Authority = Literal["driver", "system", "pilot"]

CORRECTION = "Correction"
"""What the motions are called with which the monitor leads a driver's drone back."""

WAYPOINT_M = 5.0
DEFAULT_SPEED_MPS = 5.0
"""Legs are taken to be flown so fast while the vehicle's parameters are not known."""


class Control:
    """The state machine of a drone's control.

    Args:
        autopilot: the link.
        journal: what survives a restart.
        grants: grants of this node.
        audit: where takeovers are written.
        fence: the vehicle's own fence.
        grace_s: how long a lost driver may take to come back.

    Attributes:
        decided: whether it is settled who has the vehicle, since its link came up last.
        began_at: when the last motion began, by the autopilot's clock.
        constraints: the fences under which the system flies an application's drone; None while it does not.
        touring: key of the mission without a driver that the system is flying.
    """

    def __init__(
        self,
        autopilot: Autopilot,
        journal: Journal,
        grants: GrantFiles,
        audit: AuditLog,
        *,
        fence: MissionFence,
        grace_s: float,
    ) -> None:
        self.autopilot = autopilot
        self.fence = fence
        self.journal = journal
        self.authority: Authority = "system"
        self.lease: Lease | None = None
        self.motion: Motion | None = None
        self.began_at = -math.inf
        self.checked: Checked | None = None
        self.speed_mps: float | None = None
        self.homeward = False
        self.constraints: FlightConstraints | None = None
        self.touring: str | None = None
        self._grants = grants
        self.audit = audit
        self._grace_s = grace_s
        self.modes = ModeController(autopilot, lambda: self.motion is not None)
        self.decided = False
        self.was_armed: bool | None = None
        self.system: asyncio.Task[None] | None = None
        self._grace: asyncio.Task[None] | None = None
        self._removed: ActiveGrant | None = None
        self._transit: tuple[ActiveGrant, CompiledGrant] | None = None
        self.tasks = Background()
        self._changed = asyncio.Event()
        grants.listen(self._grant_changed)

    @property
    def controller(self) -> str:
        """Who flies, as telemetry tells it."""
        if self.authority == "driver" and self.lease is not None:
            return self.lease.grant.identity
        return "pilot" if self.authority == "pilot" else "system"

    @property
    def mission_grant(self) -> ActiveGrant | None:
        """The grant under which the drone is in the air."""
        if self.lease is not None:
            return self.lease.grant
        mission = self.journal.flying
        grant = self._grants.of(mission.identity) if mission is not None else None
        return grant if grant is not None and mission is not None and grant.key == mission.key else None

    @property
    def last_grant(self) -> ActiveGrant | None:
        """The grant whose fences hold on the way home: the mission's, or what it was before it was taken away."""
        return self.mission_grant or self._removed

    @property
    def retraces(self) -> bool:
        """Whether the autopilot can fly home on the path that it came."""
        capable = self.checked is not None and self.checked.airframe.retraces
        return capable and not self.autopilot.vehicle.path_lost

    # Who may have the drone

    def flies_for(self, key: str) -> bool:
        """Whether the drone flies for a mission."""
        return self.autopilot.vehicle.armed and self.journal.active == key

    def taken(self, key: str) -> bool:
        """Whether the drone flies for another mission than this."""
        flying = self.journal.flying
        return flying is not None and flying.key != key and self.autopilot.vehicle.armed

    def blocked_by(self, key: str) -> str | None:
        """Why the drone cannot fly for a mission now; None when it can."""
        vehicle = self.autopilot.vehicle
        why = next((t for t in reversed(vehicle.texts) if t.startswith("PreArm")), "")
        reasons = (
            (not self.autopilot.connected, "the autopilot is not connected"),
            (not self.decided, "it is not known yet what the drone does"),
            (self.taken(key), "another application has the drone"),
            (self.checked is None, "the autopilot's failsafes are being set"),
            (self.authority == "pilot", f"a human pilot has the drone ({vehicle.mode.name})"),
            (self.homeward, "the system brings the drone home"),
            (not vehicle.armed and not vehicle.ready, f"the autopilot is not ready to arm{': ' if why else ''}{why}"),
            (vehicle.lat is None or vehicle.home is None, "position and home are not known yet"),
        )
        return next((reason for holds, reason in reasons if holds), None)

    async def wait(self, timeout_s: float) -> None:
        """Wait until something changed that drivers wait for, or for so long."""
        try:
            async with asyncio.timeout(timeout_s):
                await self._changed.wait()
        except TimeoutError:
            return

    def wake(self) -> None:
        """Let who waits look again."""
        self._changed.set()
        self._changed = asyncio.Event()

    def hand_over(self, lease: Lease, mission: Mission) -> ControlEvent:
        """The driver has the drone from now on."""
        self.stop_system()
        self.authority = "driver"
        lease.granted = True
        self.adopt(mission)
        self.note("granted", lease.grant.identity, f"control point {mission.points_done}")
        return ControlEvent(ControlState.GRANTED, mission.points_done, "", mission.waypoints)

    def adopt(self, mission: Mission) -> None:
        """The drone flies for this mission."""
        self._removed = None
        if self.journal.active != mission.key:
            self.speed_mps = None
        self.journal.active = mission.key
        self.journal.save_soon()

    def valid(self, grant: ActiveGrant) -> bool:
        """Whether a grant is still in force."""
        now = self._grants.of(grant.identity)
        return now is not None and now.key == grant.key

    def require(self, grant: ActiveGrant) -> Lease:
        """The lease of a caller that moves the drone.

        Raises:
            Refused: it does not have the drone.
        """
        lease = self.lease
        if lease is None or lease.key != grant.key or not self.drives(lease):
            raise PreconditionFailed(
                "NotInControl", f"the drone is not yours: {self.controller} has it; use GetControl"
            )
        if not self.autopilot.connected:
            raise Unavailable("AutopilotUnavailable", "the autopilot is not connected")
        return lease

    def drives(self, lease: Lease) -> bool:
        """Whether the driver of a lease has the drone."""
        return lease.granted and self.authority == "driver"

    async def give_back(self, grant: ActiveGrant) -> bool:
        """A driver returns control at the end of a control point; True when that was the last one."""
        lease = self.require(grant)
        mission = self.journal.mission(grant)
        mission.points_done, mission.waypoints = mission.points_done + 1, 0
        last = mission.points_done >= len(grant.spec.control_points)
        self.lease = None
        self.authority = "system"
        self.stop_motion(Aborted("ControlReturned", "control was returned"))
        self.note("returned", grant.identity, "the mission is complete" if last else "")
        if last:
            mission.outcome = "complete"
            lease.tell(ControlEvent(ControlState.COMPLETE, mission.points_done - 1, "every control point is done"))
            self.start("returnToLaunch")
        else:
            lease.tell(None)
            if self.autopilot.vehicle.armed:
                self.start("hover")
            self.begin_grace(mission, "driver did not ask for its next control point")
        await self.journal.save()
        return last

    def reached(self, grant: ActiveGrant, lat: float, lon: float) -> None:
        """A goto of the driver is complete: count the waypoint."""
        mission = self.journal.mission(grant)
        points = grant.spec.control_points
        path = points[mission.points_done].path if mission.points_done < len(points) else None
        if path and mission.waypoints < len(path):
            ahead = path[mission.waypoints]
            if math.hypot(*LocalFrame(ahead.lat, ahead.lon).xy(lat, lon)) <= WAYPOINT_M:
                mission.waypoints += 1
                self.journal.save_soon()

    # The system flies for an application

    def stop_system(self) -> None:
        """End what the system does with the drone, and a lost driver's grace."""
        self.tasks.drop(self._grace)
        self.tasks.drop(self.system)

    def begin_transit(self, grant: ActiveGrant, mission: Mission) -> FlightConstraints:
        """The system flies for an application, under its fences."""
        self.stop_system()
        self.authority = "system"
        self.adopt(mission)
        return self.begin_system_flight(grant)

    def begin_system_flight(self, grant: ActiveGrant) -> FlightConstraints:
        """What the system flies from now on keeps to the fences of a grant, as they are at each moment."""
        self.constraints = FlightConstraints(grant, self._for_transit(grant))
        return self.constraints

    def end_system_flight(self, constraints: FlightConstraints) -> None:
        """The system has stopped flying under these constraints."""
        if self.constraints is constraints:
            self.constraints = None

    def _for_transit(self, grant: ActiveGrant) -> CompiledGrant:
        if self._transit is None or self._transit[0] is not grant:
            self._transit = grant, for_transit(grant.spec, flat_terrain=grant.compiled.flat_terrain)
        return self._transit[1]

    # Motions

    @property
    def cruise_mps(self) -> float:
        """The speed of legs that name none: the driver's on what the driver flies, else the vehicle's own."""
        corrects = self.motion is not None and self.motion.kind == CORRECTION
        if self.speed_mps is not None and self.authority == "driver" and not corrects:
            return self.speed_mps
        return self.checked.speed_mps if self.checked is not None else DEFAULT_SPEED_MPS

    def cruise(self, speed_mps: float, leg_mps: float) -> None:
        """Fly legs with this speed from now on, and the one under way with another: what is allowed all along it."""
        self.speed_mps = speed_mps
        if self.motion is not None and self.motion.speed_mps is not None:
            self.motion.speed_mps = leg_mps

    def begin(self, kind: str) -> Motion:
        """Start a motion; the one under way is replaced."""
        self.stop_motion(Aborted("Replaced", f"{kind} replaced it"))
        self.motion, self.began_at = Motion(kind), self.autopilot.now
        return self.motion

    def finish(self, motion: Motion) -> None:
        """A motion is complete, or over."""
        if self.motion is motion:
            self.motion = None

    def cancelled(self, motion: Motion) -> None:
        """The caller of a motion gave it up: hover, unless the driver is gone and the drone comes home anyway."""
        if self.motion is motion:
            self.tasks.spawn(self._hover_after(motion))

    async def _hover_after(self, motion: Motion) -> None:
        if motion.kind in {"Land", "ReturnToLaunch"}:
            await asyncio.sleep(0.3)
        if self.motion is motion and self.authority == "driver":
            self.motion = None
            motion.stop(Aborted("Cancelled", "the call was cancelled"))
            await self.tasks.attempt(self.hold, self.still)

    def failed(self, motion: Motion) -> None:
        """A motion ended with an error, and the autopilot may fly on for it: hover."""
        if self.motion is motion:
            self.motion = None
            if self.authority == "driver" and self.autopilot.vehicle.in_air:
                self.tasks.spawn(self.tasks.attempt(self.hold, self.still))

    def still(self) -> None:
        """Permits what a driver's drone does after its motion: nothing else has begun.

        Raises:
            AutopilotError: somebody else flies by now.
        """
        if self.motion is not None or self.authority != "driver":
            raise AutopilotError("somebody else flies by now")

    def stop_motion(self, why: Refused) -> None:
        """End the motion under way."""
        if self.motion is not None:
            self.motion.stop(why)
            self.motion = None

    async def hold(self, permit: Permit = always) -> None:
        """Brake and hover."""
        await self.modes.hold(permit)
        self.tasks.spawn(self.modes.settle())

    # The system

    def brake(self, verdict: Verdict) -> None:
        """Stop the present motion; the driver keeps the drone."""
        self.note("brake", self.controller, verdict.reason, verdict.code, policies=verdict.policies)
        # A position that is not known now may be known in a moment.
        passing = verdict.code == "PositionUnknown"
        self.stop_motion(
            Unavailable("AutopilotUnavailable", verdict.reason)
            if passing
            else Aborted(verdict.code, verdict.reason, verdict.policies)
        )
        self.autopilot.stop()
        self.tasks.spawn(self.modes.settle())

    def take_over(self, verdict: Verdict) -> None:
        """The system takes the drone from its driver, as a policy or the monitor says."""
        action: Takeover = verdict.takeover or "hover"
        outcome = {"revoke": "revoked", "land": "failed", "returnToLaunch": "failed", "hover": ""}[action]
        self._seize("returnToLaunch" if action == "revoke" else action, verdict, outcome)

    def _seize(self, action: Takeover, verdict: Verdict, outcome: str) -> None:
        mission = self.journal.flying
        log.warning("the system takes the drone (%s): %s", action, verdict.reason)
        self.note(action, "system", verdict.reason, verdict.code, policies=verdict.policies, kind="takeover")
        self.lose(verdict.reason)
        self.authority = "system"
        if mission is not None and outcome and not mission.outcome:
            mission.outcome = f"{outcome}: {verdict.reason}"
            self.journal.save_soon()
        self.start(action)
        if mission is not None and not mission.outcome:
            self.begin_grace(mission, verdict.reason)

    def lose(self, reason: str) -> None:
        """Take the lease from the driver and tell it why."""
        lease, self.lease = self.lease, None
        self.stop_motion(PreconditionFailed("ControlLost", reason))
        self.tasks.drop(self._grace)
        if lease is not None:
            lease.tell(ControlEvent(ControlState.LOST, reason=reason))
        self.wake()

    def start(self, action: Takeover) -> None:
        """Begin what the system wants of the drone; what it did before ends."""
        self.tasks.drop(self.system)
        self.touring = None
        self.homeward = action != "hover" and self.autopilot.vehicle.armed
        self.system = self.tasks.spawn(self.act(action))

    async def act(self, action: Takeover) -> None:
        """Carry out what the system wants, as long as it has the drone."""
        await self.modes.carry_out(action, lambda: self.authority == "system")
        if action != "hover":
            self.homeward = False
            self.wake()

    @property
    def graced(self) -> bool:
        """Whether a lost driver has time left to come back."""
        return self._grace is not None and not self._grace.done()

    def begin_grace(self, mission: Mission, why: str) -> None:
        """Give a lost driver its time to come back; then the mission has failed."""
        self.tasks.drop(self._grace)
        if mission.flown or self.autopilot.vehicle.armed:
            self._grace = self.tasks.spawn(self._give_up(mission, why))

    async def _give_up(self, mission: Mission, why: str) -> None:
        await asyncio.sleep(self._grace_s)
        if mission.outcome:
            return
        mission.outcome = f"failed: {why}"
        log.warning("mission of %s failed: %s", mission.identity, why)
        self.note("returnToLaunch", "system", why, "DriverLost", kind="takeover")
        if self.authority == "system" and not self.homeward:
            self.start("returnToLaunch")
        self.journal.save_soon()

    # ControlEvent

    def in_air(self) -> None:
        """Remember that the mission flies."""
        mission = self.journal.flying
        if mission is not None and not mission.flown and self.authority != "pilot":
            mission.flown = True
            self.journal.save_soon()

    def _grant_changed(self, old: ActiveGrant | None, new: ActiveGrant | None) -> None:
        if old is not None and new is not None and old.key == new.key:
            if self.lease is not None and self.lease.key == new.key:
                self.lease.grant = new
            if self.constraints is not None and self.constraints.grant.key == new.key:
                self.constraints.grant, self.constraints.compiled = new, self._for_transit(new)
            return
        self.wake()
        if old is None or not (old.spec.class_ == "driver" or old.spec.tour):
            return
        mission = self.journal.missions.get(old.key)
        concerned = (self.lease is not None and self.lease.key == old.key) or self.journal.active == old.key
        if mission is None or mission.outcome or not concerned:
            return
        verdict = Verdict("takeover", None, "GrantRevoked", "the grant was removed", (), "revoke")
        self.journal.active, self._removed = self.journal.active or old.key, old
        if self.authority == "pilot":
            mission.outcome = "revoked: the grant was removed"
            self.journal.save_soon()
        else:
            self._seize("returnToLaunch", verdict, "revoked")

    # Plumbing

    def note(
        self, what: str, who: str, reason: str, code: str = "", *, policies: tuple[str, ...] = (), kind: str = "control"
    ) -> None:
        """Write a change of control to the audit log."""
        vehicle = self.autopilot.vehicle
        self.audit.append(
            kind,
            {
                "action": what, "controller": who, "reason": reason, "code": code, "policies": list(policies),
                "lat": vehicle.lat, "lon": vehicle.lon, "alt": vehicle.altitude_m,
            },
        )  # fmt: skip
