"""Transit flights: the system flies drivers with partial control to the start of each control point."""

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
from fractus_services.mobility.authority.effects import Lease
from fractus_services.mobility.flight.authorization import PolicyGate
from fractus_services.mobility.flight.motions import climb
from fractus_services.mobility.flight.route_following import (
    INTERNAL_ERROR,
    RouteFollower,
    SystemFlight,
    above_home_m,
    target_of,
)
from fractus_services.mobility.settings import SETTINGS

log = logging.getLogger(__name__)


def start_of(point: ControlPoint) -> Position:
    """Return the start of a control point. Its altitude may be unset."""
    if point.point is not None and point.point.position is not None:
        return point.point.position
    if point.path:
        return point.path[0]
    if point.region is not None:
        center = area_center(point.region)
        return Position(lat=center.lat, lon=center.lon)
    raise PreconditionFailed("NoStart", "the control point has no position, path or region")


class TransitFlight:
    """Arms, takes off and flies to the start of a control point. The policies are the same as for a driver."""

    def __init__(self, control: ControlStore, arming: Arming, gate: PolicyGate, routes: RouteFollower) -> None:
        self._control = control
        self._arming = arming
        self._gate = gate
        self._routes = routes

    async def bring(self, lease: Lease) -> AsyncGenerator[str, None]:
        """Fly to the start of the driver's next control point.

        Yields:
            The current step, for the waiting driver.

        Raises:
            Refused: There is no legal route.
            AutopilotError: The autopilot refused.
        """
        control = self._control
        start = start_of(lease.grant.spec.control_points[control.mission(lease.grant).points_done])
        constraints = control.begin_transit(lease.grant)
        flight = SystemFlight(constraints, "Transit", lambda motion: control.transit_permit(lease, motion))
        try:
            async for step in self.launch(flight, start):
                yield step
            yield "the system flies to the control point"
            async for _ in self._routes.fly(flight, target_of(start)):
                pass
        except (Refused, AutopilotError):
            raise
        except Exception as error:
            log.exception("transit: flight failed (identity=%s)", lease.grant.identity)
            # A retry would fail in the same way after an internal error: the mission ends and the drone returns.
            control.dispatch(TransitFailed(lease.lease_id, INTERNAL_ERROR))
            raise PreconditionFailed("ControlLost", INTERNAL_ERROR) from error
        finally:
            control.end_system_flight(constraints)

    async def launch(self, flight: SystemFlight, target: Position) -> AsyncGenerator[str, None]:
        """Arm and take off to the altitude of a position, unless the drone is in the air.

        Yields:
            The current step.

        Raises:
            Refused: Policies or the state of the drone forbid it.
            AutopilotError: The autopilot refused.
        """
        control = self._control
        autopilot = control.autopilot
        vehicle = autopilot.vehicle
        motion = control.begin_motion("Takeoff", flight.permit)
        permit = flight.permit(motion)
        try:
            # For an armed drone on a raised pad both properties are True, because `in_air` also considers the altitude.
            if vehicle.reports_on_ground or not vehicle.in_air:
                yield "the system arms the drone"
                if vehicle.armed:
                    self._allow(Call("Arm"), flight)
                else:
                    grant = flight.constraints.grant
                    arming = self._arming.arm(
                        grant, permit, lambda: self._allow(Call("Arm"), flight), SETTINGS.transit_arming_timeout_s
                    )
                    async with aclosing(arming) as waiting:
                        async for reason in waiting:
                            yield f"the system arms the drone: {reason}"
                allowed = self._allow(Call("Takeoff", TakeoffArgs(self._altitude_m(target, flight))), flight)
                yield "the system takes off"
                await control.modes.change_mode(autopilot.stack.guided, permit)
                altitude_m = (
                    allowed.altitude_m if isinstance(allowed, TakeoffArgs) else SETTINGS.default_takeoff_altitude_m
                )
                async for _ in climb(autopilot, motion, altitude_m, permit):
                    pass
            await control.modes.change_mode(autopilot.stack.guided, permit)
        finally:
            control.finish_motion(motion)

    def _altitude_m(self, target: Position, flight: SystemFlight) -> float:
        if target.alt is None:
            return SETTINGS.default_takeoff_altitude_m
        home = self._control.autopilot.vehicle.home
        return above_home_m(target.alt, target.altitude_reference, home, flight.constraints.compiled)

    def _allow(self, call: Call, flight: SystemFlight) -> object:
        verdict = self._gate.judge(call, flight.constraints.grant, flight.constraints.compiled)
        if not verdict.permits:
            raise PreconditionFailed(
                "ControlPointUnreachable", f"the system cannot fly to the control point: {verdict.reason}"
            )
        return verdict.args
