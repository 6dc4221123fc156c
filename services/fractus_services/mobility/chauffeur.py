"""The system's own flying for drivers with partial control: to the start of each control point."""

from __future__ import annotations

from collections.abc import AsyncIterator

from fractus_core.api.applications import ControlPoint
from fractus_core.api.geometry import Point
from fractus_core.api.methods import MOBILITY_METHODS
from fractus_core.api.plans import GrantSpec
from fractus_core.geo import middle
from fractus_core.policy.compiled import CompiledGrant, compile_grant
from fractus_core.policy.values import Args, Call, GotoArgs, TakeoffArgs, Verdict

from fractus_services.grants import Held
from fractus_services.mobility.arming import arm
from fractus_services.mobility.control import Control
from fractus_services.mobility.guard import Guard
from fractus_services.mobility.journal import Mission
from fractus_services.mobility.leases import Lease
from fractus_services.mobility.motions import REACHED_M, climb, fly_to
from fractus_services.mobility.permits import transit_permit
from fractus_services.mobility.vehicle import GUIDED
from fractus_services.replies import precondition

CRUISE_M = 10.0


def start_of(point: ControlPoint) -> tuple[Point, float | None]:
    """Where a control point begins, and at what altitude above home."""
    if point.point is not None and point.point.position is not None:
        return point.point.position, point.point.position.alt
    if point.path:
        return point.path[0], point.path[0].alt
    if point.region is not None:
        return middle(point.region), None
    raise precondition("NoStart", "the control point has neither position, path nor region")


def transit_grant(held: Held) -> CompiledGrant:
    """The grant under which the system itself flies: the application's fences, all methods, and the way to its area."""
    services = [{"service": "mobility", "methods": list(MOBILITY_METHODS)}]
    body = {**held.spec.to_dict(), "services": services, "control": "full"}
    return compile_grant(GrantSpec.model_validate(body), flat_terrain=held.compiled.flat_terrain)


class Chauffeur:
    """Arms, takes off and flies to where the driver takes over; judged like anybody else."""

    def __init__(self, control: Control, guard: Guard) -> None:
        self._control = control
        self._guard = guard

    async def bring(self, lease: Lease, mission: Mission) -> AsyncIterator[str]:
        """Fly to the start of the driver's next control point.

        Yields:
            What is being done, for the waiting driver.

        Raises:
            Refused: the way there is not legal.
            AutopilotError: the autopilot refuses.
        """
        control, autopilot = self._control, self._control.autopilot
        vehicle = autopilot.vehicle
        point = lease.held.spec.control_points[mission.points_done]
        start, altitude = start_of(point)
        control.begin_transit(lease, mission, transit_grant)
        motion = control.begin("Transit")
        permit = transit_permit(control, lease, motion)
        try:
            if vehicle.standing or not vehicle.in_air:
                yield "the system arms the drone"
                self._allow(Call("Arm"), lease)
                if not vehicle.armed:
                    await arm(control, lease.held, permit)
                climbed = self._allow(Call("Takeoff", TakeoffArgs(altitude or CRUISE_M)), lease)
                yield "the system takes off"
                height = climbed.altitude_m if isinstance(climbed, TakeoffArgs) else CRUISE_M
                async for _ in climb(autopilot, motion, height, permit):
                    pass
            yield "the system flies to the control point"
            await control.helm.change_mode(GUIDED, permit)
            goto = Call("Goto", GotoArgs(start.lat, start.lon, altitude))
            target = self._allow(goto, lease)
            if isinstance(target, GotoArgs) and target.speed_mps is not None:
                await autopilot.set_speed(target.speed_mps, permit)
                target = self._allow(goto, lease)
            if isinstance(target, GotoArgs):
                async for _ in fly_to(autopilot, motion, target, REACHED_M, permit):
                    pass
        finally:
            control.finish(motion)
            control.end_transit()

    def _allow(self, call: Call, lease: Lease) -> Args:
        verdict: Verdict = self._guard.judge(call, lease.held, self._control.chauffeured)
        if not verdict.permits:
            raise precondition("ControlPointUnreachable", f"the system cannot bring the drone there: {verdict.reason}")
        return verdict.args
