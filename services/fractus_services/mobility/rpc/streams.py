"""The streams of GetControl: drivers wait for the drone, drive it and leave; passengers ride along."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing

from fractus_services.errors import PolicyDenied, PreconditionFailed
from fractus_services.grants import ActiveGrant
from fractus_services.mobility.authority.control import Control
from fractus_services.mobility.authority.journal import Mission
from fractus_services.mobility.authority.leases import ControlEvent, ControlState, Lease

log = logging.getLogger(__name__)

WAIT_S = 0.5
TOLD_S = 5.0


class Streams:
    """Who asks for control, and what it is told.

    Args:
        control: the state machine of the drone.
        bring: flies the drone to where a driver with partial control takes over, and says what it does meanwhile.
    """

    def __init__(self, control: Control, bring: Callable[[Lease, Mission], AsyncGenerator[str, None]]) -> None:
        self._control = control
        self._bring = bring

    async def follow(self, grant: ActiveGrant) -> AsyncGenerator[ControlEvent, None]:
        """The events of a caller's stream.

        Raises:
            Refused: this caller gets neither the drone nor a ride.
        """
        events = self._ride(grant) if grant.spec.tour else self._drive(grant)
        async with aclosing(events) as running:
            async for event in running:
                yield event

    # Drivers

    async def _drive(self, grant: ActiveGrant) -> AsyncGenerator[ControlEvent, None]:
        """A driver has the drone from GRANTED until this is closed."""
        control = self._control
        mission = self._admit(grant)
        if control.lease is not None:
            control.lease.tell(ControlEvent(ControlState.LOST, reason="another stream of the same instance took over"))
        lease = control.lease = Lease(grant)
        try:
            while control.lease is lease and not lease.granted:
                async with aclosing(self._until_ready(lease, mission)) as waiting:
                    async for reason in waiting:
                        yield ControlEvent(ControlState.WAITING, mission.points_done, reason)
                if control.lease is lease and control.blocked_by(lease.key) is None:
                    yield control.hand_over(lease, mission)
            while True:
                try:
                    event = await lease.next(TOLD_S)
                except TimeoutError:
                    continue
                if event is None:
                    return
                yield event
                if event.final:
                    return
        finally:
            self._left(lease)

    def _admit(self, grant: ActiveGrant) -> Mission:
        control = self._control
        if grant.spec.class_ != "driver":
            raise PolicyDenied("NotADriver", "only a driver gets control; passengers ride along")
        mission = control.journal.mission(grant)
        _open(mission)
        other = control.lease
        if other is not None and other.key != grant.key and not other.granted and control.flies_for(grant.key):
            control.lose("another application has the drone")
        if (control.lease is not None and control.lease.key != grant.key) or control.taken(grant.key):
            raise PreconditionFailed("ControlHeld", "another application has the drone; try again when it is back")
        return mission

    async def _until_ready(self, lease: Lease, mission: Mission) -> AsyncGenerator[str, None]:
        control, said = self._control, ""
        while control.lease is lease:
            reason = control.blocked_by(lease.key)
            if control.taken(lease.key):
                raise PreconditionFailed("ControlHeld", "another application has the drone; try again when it is back")
            if reason is None:
                if lease.grant.spec.control != "partial":
                    return
                lease.transit = True
                async with aclosing(self._bring(lease, mission)) as flying:
                    async for event in flying:
                        yield event
                return
            if reason != said:
                said = reason
                yield reason
            await control.wait(WAIT_S)

    def _left(self, lease: Lease) -> None:
        """A driver's stream is over; without ReturnControl that means the driver is lost."""
        control = self._control
        if control.lease is not lease:
            return
        control.lease = None
        mission = control.journal.missions.get(lease.key)
        if mission is None or not (lease.granted or lease.transit):
            return
        control.authority = "system"
        control.note("driver lost", lease.grant.identity, "its stream broke")
        log.warning("driver %s is lost", lease.grant.identity)
        leaving = control.motion is not None and control.motion.kind in {"Land", "ReturnToLaunch"}
        coming_down = leaving and control.autopilot.vehicle.mode.comes_down
        control.stop_motion(PreconditionFailed("ControlLost", "the driver's stream broke"))
        if control.autopilot.vehicle.armed and not coming_down:
            control.start("hover")
        control.begin_grace(mission, "driver lost")

    # Passengers

    async def _ride(self, grant: ActiveGrant) -> AsyncGenerator[ControlEvent, None]:
        """A passenger whose points of interest the system visits is told how far it is; leaving changes nothing."""
        control = self._control
        mission = control.journal.mission(grant)
        _open(mission)
        said: ControlEvent | None = None
        while True:
            event = self._ridden(grant, mission)
            if event != said:
                said = event
                yield event
            if event.final:
                return
            await control.wait(WAIT_S)

    def _ridden(self, grant: ActiveGrant, mission: Mission) -> ControlEvent:
        done = mission.waypoints
        if mission.outcome == "complete":
            return ControlEvent(ControlState.COMPLETE, done, "every point of interest was visited", done)
        if mission.outcome:
            return ControlEvent(ControlState.LOST, done, mission.outcome, done)
        if self._control.touring == grant.key:
            return ControlEvent(ControlState.RIDING, done, "the system flies through the points of interest", done)
        return ControlEvent(
            ControlState.WAITING, done, self._control.blocked_by(grant.key) or "the system is about to take off", done
        )


def _open(mission: Mission) -> None:
    """Refuse who asks for a mission that is over.

    Raises:
        Refused: it is.
    """
    if mission.outcome == "complete":
        raise PreconditionFailed("MissionComplete", "the mission is complete")
    if mission.outcome:
        raise PreconditionFailed("ControlLost", f"the mission has ended ({mission.outcome})")
