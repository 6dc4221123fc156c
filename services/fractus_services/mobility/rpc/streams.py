"""The streams of GetControl: drivers wait for the drone, command it and leave; passengers ride along."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing

from fractus_core.control import ControlEvent, OutcomeKind, StreamState
from fractus_core.control.events import PassengerBoarded, TransitRequested
from fractus_core.control.state import ended_refusal

from fractus_services.errors import PolicyDenied, PreconditionFailed
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.leases import Lease

CHECK_S = 0.5
"""How often a waiting caller looks whether it can go on when nothing wakes it: the autopilot's readiness wakes no one."""

EVENT_TIMEOUT_S = 5.0


class Streams:
    """Who asks for control, and what it is told.

    Args:
        control: who has the drone.
        bring: flies the drone to where a driver with partial control takes over, and says what it does meanwhile.
    """

    def __init__(self, control: ControlStore, bring: Callable[[Lease], AsyncGenerator[str, None]]) -> None:
        self._control = control
        self._bring = bring

    def follow(self, grant: ActiveGrant) -> AsyncGenerator[ControlEvent, None]:
        """The events of a caller's stream.

        Raises:
            Refused: this caller gets neither the drone nor a ride.
        """
        return self._ride(grant) if grant.spec.tour else self._drive(grant)

    # Drivers

    async def _drive(self, grant: ActiveGrant) -> AsyncGenerator[ControlEvent, None]:
        """A driver has the drone from GRANTED until this is closed."""
        control = self._control
        if grant.spec.class_ != "driver":
            raise PolicyDenied("NotADriver", "only a driver gets control; passengers ride along")
        lease = control.open_lease(grant)
        try:
            while control.lease is lease and not control.state.granted:
                async with aclosing(self._until_ready(lease)) as waiting:
                    async for reason in waiting:
                        yield ControlEvent(StreamState.WAITING, control.mission(grant).points_done, reason)
                if control.not_ready_reason(lease.key) is None:
                    control.grant_control(lease)
            while True:
                try:
                    event = await lease.receive(EVENT_TIMEOUT_S)
                except TimeoutError:
                    continue
                if event is None:
                    return
                yield event
                if event.final:
                    return
        finally:
            control.close_lease(lease)

    async def _until_ready(self, lease: Lease) -> AsyncGenerator[str, None]:
        control, said = self._control, ""
        while control.lease is lease:
            reason = control.not_ready_reason(lease.key)
            if control.state.taken(lease.key):
                raise PreconditionFailed("ControlHeld", "another application has the drone; try again when it is back")
            if reason is None:
                if lease.grant.spec.control != "partial":
                    return
                control.dispatch(TransitRequested(lease.lease_id))
                async with aclosing(self._bring(lease)) as flying:
                    async for event in flying:
                        yield event
                return
            if reason != said:
                said = reason
                yield reason
            await control.changes.wait(CHECK_S)

    # Passengers

    async def _ride(self, grant: ActiveGrant) -> AsyncGenerator[ControlEvent, None]:
        """A passenger whose points of interest the system visits is told how far it is; leaving changes nothing."""
        control = self._control
        control.dispatch(PassengerBoarded(grant.key, grant.identity))
        outcome = control.mission(grant).outcome
        if outcome is not None:
            raise PreconditionFailed(*ended_refusal(outcome))
        said: ControlEvent | None = None
        while True:
            event = self._ridden(grant)
            if event != said:
                said = event
                yield event
            if event.final:
                return
            await control.changes.wait(CHECK_S)

    def _ridden(self, grant: ActiveGrant) -> ControlEvent:
        mission = self._control.mission(grant)
        done, outcome = mission.waypoints, mission.outcome
        if outcome is not None and outcome.kind is OutcomeKind.COMPLETE:
            return ControlEvent(StreamState.COMPLETE, done, "every point of interest was visited", done)
        if outcome is not None:
            return ControlEvent(StreamState.LOST, done, str(outcome), done)
        if self._control.state.touring == grant.key:
            return ControlEvent(StreamState.PASSENGER, done, "the system flies through the points of interest", done)
        reason = self._control.not_ready_reason(grant.key) or "the system is about to take off"
        return ControlEvent(StreamState.WAITING, done, reason, done)
