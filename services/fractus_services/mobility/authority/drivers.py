"""What drivers do with their lease: they ask for it, command with it, return it, or lose it with their stream."""

from __future__ import annotations

import math

from fractus_core.control.actions import RefuseStream
from fractus_core.control.events import (
    ControlReturned,
    GrantControl,
    StreamClosed,
    StreamOpened,
    WaypointsDone,
)
from fractus_core.geo import LocalFrame

from fractus_services.errors import PreconditionFailed, Unavailable
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.authority.control import Control
from fractus_services.mobility.authority.leases import Lease, Motion
from fractus_services.mobility.autopilot import Permit

WAYPOINT_M = 5.0
"""How near a leg must end to a waypoint of the driver's path to count as it."""


def open_lease(control: Control, grant: ActiveGrant) -> Lease:
    """A driver asks for control.

    Raises:
        PreconditionFailed: its mission is over, or another application has the drone.
    """
    lease = Lease(grant)
    control.leases[lease.lease_id] = lease
    for action in control.dispatch(StreamOpened(lease.lease_id, grant.key, grant.identity)):
        if isinstance(action, RefuseStream):
            del control.leases[lease.lease_id]
            raise PreconditionFailed(action.code, action.reason)
    return lease


def grant_control(control: Control, lease: Lease) -> None:
    """Give the drone to a driver that waits."""
    if control.lease is lease:
        control.dispatch(GrantControl(lease.lease_id))


def close_lease(control: Control, lease: Lease) -> None:
    """A driver's stream is over."""
    control.dispatch(StreamClosed(lease.lease_id))
    control.leases.pop(lease.lease_id, None)


def require(control: Control, grant: ActiveGrant) -> Lease:
    """The lease of a caller that moves the drone.

    Raises:
        Refused: it does not have the drone.
    """
    lease, state = control.lease, control.state
    if lease is None or lease.key != grant.key or not state.drives:
        reason = f"the drone is not yours: {state.controller} has it; use GetControl"
        raise PreconditionFailed("NotInControl", reason)
    if not control.autopilot.connected:
        raise Unavailable("AutopilotUnavailable", "the autopilot is not connected")
    return lease


def driver_permit(control: Control, grant: ActiveGrant, motion: Motion | None = None) -> Permit:
    """A driver's commands go only while it may still move the drone.

    Args:
        control: who has the drone.
        grant: the driver's grant.
        motion: the motion that commands; none for calls that are no motions.
    """
    lease = control.lease

    def check() -> None:
        if motion is not None:
            motion.check()
        if require(control, grant) is not lease or not control.valid(grant):
            raise PreconditionFailed("ControlLost", "the drone is not yours any more")

    return check


async def give_back(control: Control, grant: ActiveGrant) -> bool:
    """A driver returns control at the end of a control point; True when that was the last one."""
    require(control, grant)
    points = len(grant.spec.control_points)
    paths = any(point.path for point in grant.spec.control_points)
    control.dispatch(ControlReturned(grant.key, points, paths))
    last = control.mission(grant).points_done >= points
    await control.save()
    return last


async def report(control: Control, grant: ActiveGrant, waypoints: int) -> None:
    """A driver is done with the first waypoints of its task; on disk when this returns.

    Raises:
        PreconditionFailed: it does not have the drone.
    """
    require(control, grant)
    control.dispatch(WaypointsDone(grant.key, waypoints))
    await control.save()


def reached(control: Control, grant: ActiveGrant, lat: float, lon: float) -> None:
    """A leg of the driver has ended: count the waypoint, if it is the next one of the path."""
    mission, points = control.mission(grant), grant.spec.control_points
    path = points[mission.points_done].path if mission.points_done < len(points) else None
    ahead = (path or ())[mission.waypoints : mission.waypoints + 1]
    near = any(math.hypot(*LocalFrame(lat, lon).xy(one.lat, one.lon)) <= WAYPOINT_M for one in ahead)
    if near or not mission.leg_flown:
        control.dispatch(WaypointsDone(grant.key, mission.waypoints + near, leg=True))


def steered(control: Control, grant: ActiveGrant) -> None:
    """The driver steers by velocities, which have no end: they count as a leg."""
    mission = control.mission(grant)
    if not mission.leg_flown:
        control.dispatch(WaypointsDone(grant.key, mission.waypoints, leg=True))
