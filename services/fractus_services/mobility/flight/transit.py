"""Transit: the system flies drivers with partial control to the start of each control point."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator
from contextlib import aclosing

from fractus_core.api.components import ControlPoint
from fractus_core.api.geometry import Position
from fractus_core.control.events import TransitFailed
from fractus_core.geo import area_center
from fractus_core.policy.decision_types import Call, TakeoffArgs

from fractus_services.errors import AutopilotError, PreconditionFailed, Refused
from fractus_services.mobility.authority.arming import Arming
from fractus_services.mobility.authority.control_store import ControlStore
from fractus_services.mobility.authority.leases import Lease
from fractus_services.mobility.flight.courses import FAULT, Courses, Trip, above_home_m, target_of
from fractus_services.mobility.flight.guard import Guard
from fractus_services.mobility.flight.motions import climb

ARMING_TIMEOUT_S = 120.0
"""How long the system tries to arm a drone whose autopilot refuses."""

DEFAULT_ALTITUDE_M = 10.0
"""How high the system takes off, above home, when the place it flies to gives no altitude."""

log = logging.getLogger(__name__)


def start_of(point: ControlPoint) -> Position:
    """Where a control point begins; its altitude may be unset."""
    if point.point is not None and point.point.position is not None:
        return point.point.position
    if point.path:
        return point.path[0]
    if point.region is not None:
        centre = area_center(point.region)
        return Position(lat=centre.lat, lon=centre.lon)
    raise PreconditionFailed("NoStart", "the control point has neither position, path nor region")


class TransitFlight:
    """Arms, takes off and flies to where the driver takes over; judged by the same policies as a driver."""

    def __init__(self, control: ControlStore, arming: Arming, guard: Guard, courses: Courses) -> None:
        self._control = control
        self._arming = arming
        self._guard = guard
        self._courses = courses

    async def bring(self, lease: Lease) -> AsyncGenerator[str, None]:
        """Fly to the start of the driver's next control point.

        Yields:
            What is being done, for the waiting driver.

        Raises:
            Refused: the way there is not legal.
            AutopilotError: the autopilot refuses.
        """
        control = self._control
        start = start_of(lease.grant.spec.control_points[control.mission(lease.grant).points_done])
        constraints = control.begin_transit(lease.grant)
        trip = Trip(constraints, "Transit", lambda motion: control.transit_permit(lease, motion))
        try:
            async for doing in self.launch(trip, start):
                yield doing
            yield "the system flies to the control point"
            async for _ in self._courses.fly(trip, target_of(start)):
                pass
        except (Refused, AutopilotError):
            raise
        except Exception as error:
            log.exception("transit: flight failed (identity=%s)", lease.grant.identity)
            # After a fault of ours a retry would fail in the same way: the mission ends, and the drone comes home.
            control.dispatch(TransitFailed(lease.lease_id, FAULT))
            raise PreconditionFailed("ControlLost", FAULT) from error
        finally:
            control.end_system_flight(constraints)

    async def launch(self, trip: Trip, place: Position) -> AsyncGenerator[str, None]:
        """Arm and take off, unless the drone is in the air, to the altitude of a place.

        Yields:
            What is being done.

        Raises:
            Refused: policies or the drone's state forbid it.
            AutopilotError: the autopilot refuses.
        """
        control, autopilot = self._control, self._control.autopilot
        vehicle = autopilot.vehicle
        motion = control.begin_motion("Takeoff", trip.permit)
        permit = trip.permit(motion)
        try:
            # `standing` is the autopilot's own word, `in_air` counts doubt as flying: an armed drone on a raised pad is both.
            if vehicle.standing or not vehicle.in_air:
                yield "the system arms the drone"
                if vehicle.armed:
                    self._allow(Call("Arm"), trip)
                else:
                    grant = trip.constraints.grant
                    arming = self._arming.arm(grant, permit, lambda: self._allow(Call("Arm"), trip), ARMING_TIMEOUT_S)
                    async with aclosing(arming) as waiting:
                        async for why in waiting:
                            yield f"the system arms the drone: {why}"
                climbed = self._allow(Call("Takeoff", TakeoffArgs(self._height_m(place, trip))), trip)
                yield "the system takes off"
                await control.modes.enter_guided(permit)
                height = climbed.altitude_m if isinstance(climbed, TakeoffArgs) else DEFAULT_ALTITUDE_M
                async for _ in climb(autopilot, motion, height, permit):
                    pass
            await control.modes.enter_guided(permit)
        finally:
            control.finish_motion(motion)

    def _height_m(self, place: Position, trip: Trip) -> float:
        if place.alt is None:
            return DEFAULT_ALTITUDE_M
        home = self._control.autopilot.vehicle.home
        return above_home_m(place.alt, place.altitude_reference, home, trip.constraints.compiled)

    def _allow(self, call: Call, trip: Trip) -> object:
        verdict = self._guard.judge(call, trip.constraints.grant, trip.constraints.compiled)
        if not verdict.permits:
            raise PreconditionFailed(
                "ControlPointUnreachable", f"the system cannot bring the drone there: {verdict.reason}"
            )
        return verdict.args
