"""Routes of drones: descriptor, state and free windows."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from datetime import UTC, datetime, timedelta
from http import HTTPStatus

from fastapi import APIRouter, Response
from fastapi.responses import JSONResponse
from fractus_core.airspace.decide import MAX_HORIZON_S
from fractus_core.airspace.lifecycle import RESERVING
from fractus_core.api import Drone, FlightPlan
from fractus_core.api.flight_plans import FlightPlanStatus
from fractus_core.api.model import Model
from fractus_runtime.kubernetes import Body, KubeError
from pydantic import Field

from fractus_management.api_server import Caller, CallerOf, Continue, Limit, ObjectName, kind_of, public
from fractus_management.openapi import problems

DRONE = kind_of(Drone)
HORIZON = timedelta(seconds=MAX_HORIZON_S)
"""Time for which flights can be ordered in advance."""

router = APIRouter(tags=["drones"], responses=problems())


class DroneList(Model):
    """One page of drones."""

    items: tuple[Drone, ...] = Field(description="Drones with their descriptor and state.")
    continue_: str | None = Field(
        default=None, alias="continue", description="Parameter of the next page; unset: no more."
    )


class FreeWindow(Model):
    """Time in which no flight plan reserves a drone."""

    begin: datetime = Field(description="First moment.")
    end: datetime = Field(description="Last moment.")


class DroneDetails(Model):
    """A drone and the time in which it is free."""

    drone: Drone
    free_windows: tuple[FreeWindow, ...] | None = Field(
        default=None,
        description="Times of the next 30 days without a reservation; unset: you may not read the flight plans of all"
        " namespaces.",
    )


@router.get("/drones", response_model=DroneList, responses=problems(410))
async def list_drones(caller: CallerOf, limit: Limit = 100, continue_: Continue = "") -> Response:
    """List the drones."""
    return JSONResponse(await caller.page(DRONE, "", limit, continue_))


@router.get("/drones/{name:object}", response_model=DroneDetails)
async def read_drone(caller: CallerOf, name: ObjectName) -> Response:
    """Read a drone with the times in which it is free."""
    details: Body = {"drone": public(await caller.client.get(DRONE, name), DRONE)}
    reserved = await _reserved(caller, name)
    if reserved is not None:
        free = free_windows(reserved, datetime.now(UTC))
        details["freeWindows"] = [window.to_dict() for window in free]
    return JSONResponse(details)


async def _reserved(caller: Caller, drone: str) -> list[tuple[datetime, datetime]] | None:
    """Return the reserved times of a drone, or None if the caller may not read all plans."""
    selectors = {"fieldSelector": f"status.drone={drone}"}
    try:
        listed = await caller.client.list(kind_of(FlightPlan), selectors=selectors)
    except KubeError as error:
        if error.status != HTTPStatus.FORBIDDEN:
            raise
        return None
    reserved = []
    for body in listed:
        plan = FlightPlanStatus.model_validate(body["status"])
        volumes = plan.volumes + plan.off_nominal_volumes
        if volumes and plan.state in RESERVING and not body["spec"].get("dryRun"):
            reserved.append((min(each.begin for each in volumes), max(each.end for each in volumes)))
    return reserved


def free_windows(reserved: Iterable[tuple[datetime, datetime]], now: datetime) -> Iterator[FreeWindow]:
    """Yield the times of the next 30 days without a reservation, in order."""
    free_from = now
    end = now + HORIZON
    for first, last in sorted(reserved):
        if free_from < min(first, end):
            yield FreeWindow(begin=free_from, end=min(first, end))
        free_from = max(free_from, last)
    if free_from < end:
        yield FreeWindow(begin=free_from, end=end)
