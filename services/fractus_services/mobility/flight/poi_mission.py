"""Missions without a driver: the system flies passengers through their points of interest, and home."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncGenerator, Callable

from fractus_core.api.geometry import Position
from fractus_core.api.names import component_name
from fractus_core.control import Outcome, OutcomeKind
from fractus_core.control.events import TourEnded, TourInterrupted, TourPointVisited
from fractus_core.control.state import COMPLETE

from fractus_services.errors import AutopilotError, Refused, Unavailable
from fractus_services.grant_files import ActiveGrant, GrantFiles
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.flight.route_following import INTERNAL_ERROR, RouteFollower, SystemFlight, target_of
from fractus_services.mobility.settings import SETTINGS

log = logging.getLogger(__name__)


class PoiMissions:
    """Starts the mission of a grant when the drone is ready and the passengers have connected. Resumes it after a restart.

    Args:
        control: Control state.
        grants: Grants of this node.
        launch: Arms and takes off to the altitude of a position. Yields the current step.
        routes: Flies the legs.
        boarding_s: Time for which a mission waits for its passengers after its grant has arrived, in seconds. Then it
            starts without them.
    """

    def __init__(
        self,
        control: ControlStore,
        grants: GrantFiles,
        launch: Callable[[SystemFlight, Position], AsyncGenerator[str, None]],
        routes: RouteFollower,
        boarding_s: float,
    ) -> None:
        self._control = control
        self._grants = grants
        self._launch = launch
        self._routes = routes
        self._boarding_s = boarding_s
        self._granted_at: dict[str, float] = {}
        self._connected: set[str] = set()

    def passenger_called(self, grant: ActiveGrant) -> None:
        """Record a call of a passenger. The passengers of its application then count as connected."""
        uid = grant.spec.application.uid
        if uid not in self._connected:
            self._connected.add(uid)
            self._control.changes.notify()

    async def run(self) -> None:
        """Start missions until cancelled."""
        control = self._control
        while True:
            grant = self._startable()
            if grant is not None:
                control.begin_tour(grant, self._run_mission(grant))
            await control.changes.wait(SETTINGS.poi_check_interval_s)

    def _startable(self) -> ActiveGrant | None:
        """Return the Grant of a mission that can start or resume now, or None."""
        control = self._control
        grants = [grant for grant in self._grants.active.values() if grant.spec.tour]
        self._granted_at = {grant.key: self._granted_at.get(grant.key, control.autopilot.now) for grant in grants}
        if control.lease is not None or control.state.touring is not None:
            return None
        return next((grant for grant in sorted(grants, key=lambda grant: grant.key) if self._may_start(grant)), None)

    def _may_start(self, grant: ActiveGrant) -> bool:
        control = self._control
        state = control.state
        mission = control.mission(grant)
        other = state.mission
        if mission.outcome is not None:
            return False
        if other is not None and other.key != grant.key and other.outcome is None:
            return False
        if control.not_ready_reason(grant.key) is not None or (state.vehicle.armed and not state.flies_for(grant.key)):
            return False
        connected = grant.spec.application.uid in self._connected
        return connected or mission.flown or control.autopilot.now - self._granted_at[grant.key] >= self._boarding_s

    async def _run_mission(self, grant: ActiveGrant) -> None:
        """Fly a mission as a system task, and dispatch its outcome.

        The state ignores the outcome if the mission has lost the drone.
        """
        control = self._control
        control.note("tour", f"{len(grant.spec.tour)} points of interest for {component_name(grant.identity)}")
        try:
            await self._visit(grant)
        except (Refused, AutopilotError) as error:
            if _is_transient(error) and control.mission(grant).flown:
                log.warning("poi: mission interrupted (identity=%s error=%s)", grant.identity, error)
                control.dispatch(TourInterrupted(grant.key, str(error)))
            else:
                self._end(grant, Outcome(OutcomeKind.FAILED, str(error)))
        except Exception:
            log.exception("poi: mission failed (identity=%s)", grant.identity)
            self._end(grant, Outcome(OutcomeKind.FAILED, INTERNAL_ERROR))
        else:
            self._end(grant, COMPLETE)
        finally:
            control.changes.notify()

    async def _visit(self, grant: ActiveGrant) -> None:
        """Fly to each point of interest that was not visited yet."""
        control = self._control
        constraints = control.begin_transit(grant)
        flight = SystemFlight(constraints, "Tour", lambda motion: control.system_permit(constraints, motion))
        access = grant.spec.points_of_interest
        stay_s = SETTINGS.poi_stay_s if access is not None and access.service_access == "points" else 0.0
        points = grant.spec.tour
        visited = control.mission(grant).waypoints
        try:
            async for step in self._launch(flight, points[min(visited, len(points) - 1)]):
                log.info("poi: %s (identity=%s)", step, grant.identity)
            for number in range(visited, len(points)):
                async for _ in self._routes.fly(flight, target_of(points[number])):
                    pass
                control.dispatch(TourPointVisited(grant.key, number + 1))
                await asyncio.sleep(stay_s)
        finally:
            control.end_system_flight(constraints)

    def _end(self, grant: ActiveGrant, outcome: Outcome) -> None:
        if self._control.dispatch(TourEnded(grant.key, outcome)):
            log.info("poi: mission ended (identity=%s outcome=%s)", grant.identity, outcome)


def _is_transient(error: Refused | AutopilotError) -> bool:
    """Return True if the autopilot was not connected, so that a later attempt may succeed."""
    if isinstance(error, AutopilotError):
        return error.link
    return isinstance(error, Unavailable)
