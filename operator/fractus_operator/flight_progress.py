"""State of a flight plan during its flight, from its Application and its drone. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import shapely
from fractus_core.airspace import Volume4D
from fractus_core.airspace.plan_status import reserved_volume, volume_of
from fractus_core.api import InvalidObject
from fractus_core.api.flight_plans import FlightPlanStatus, PlanState, ReservedVolume
from fractus_core.api.geometry import Area, Circle, Position
from fractus_core.api.plans import MissionRecord
from fractus_core.geo import ground_point

OUTSIDE_M = 5.0
"""Distance from its volumes at which a drone is outside them, in metres: the error of a reported position."""

OFF_NOMINAL_RADIUS_M = 1000.0
"""Radius around the position of a drone outside its volumes in which the drone may be, in metres."""

OFF_NOMINAL_S = 600.0
"""Seconds for which off-nominal volumes are reserved. They are renewed when half of the time has passed."""


_LOST = "its Drone was deleted and has not reported since, so the airspace stays reserved until it reports a landing"


@dataclass(frozen=True, slots=True)
class FlownMission:
    """The Application of a flight plan, as observed.

    Attributes:
        started: True if the Application was created at any time.
        exists: True if it exists.
        leaving: True if it is being deleted.
        digest: Digest of its mission, or None if it does not exist or is invalid.
        record: Record of its mission, or None before the takeoff.
        drone_exists: True if the Drone of the plan exists.
        in_air: True if the drone of the plan is in the air.
        lost: True if the Drone was deleted, or has not reported its state since it was created again. Such a drone may be in
            the air, also if this operator has not observed its takeoff.
        unreported: True if the drone may have taken off for the plan since its last report.
        position: Last reported position of the drone.
        home_m: Ground elevation of the home of the drone above mean sea level, if known.
    """

    started: bool = False
    exists: bool = False
    leaving: bool = False
    digest: str | None = None
    record: MissionRecord | None = None
    drone_exists: bool = True
    in_air: bool = False
    lost: bool = False
    unreported: bool = False
    position: Position | None = None
    home_m: float | None = None

    @property
    def amsl_m(self) -> float | None:
        """Altitude of the drone above mean sea level, or None if it is unknown."""
        position = self.position
        if position is None or position.alt is None:
            return None
        if position.altitude_reference == "amsl":
            return position.alt
        if position.altitude_reference == "home" and self.home_m is not None:
            return position.alt + self.home_m
        return None


@dataclass(frozen=True, slots=True)
class Progress:
    """State of an activated plan.

    Attributes:
        state: The state.
        message: One sentence.
        end: True if the Application must be deleted, so that the drone returns.
    """

    state: PlanState
    message: str
    end: bool = False


def flight_progress(
    mission: FlownMission, state: PlanState, status: FlightPlanStatus, *, closing: bool, now_s: float
) -> Progress:
    """Return the state of a plan whose Application was created.

    Args:
        mission: The Application and its drone.
        state: Present state. A plan never leaves the state Contingent before its end.
        status: Status with the volumes in force.
        closing: True if the user ends the plan.
        now_s: Time in seconds since 1970 UTC.
    """
    outcome = mission.record.outcome if mission.record is not None else None
    over = outcome is not None or not mission.exists
    end_s = max((volume.end.timestamp() for volume in status.volumes), default=now_s)
    late = now_s > end_s
    # The objects of a mission that is over stay, so that its logs can be read.
    end = not over and not mission.leaving and (closing or late)
    if mission.in_air or mission.lost:
        aborted = outcome != "Complete" and (over or closing or mission.leaving)
        return _airborne(mission, state, status, late=late, aborted=aborted, end=end)
    if over and mission.unreported:
        message = f"{status.drone} may be in the air, because it has not reported since the end of its mission"
        return Progress("Contingent", message)
    if over:
        return Progress("Ended", _result(mission))
    if end or mission.leaving:
        return Progress(state, "the flight ends: its Application is being deleted", end)
    kept: PlanState = "Contingent" if state == "Contingent" else "Activated"
    return Progress(kept, f"{status.drone} is on the ground, and its flight has not ended")


def _airborne(
    mission: FlownMission, state: PlanState, status: FlightPlanStatus, *, late: bool, aborted: bool, end: bool
) -> Progress:
    if state == "Contingent" or aborted:
        message = f"the system ends the flight of {status.drone}: {_result(mission)}"
        return Progress("Contingent", f"{message}; {_LOST}" if mission.lost else message, end)
    if mission.lost and not late:
        return Progress("Activated", f"{status.drone} may be in the air: {_LOST}")
    if outside(mission, status):
        return Progress("Nonconforming", f"{status.drone} is outside the volumes of the plan", end)
    if late:
        return Progress("Nonconforming", f"{status.drone} is in the air after the end of the window", end)
    return Progress("Activated", f"{status.drone} is in the air")


def outside(mission: FlownMission, status: FlightPlanStatus) -> bool:
    """Return True if the reported position of a drone is in none of the volumes of its plan. Times are ignored."""
    position = mission.position
    if position is None:
        return False
    for volume in map(volume_of, status.volumes):
        shape = volume.in_frame(volume.frame)
        near = shapely.distance(shape, shapely.Point(volume.frame.xy(position.lat, position.lon))) <= OUTSIDE_M
        height = mission.amsl_m
        level = height is None or volume.lower_m - OUTSIDE_M <= height <= volume.upper_m + OUTSIDE_M
        if near and level:
            return False
    return True


def off_nominal_volumes(mission: FlownMission, status: FlightPlanStatus, now_s: float) -> tuple[ReservedVolume, ...]:
    """Return the volumes in which a drone that does not keep to its plan may be.

    These are the volumes of the plan for longer, and the surroundings of a drone outside them. Present off-nominal volumes
    are kept while they are valid, so that the status is not written at each report.
    """
    present = status.off_nominal_volumes
    away = outside(mission, status)
    ends = [volume.end.timestamp() for volume in present]
    if ends and min(ends) - now_s > OFF_NOMINAL_S / 2 and (not away or _surrounds(present[-1], mission.position)):
        return present
    until_s = now_s + OFF_NOMINAL_S
    made = []
    for volume in map(volume_of, status.volumes):
        end_s = max(volume.end_s, until_s)
        made.append(_lasting(volume, end_s))
    if away and mission.position is not None:
        area = Area(circle=Circle(center=ground_point(mission.position), radius=OFF_NOMINAL_RADIUS_M))
        made.append(Volume4D.of_area(area, lower_m=float("-inf"), upper_m=float("inf"), begin_s=now_s, end_s=until_s))
    return tuple(map(reserved_volume, made))


def _lasting(volume: Volume4D, end_s: float) -> Volume4D:
    return Volume4D.of_corners(
        volume.areas(), lower_m=volume.lower_m, upper_m=volume.upper_m, begin_s=volume.begin_s, end_s=end_s
    )


def _surrounds(volume: ReservedVolume, position: Position | None) -> bool:
    """Return True if a position is at least half of `OFF_NOMINAL_RADIUS_M` within a volume."""
    if position is None:
        return True
    try:
        stored = volume_of(volume)
    except InvalidObject:
        return False
    inner = stored.in_frame(stored.frame).buffer(-OFF_NOMINAL_RADIUS_M / 2)
    return bool(shapely.contains_xy(inner, *stored.frame.xy(position.lat, position.lon)))


def _result(mission: FlownMission) -> str:
    record = mission.record
    if record is not None and record.outcome is not None:
        return record.message or f"the mission is {record.outcome}"
    if not mission.exists:
        return "the Application was deleted"
    return "the plan was ended"
