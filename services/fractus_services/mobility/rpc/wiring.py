"""How the parts of the mobility service are put together, each complete when it is made."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from fractus_core.control import ControlState
from fractus_core.policy.return_route import return_bounds
from fractus_runtime.audit import AuditLog

from fractus_services.grant_files import ActiveGrant, GrantFiles
from fractus_services.mobility.authority.arming import Arming
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.journal import Journal
from fractus_services.mobility.authority.situation import situation_of
from fractus_services.mobility.authority.supervisor import Supervisor
from fractus_services.mobility.authority.vehicle_observer import VehicleObserver
from fractus_services.mobility.autopilot import Autopilot, Failsafes, Fence, ReturnLimits
from fractus_services.mobility.flight.calls import CallJudge
from fractus_services.mobility.flight.courses import Courses
from fractus_services.mobility.flight.guard import Guard
from fractus_services.mobility.flight.homing import Homing
from fractus_services.mobility.flight.monitor import MotionMonitor
from fractus_services.mobility.flight.service import MobilityService
from fractus_services.mobility.flight.tours import Tours
from fractus_services.mobility.flight.transit import TransitFlight
from fractus_services.mobility.rpc.streams import Streams


class Parts:
    """The parts of one drone's mobility service.

    Args:
        autopilot: the link.
        failsafes: the autopilot's own.
        fence: the vehicle's own.
        limits: of the autopilot's own way home.
        journal: what survives a restart.
        grants: grants of this node.
        audit: where decisions are written.
        clock: Unix time.
        grace_s: how long a lost driver may take to come back.
        boarding_s: how long a tour waits for its passengers.
        state: of control, to begin with.
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
        state: ControlState | None = None,
    ) -> None:
        # ControlStore asks the mode controller to move the drone, and that tells control of each change; control asks for the way
        # home, which is flown under control. So these are looked up when they are called, which is after all are made.
        control = self.control = ControlStore(
            autopilot,
            journal,
            grants,
            audit,
            approach=lambda kind, wanted, tries: homing.approach(kind, wanted, tries),  # noqa: PLW0108
            grace_s=grace_s,
            state=state,
        )
        guard = self.guard = Guard(lambda: situation_of(control, clock()), audit)
        courses = Courses(control, guard)
        homing = Homing(control, guard, courses)

        def limit_return(grant: ActiveGrant) -> Awaitable[tuple[str, ...]]:
            return limits.limit(return_bounds(guard.situation(), control.for_transit(grant)))

        arming = Arming(control, failsafes, fence, limit_return)
        transit = TransitFlight(control, arming, guard, courses)
        self.service = MobilityService(control, arming, CallJudge(control, guard, control.require_control), homing)
        self.streams = Streams(control, transit.bring)
        self.tours = Tours(control, grants, transit.launch, courses, boarding_s)
        self.supervisor = Supervisor(control, fence, limits)
        self.monitor = MotionMonitor(control, guard, audit, self.supervisor, homing)
        self.observer = VehicleObserver(control, failsafes, fence, limit_return)
        grants.listen(self.observer.grant_changed)
