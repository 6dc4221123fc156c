"""Routes of applications that users may order: templates, and the drones that can fly them."""

from __future__ import annotations

from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Query, Response
from fastapi.responses import JSONResponse
from fractus_core.api import ApplicationTemplate, FlightPlan, InvalidObject
from fractus_core.api.flight_plans import PARAMETERS_INVALID, ApplicationTemplateSpec, PlanFinding, PlanState
from fractus_core.api.model import Model
from fractus_core.api.names import Name
from fractus_core.api.plans import Alternative, Rejection
from fractus_core.planning.flight_parameters import check_parameter_schema
from fractus_runtime.kubernetes import Body
from pydantic import Field, WrapValidator

from fractus_management.api_server import CallerOf, Continue, Limit, Namespace, ObjectName, kind_of, public
from fractus_management.openapi import located, problems
from fractus_management.plan_routes import dry_run
from fractus_management.problem_details import invalid
from fractus_management.request_bodies import parsed_spec, spec_of

TEMPLATE = kind_of(ApplicationTemplate)
_NUMBER = r"-?[0-9]{1,9}([.][0-9]{1,15})?"
_POSITIONS = rf"^{_NUMBER},{_NUMBER}(,{_NUMBER})?(;{_NUMBER},{_NUMBER}(,{_NUMBER})?){{0,999}}$"

router = APIRouter(tags=["apps"], responses=problems())


class NewTemplate(Model):
    """An application to publish."""

    name: Name = Field(description="Name of the ApplicationTemplate.")
    spec: Annotated[ApplicationTemplateSpec, WrapValidator(spec_of(ApplicationTemplate))]


class TemplateList(Model):
    """One page of templates."""

    items: tuple[ApplicationTemplate, ...] = Field(
        description="Templates. Those whose condition Ready is True can be ordered."
    )
    continue_: str | None = Field(
        default=None, alias="continue", description="Parameter of the next page; unset: no more."
    )


class DroneMatch(Model):
    """Drones for a flight."""

    state: PlanState = Field(description="Decision on a plan for this flight: Accepted, Rejected or Draft.")
    suitable: tuple[Alternative, ...] = Field(description="Drones that fit, best first, at most 11.")
    rejected: tuple[Rejection, ...] = Field(description="Drones that do not fit, each with the reason.")
    refusals: tuple[PlanFinding, ...] = Field(
        description="Reasons why the flight is refused, such as a conflict with another plan. Then no drone is suitable."
    )


@router.get("/apps", response_model=TemplateList, responses=problems(410))
async def list_apps(caller: CallerOf, limit: Limit = 100, continue_: Continue = "") -> Response:
    """List the applications."""
    return JSONResponse(await caller.page(TEMPLATE, "", limit, continue_))


@router.post(
    "/apps",
    status_code=HTTPStatus.CREATED,
    response_model=ApplicationTemplate,
    responses={
        201: located("Published, and not approved yet.", follow=("read_app", "match_drones")),
        **problems(408, 409, 413),
    },
)
async def publish_app(caller: CallerOf, template: NewTemplate) -> Response:
    """Publish an application. Users can order it after an authority has approved it."""
    try:
        check_parameter_schema(template.spec.parameters)
    except InvalidObject as error:
        raise invalid(InvalidObject(f"spec.{error.field}", error.problem)) from None
    created = await caller.client.create(TEMPLATE, {**TEMPLATE.header(template.name), "spec": template.spec.to_dict()})
    headers = {"Location": f"/v1/apps/{template.name}", "ETag": f'"{created["metadata"]["resourceVersion"]}"'}
    return JSONResponse(public(created, TEMPLATE), HTTPStatus.CREATED, headers)


@router.get("/apps/{name:object}", response_model=ApplicationTemplate)
async def read_app(caller: CallerOf, name: ObjectName) -> Response:
    """Read an application."""
    return JSONResponse(public(await caller.client.get(TEMPLATE, name), TEMPLATE))


@router.get("/apps/{name:object}/drones", response_model=DroneMatch, responses=problems(409))
async def match_drones(
    *,
    caller: CallerOf,
    name: ObjectName,
    start: Annotated[
        str, Query(max_length=35, json_schema_extra={"format": "date-time"}, description="Start of the window.")
    ],
    duration: Annotated[float, Query(gt=0, le=1440, description="Length of the window in minutes.")],
    area: Annotated[
        str,
        Query(
            pattern=_POSITIONS,
            max_length=50_000,
            description="LAT,LON or LAT,LON,ALT, separated by semicolons: the waypoints, or the vertices of the region.",
        ),
    ],
    stay: Annotated[
        float | None, Query(gt=0, le=1440, description="Flight time in a region in minutes; unset: half of the window.")
    ] = None,
    namespace: Namespace = None,
) -> Response:
    """Get the drones that can fly an application at a place and time, and the reason for each other drone."""
    template = await caller.client.get(TEMPLATE, name)
    window = {"start": start, "duration": duration}
    positions = [[float(number) for number in position.split(",")] for position in area.split(";")]
    spec: Body = {"template": name, "window": window}
    if template["spec"]["navigation"] == "region":
        vertices = [{"lat": lat, "lon": lon} for lat, lon, *_ in positions]
        spec |= {"region": {"polygon": {"exterior": vertices}}, "stay": duration / 2 if stay is None else stay}
    else:
        spec["waypoints"] = [dict(zip(("lat", "lon", "alt"), position, strict=False)) for position in positions]
    try:
        plan: Any = parsed_spec(FlightPlan, spec)
    except InvalidObject as error:
        raise invalid(error) from None
    status = (await dry_run(caller, plan, namespace))["status"]
    # The question contains no parameters.
    refusals = [each for each in status.get("refusals") or [] if each["reason"] != PARAMETERS_INVALID]
    candidates = status.get("candidates") or []
    state = "Accepted" if candidates and not refusals and status["state"] == "Rejected" else status["state"]
    suitable = [] if refusals else candidates
    rejected = status.get("rejected") or []
    return JSONResponse({"state": state, "suitable": suitable, "rejected": rejected, "refusals": refusals})
