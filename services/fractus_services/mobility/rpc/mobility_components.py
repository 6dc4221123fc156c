"""Construction of the mobility service: every component is complete when its constructor returns."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from fractus_core.control import ControlState
from fractus_core.control.state import FlightMode, TaskKind
from fractus_core.policy.return_route import return_bounds
from fractus_runtime.audit import AuditLog

from fractus_services.grant_files import ActiveGrant, GrantFiles
from fractus_services.mobility.authority.arming import Arming
from fractus_services.mobility.authority.contact import Contact, LastContactFile
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.flown_grant import FlownGrantFile
from fractus_services.mobility.authority.journal import Journal
from fractus_services.mobility.authority.supervisor import Supervisor
from fractus_services.mobility.authority.vehicle_observer import VehicleObserver
from fractus_services.mobility.autopilot import Autopilot, Failsafes, Fence, ReturnLimits, Safeguards
from fractus_services.mobility.flight.authorization import CallAuthorizer, PolicyGate
from fractus_services.mobility.flight.monitor import MotionMonitor
from fractus_services.mobility.flight.poi_mission import PoiMissions
from fractus_services.mobility.flight.return_to_launch import ReturnFlight
from fractus_services.mobility.flight.route_following import RouteFollower
from fractus_services.mobility.flight.service import MobilityService
from fractus_services.mobility.flight.transit import TransitFlight
from fractus_services.mobility.rpc.control_streams import ControlStreams


class MobilityComponents:
    """The components of one drone's mobility service.

    Args:
        autopilot: Autopilot interface.
        failsafes: Failsafes of the autopilot.
        fence: Fence of the vehicle.
        limits: Limits of the autopilot's own return.
        journal: Journal of missions.
        grants: Grants of this node.
        audit: Audit log.
        clock: Unix time.
        grace_s: Seconds within which a lost driver may come back.
        boarding_s: Seconds for which a mission over points of interest waits for its passengers.
        contact_file: Last contact with the API server on disk; None if it is not stored.
        flown_grant: Grant of the flight in progress on disk; None if it is not stored.
        state: Initial control state; by default only what the journal contains.
    """

    def __init__(
        self,
        autopilot: Autopilot,
        failsafes: Failsafes,
        fence: Fence,
        limits: ReturnLimits,
        *,
        journal: Journal,
        grants: GrantFiles,
        audit: AuditLog,
        clock: Callable[[], float],
        grace_s: float,
        boarding_s: float,
        contact_file: LastContactFile | None = None,
        flown_grant: FlownGrantFile | None = None,
        state: ControlState | None = None,
    ) -> None:
        # The control store starts return flights, which need the control store. So this function refers to the return
        # flight, which is created below.
        async def approach(kind: TaskKind, is_current: Callable[[], bool], attempts: int) -> FlightMode:
            return await return_flight.approach(kind, is_current, attempts)

        control = ControlStore(
            autopilot,
            journal,
            grants,
            audit,
            approach=approach,
            grace_s=grace_s,
            contact=Contact(lambda: autopilot.now, contact_file),
            flown_grant=flown_grant,
            state=state,
        )
        gate = PolicyGate(control, clock, audit)
        routes = RouteFollower(control, gate)
        return_flight = ReturnFlight(control, gate, routes)

        def limit_return(grant: ActiveGrant) -> Awaitable[tuple[str, ...]]:
            return limits.limit(return_bounds(gate.situation(), control.for_transit(grant)))

        safeguards = Safeguards(failsafes, fence, limit_return)
        arming = Arming(control, safeguards)
        transit = TransitFlight(control, arming, gate, routes)
        self.control = control
        self.gate = gate
        self.service = MobilityService(control, arming, CallAuthorizer(control, gate), return_flight)
        self.streams = ControlStreams(control, transit.bring)
        self.poi_missions = PoiMissions(control, grants, transit.launch, routes, boarding_s)
        self.supervisor = Supervisor(control, fence, limits)
        self.monitor = MotionMonitor(control, gate, audit, self.supervisor, return_flight)
        self.observer = VehicleObserver(control, safeguards)
        grants.listen(self.observer.grant_changed)
