"""Missions without a driver: the system flies passengers through their points of interest, and home."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncGenerator, Callable

from fractus_core.api.geometry import Position
from fractus_core.control import Outcome, OutcomeKind
from fractus_core.control.events import TourEnded, TourInterrupted, TourPointVisited
from fractus_core.control.state import COMPLETE

from fractus_services.errors import AutopilotError, Refused, Unavailable
from fractus_services.grant_files import ActiveGrant, GrantFiles
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.flight.courses import FAULT, Courses, Trip, target_of

log = logging.getLogger(__name__)

CHECK_S = 0.5
STAY_S = 5.0
"""How long the drone stays at a point of interest when passengers may use services only there."""


class Tours:
    """Begins a tour when its grant has come, the drone is ready and its passengers have connected; resumes after a restart.

    Args:
        control: the state machine of the drone.
        grants: grants of this node.
        launch: arms and takes off to the altitude of a place; says what it does.
        courses: flies the legs.
        boarding_s: a passenger that never calls the mobility service is flown this long after its grant came.
    """

    def __init__(
        self,
        control: ControlStore,
        grants: GrantFiles,
        launch: Callable[[Trip, Position], AsyncGenerator[str, None]],
        courses: Courses,
        boarding_s: float,
    ) -> None:
        self._control = control
        self._grants = grants
        self._launch = launch
        self._courses = courses
        self._boarding_s = boarding_s
        self._since: dict[str, float] = {}
        self._aboard: set[str] = set()

    def heard(self, grant: ActiveGrant) -> None:
        """A component called: the passengers of its application are there."""
        uid = grant.spec.application.uid
        if uid not in self._aboard:
            self._aboard.add(uid)
            self._control.changes.notify()

    async def run(self) -> None:
        """Look for tours to fly until cancelled."""
        control = self._control
        while True:
            grant = self._due()
            if grant is not None:
                control.begin_tour(grant, self._fly(grant))
            await control.changes.wait(CHECK_S)

    def _due(self) -> ActiveGrant | None:
        """The grant whose tour is to begin, or to go on."""
        control = self._control
        touring = [grant for grant in self._grants.active.values() if grant.spec.tour]
        self._since = {grant.key: self._since.get(grant.key, control.autopilot.now) for grant in touring}
        if control.lease is not None or control.state.touring is not None:
            return None
        return next((grant for grant in sorted(touring, key=lambda h: h.key) if self._may_begin(grant)), None)

    def _may_begin(self, grant: ActiveGrant) -> bool:
        control, state = self._control, self._control.state
        mission, other = control.mission(grant), state.mission
        if mission.outcome is not None:
            return False
        if other is not None and other.key != grant.key and other.outcome is None:
            return False
        if control.not_ready_reason(grant.key) is not None or (state.vehicle.armed and not state.flies_for(grant.key)):
            return False
        aboard = grant.spec.application.uid in self._aboard
        return aboard or mission.flown or control.autopilot.now - self._since[grant.key] >= self._boarding_s

    async def _fly(self, grant: ActiveGrant) -> None:
        """The system task of a tour. ControlStore counts how it ends only while the tour still has the drone."""
        control = self._control
        control.note("tour", f"{len(grant.spec.tour)} points of interest for {grant.identity}")
        try:
            await self._visit(grant)
        except (Refused, AutopilotError) as error:
            if _passing(error) and control.mission(grant).flown:
                log.warning("tours: tour interrupted (identity=%s, error=%s)", grant.identity, error)
                control.dispatch(TourInterrupted(grant.key, str(error)))
            else:
                self._end(grant, Outcome(OutcomeKind.FAILED, str(error)))
        except Exception:
            log.exception("tours: tour failed (identity=%s)", grant.identity)
            self._end(grant, Outcome(OutcomeKind.FAILED, FAULT))
        else:
            self._end(grant, COMPLETE)
        finally:
            control.changes.notify()

    async def _visit(self, grant: ActiveGrant) -> None:
        """Fly to each point that was not visited yet."""
        control = self._control
        constraints = control.begin_transit(grant)
        trip = Trip(constraints, "Tour", lambda motion: control.system_permit(constraints, motion))
        access = grant.spec.points_of_interest
        stay_s = STAY_S if access is not None and access.service_access == "points" else 0.0
        places, visited = grant.spec.tour, control.mission(grant).waypoints
        try:
            async for doing in self._launch(trip, places[min(visited, len(places) - 1)]):
                log.info("tours: %s (identity=%s)", doing, grant.identity)
            for number in range(visited, len(places)):
                async for _ in self._courses.fly(trip, target_of(places[number])):
                    pass
                control.dispatch(TourPointVisited(grant.key, number + 1))
                await asyncio.sleep(stay_s)
        finally:
            control.end_system_flight(constraints)

    def _end(self, grant: ActiveGrant, outcome: Outcome) -> None:
        if self._control.dispatch(TourEnded(grant.key, outcome)):
            log.info("tours: tour ended (identity=%s, outcome=%s)", grant.identity, outcome)


def _passing(error: Refused | AutopilotError) -> bool:
    """Whether a leg ended for a reason that may pass: the autopilot was not heard."""
    if isinstance(error, AutopilotError):
        return error.link
    return isinstance(error, Unavailable)
