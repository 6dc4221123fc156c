"""Routes of InterUSS' Flight Planning Automated Testing Interface."""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable
from http import HTTPStatus
from typing import Annotated, Any, cast
from uuid import UUID

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import JSONResponse, Response
from fractus_core.api import Drone, InvalidObject
from fractus_core.api.flight_plans import FlightPlanSpec
from fractus_runtime.kubernetes import Body, Conflict, Invalid, NotFound
from pydantic import AwareDatetime, BaseModel

from fractus_management.api_server import Caller, CallerOf, kind_of
from fractus_management.interuss.messages import (
    API_NAME,
    API_VERSION,
    ClearAreaRequest,
    PlanningResponse,
    UpsertRequest,
)
from fractus_management.interuss.plan_mapping import (
    Unplannable,
    altitude_problem,
    flight_plan_spec,
    notifications_of,
    refusal_of,
    reserves_in,
    response_of,
    status_of,
)
from fractus_management.plan_routes import PLAN, dry_run
from fractus_management.problem_details import refused
from fractus_management.settings import AutomatedTesting

PREFIX = "/flight_planning/v1"
DECISION_S = 4.0
"""Seconds for which a request waits for a decision, and once more to undo a refused request. InterUSS' qualifier waits for 10 s."""

CLOSE_S = 8.0
"""Seconds for which a request waits for a plan to be gone."""

_POLL_S = 0.1
_WRITE_ATTEMPTS = 5
_KEPT_RESPONSES = 1000
_FLYING = frozenset({"Activated", "Nonconforming", "Contingent"})

router = APIRouter(prefix=PREFIX, include_in_schema=False)


class KeptResponses:
    """Latest responses by caller and request, so that a repeated request gets the response of the first one."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[bytes, str], Body] = OrderedDict()

    def get(self, caller: Caller, key: str) -> Body | None:
        """Return the response to an earlier request, or None."""
        return self._kept.get((caller.token_hash, key))

    def put(self, caller: Caller, key: str, response: Body) -> Body:
        """Keep a response and return it."""
        self._kept[caller.token_hash, key] = response
        if len(self._kept) > _KEPT_RESPONSES:
            self._kept.popitem(last=False)
        return response


def _kept(request: Request) -> KeptResponses:
    return cast(KeptResponses, request.app.state.kept_responses)


Kept = Annotated[KeptResponses, Depends(_kept)]


@router.get("/status")
async def status(caller: CallerOf) -> Response:
    """Report that tests may begin. The token must be valid."""
    await caller.user()
    return JSONResponse({"status": "Ready", "api_name": API_NAME, "api_version": API_VERSION})


@router.put("/flight_plans/{flight_plan_id}")
async def upsert(caller: CallerOf, kept: Kept, flight_plan_id: UUID, request: UpsertRequest) -> Response:
    """Create, change, activate or close a flight plan."""
    name = _name(flight_plan_id)
    key = f"{name}/{request.request_id}"
    response = kept.get(caller, key)
    if response is None:
        response = kept.put(caller, key, _content(await _upsert(caller, name, request)))
    return JSONResponse(response)


@router.delete("/flight_plans/{flight_plan_id}")
async def delete(caller: CallerOf, flight_plan_id: UUID) -> Response:
    """Close a flight plan and remove it."""
    present = await _find(caller, _name(flight_plan_id))
    if present is None:
        missing = response_of(None, "Failed", f"there is no flight plan {flight_plan_id}")
        return JSONResponse(_content(missing), HTTPStatus.NOT_FOUND)
    return JSONResponse(_content(await _close(caller, present)))


@router.post("/clear_area_requests")
async def clear_area(caller: CallerOf, kept: Kept, request: ClearAreaRequest) -> Response:
    """Remove all flight plans of the namespace that reserve airspace in an extent."""
    response = kept.get(caller, request.request_id)
    if response is None:
        response = kept.put(caller, request.request_id, {"outcome": await _clear(caller, request)})
    return JSONResponse(response)


@router.get("/user_notifications")
async def user_notifications(
    caller: CallerOf, after: AwareDatetime, before: Annotated[AwareDatetime | None, Query()] = None
) -> Response:
    """List the conflicts that arose with plans that exist, by the time at which the operator reported them."""
    if before is not None and before < after:
        raise refused(HTTPStatus.BAD_REQUEST, "Invalid", "before must not be earlier than after", "before")
    plans = (await caller.client.list_whole(PLAN, namespace=caller.settings.namespace)).items
    found = [each for plan in plans for each in notifications_of(plan, after, before)]
    return JSONResponse({"user_notifications": found})


# -- flight plans --


async def _upsert(caller: Caller, name: str, request: UpsertRequest) -> PlanningResponse:
    """Carry out a request about a flight plan.

    Raises:
        KubeError: The API server refused the request, or did not respond.
    """
    flight = request.flight_plan
    usage = flight.basic_information.usage_state
    present = await _find(caller, name)
    state = ((present or {}).get("status") or {}).get("state")
    try:
        if request.execution_style == "InReality":
            raise Unplannable("NotSupported", "Fractus flies the drone itself, so users cannot report what it does")
        if request.execution_style == "Hypothetical" and (present is not None or usage != "Planned"):
            raise Unplannable("NotSupported", "Hypothetical is supported only for a new flight plan that is Planned")
        if usage == "Closed":
            if present is None:
                raise Unplannable("Rejected", "the flight plan does not exist, so it cannot be closed")
            return await _close(caller, present)
        if usage == "Planned" and state in _FLYING:
            raise Unplannable("Rejected", "the flight is in use and cannot become Planned; close it")
        if state == "Ended":
            raise Unplannable("Rejected", "the flight has ended; close it, or use another flight_plan_id")
        spec = flight_plan_spec(flight, _testing(caller).template, time.time())
        if request.execution_style == "Hypothetical":
            return await _hypothetical(caller, request, spec, present)
        written = await _write(caller, name, present, spec)
    except Unplannable as unplannable:
        return response_of(present, unplannable.result, str(unplannable))
    except Invalid as error:
        return response_of(present, "Rejected", str(error))
    decided = await _wait(caller, written, _settled, DECISION_S)
    problem = await _problem(caller, request, decided)
    if problem is None:
        return response_of(decided, "Completed")
    remaining = await _restore(caller, written, present)
    return response_of(remaining, problem.result, str(problem))


async def _hypothetical(
    caller: Caller, request: UpsertRequest, spec: FlightPlanSpec, present: Body | None
) -> PlanningResponse:
    decided = await dry_run(caller, spec, None, present)
    problem = await _problem(caller, request, decided)
    if problem is not None:
        return response_of(None, problem.result, str(problem))
    return response_of(decided, "Completed")


async def _problem(caller: Caller, request: UpsertRequest, decided: Body | None) -> Unplannable | None:
    """Return why a written plan is not what the user requested, or None if it is."""
    if decided is None:
        return Unplannable("Failed", "the flight plan was deleted meanwhile")
    refusal = refusal_of(decided)
    if refusal is not None:
        return refusal
    basic = request.flight_plan.basic_information
    wanted = "OkToFly" if basic.usage_state == "InUse" else "Planned"
    if status_of(decided) == "OffNominal":
        return Unplannable(
            "Rejected", f"the drone does not keep to its flight plan: {decided['status'].get('message')}"
        )
    if status_of(decided) != wanted:
        return Unplannable("Failed", f"the operator has not decided in {DECISION_S:.0f} s; check that it runs")
    area = basic.area or ()
    home_m = None
    if any(each.volume.altitude_upper and each.volume.altitude_upper.reference != "W84" for each in area):
        drone = await caller.client.get(kind_of(Drone), decided["status"]["drone"])
        home_m = drone["spec"].get("home", {}).get("alt")
    problem = altitude_problem(area, decided["status"].get("volumes") or (), home_m, _testing(caller).geoid_m)
    return Unplannable("Rejected", problem) if problem else None


def _settled(plan: Body) -> bool:
    """Return True if the operator has considered the present version, and has started or refused a flight in use."""
    seen = plan.get("status") or {}
    generation = plan["metadata"]["generation"]
    state = seen.get("state")
    if plan["spec"].get("use") == "InUse" and state == "Accepted":
        return any(
            each["type"] in {"Startable", "ChangeRefused"} and (each.get("observedGeneration") or 0) >= generation
            for each in seen.get("conditions") or ()
        )
    return bool((seen.get("observedGeneration") or 0) >= generation)


async def _close(caller: Caller, present: Body) -> PlanningResponse:
    """Delete a plan, and wait until it is gone. A drone in the air returns home first."""
    await caller.client.delete(PLAN, _key(present), present["metadata"]["uid"])
    left = await _wait(caller, present, _never, CLOSE_S)
    if left is None:
        return PlanningResponse(
            planning_result="Completed",
            flight_plan_status="Closed",
            includes_advisories="NoAdvisoriesOrConditions",
        )
    if status_of(left) == "OffNominal":
        return response_of(left, "Completed", "the drone is still in the air and returns home")
    return response_of(
        left, "Failed", f"the flight plan is not closed after {CLOSE_S:.0f} s; check that the operator runs"
    )


async def _clear(caller: Caller, request: ClearAreaRequest) -> Body:
    """Delete the plans in an extent at the same time, and return the outcome."""
    try:
        plans = (await caller.client.list_whole(PLAN, namespace=caller.settings.namespace)).items
        affected = [plan for plan in plans if reserves_in(plan, request.extent)]
    except InvalidObject as error:
        return {"success": False, "message": str(error)}
    closed = await asyncio.gather(*(_close(caller, plan) for plan in affected))
    left = [
        f"{plan['metadata']['name']}: {response.notes}"
        for plan, response in zip(affected, closed, strict=True)
        if response.flight_plan_status != "Closed"
    ]
    return {"success": False, "message": "; ".join(left)} if left else {"success": True}


# -- requests to the API server --


async def _find(caller: Caller, name: str) -> Body | None:
    try:
        return await caller.client.get(PLAN, name, caller.settings.namespace)
    except NotFound:
        return None


async def _write(caller: Caller, name: str, present: Body | None, spec: FlightPlanSpec) -> Body:
    """Create a plan, or replace the specification of a present one.

    Raises:
        Conflict: Others change the plan at the same time.
    """
    if present is None:
        header = PLAN.header(name, caller.settings.namespace)
        return await caller.client.create(PLAN, {**header, "spec": spec.to_dict()})
    for _ in range(_WRITE_ATTEMPTS):
        try:
            return await caller.client.replace(PLAN, {**present, "spec": spec.to_dict()})
        except Conflict:
            # The operator has written the status meanwhile.
            present = await caller.client.get(PLAN, name, caller.settings.namespace)
    raise Conflict(409, "Conflict", "others change the flight plan at the same time; try again")


async def _restore(caller: Caller, written: Body, before: Body | None) -> Body | None:
    """Undo a refused request, so that nothing of it happens later. Return the plan that remains."""
    if before is None:
        await caller.client.delete(PLAN, _key(written), written["metadata"]["uid"])
        return await _wait(caller, written, _never, DECISION_S)
    for _ in range(_WRITE_ATTEMPTS):
        present = await _find(caller, written["metadata"]["name"])
        if present is None:
            return None
        try:
            restored = await caller.client.replace(PLAN, {**present, "spec": before["spec"]})
        except Conflict:
            continue
        return await _wait(caller, restored, _settled, DECISION_S)
    raise Conflict(409, "Conflict", "others change the flight plan at the same time; try again")


def _never(_plan: Body) -> bool:
    return False


async def _wait(caller: Caller, plan: Body, done: Callable[[Body], bool], timeout_s: float) -> Body | None:
    """Return a plan when it is as expected, its latest version after a time, or None when it is gone."""
    metadata = plan["metadata"]
    current: Body | None = plan
    try:
        async with asyncio.timeout(timeout_s):
            while current is not None and current["metadata"]["uid"] == metadata["uid"] and not done(current):
                await asyncio.sleep(_POLL_S)
                current = await _find(caller, metadata["name"])
    except TimeoutError:
        return current
    return current if current is not None and current["metadata"]["uid"] == metadata["uid"] else None


def _testing(caller: Caller) -> AutomatedTesting:
    return cast(AutomatedTesting, caller.settings.automated_testing)


def _key(plan: Body) -> tuple[str, str]:
    return plan["metadata"]["namespace"], plan["metadata"]["name"]


def _name(flight_plan_id: UUID) -> str:
    return f"interuss-{flight_plan_id}"


def _content(message: BaseModel) -> Body:
    content: Any = message.model_dump(mode="json", exclude_none=True)
    return cast(Body, content)
