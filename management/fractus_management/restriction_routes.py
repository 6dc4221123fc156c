"""Routes of restrictions: publish, read, change and delete them, and the plans and flights that one affects."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable
from http import HTTPStatus
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Path, Response
from fastapi.responses import JSONResponse
from fractus_core.airspace.lifecycle import RESERVING
from fractus_core.airspace.restriction_impact import AffectedFlight, AffectedPlan, affected_flights, affected_plans
from fractus_core.api import Drone, FlightPlan, Grant, InvalidObject, Policy, Resource, Zone
from fractus_core.api.model import Metadata, Model
from fractus_core.api.names import DNS_LABEL
from fractus_core.api.policies import PolicySpec, ReadyStatus, ZoneSpec
from fractus_core.validation import check_policy, check_zone
from fractus_runtime.kubernetes import Body
from pydantic import Field, WrapValidator

from fractus_management import restrictions
from fractus_management.api_server import CallerOf, Continue, Limit, kind_of
from fractus_management.openapi import etag_header, located, problems
from fractus_management.plan_routes import PLAN, MergePatch
from fractus_management.preconditions import IfMatch, required
from fractus_management.problem_details import invalid
from fractus_management.request_bodies import merged, parsed_spec
from fractus_management.restrictions import POLICY, RESTRICTION, ZONE, Stored

_MAX_NAME = 52
"""Maximum length of the name of a restriction. The name of its Zone has 11 more characters."""
_ZONE = "zone"
"""Placeholder of the name of the Zone, without which a geofence is invalid."""
_NAMED = Metadata(name=_ZONE)
_PERMITTING = frozenset({"inclusion", "grant"})

router = APIRouter(tags=["restrictions"], responses=problems())


def _policy(value: Any, _handler: Any) -> PolicySpec:
    """Return the specification of the Policy of a restriction.

    Raises:
        InvalidObject: It is not a specification of a Policy, selects Zones, or permits something.
    """
    if isinstance(value, dict):
        selector = value.get("selector") or {}
        if isinstance(selector, dict):
            if selector.get("zones"):
                raise InvalidObject("selector.zones", "a restriction applies to its own zone; remove the field")
            value = {**value, "selector": {**selector, "zones": [_ZONE]}}
    spec: PolicySpec = parsed_spec(Policy, value)
    _of_spec(lambda: check_policy(Policy(metadata=_NAMED, spec=spec), {_ZONE}))
    if spec.kind in _PERMITTING:
        raise InvalidObject(
            "kind",
            f"{spec.kind} permits something in its zones and restricts nothing there; apply such a Policy with kubectl",
        )
    return spec


def _zone(value: Any, _handler: Any) -> ZoneSpec:
    """Return the specification of the Zone of a restriction.

    Raises:
        InvalidObject: It is not a specification of a Zone, or the geometry is invalid.
    """
    spec: ZoneSpec = parsed_spec(Zone, value)
    _of_spec(lambda: check_zone(Zone(metadata=_NAMED, spec=spec)))
    return spec


def _of_spec(check: Callable[[], None]) -> None:
    """Run a check of an object, and name fields of its specification in errors."""
    try:
        check()
    except InvalidObject as error:
        raise InvalidObject(error.field.removeprefix("spec."), error.problem) from None


_ZoneSpec = Annotated[ZoneSpec, WrapValidator(_zone)]
_PolicySpec = Annotated[
    PolicySpec,
    WrapValidator(_policy),
    Field(
        description="Specification of the Policy without `selector.zones`, and of another kind than inclusion and grant."
    ),
]
_Name = Annotated[str, Field(min_length=1, max_length=_MAX_NAME, pattern=DNS_LABEL)]
RestrictionName = Annotated[
    str, Path(min_length=1, max_length=_MAX_NAME, pattern=DNS_LABEL, description="Name of the restriction.")
]


class NewRestriction(Model):
    """A restriction to publish, or to compare with plans and flights."""

    name: _Name = Field(description="Name of the restriction and of its Policy.")
    zone: _ZoneSpec = Field(
        description="Area, altitude band and schedule of the restriction. `description` is its message to users."
    )
    policy: _PolicySpec


class Restriction(Model):
    """A restriction: a rule in a zone."""

    name: str = Field(description="Name of the restriction and of its Policy.")
    zone: ZoneSpec | None = Field(
        default=None,
        description="Area, altitude band and schedule; unset: another client has deleted the Zone. Change the restriction with a zone.",
    )
    policy: PolicySpec = Field(description="Specification of the Policy without `selector.zones`.")
    status: ReadyStatus | None = Field(
        default=None, description="Condition Ready: the operator can enforce the restriction; unset: not checked yet."
    )


class RestrictionList(Model):
    """One page of restrictions."""

    items: tuple[Restriction, ...] = Field(description="Restrictions that were published with this API.")
    continue_: str | None = Field(
        default=None, alias="continue", description="Parameter of the next page; unset: no more."
    )


class Impact(Model):
    """Plans and flights that a restriction affects."""

    plans: tuple[AffectedPlan, ...] = Field(description="Plans that reserve airspace of the restriction.")
    flights: tuple[AffectedFlight, ...] = Field(description="Flights in the air whose area overlaps the restriction.")
    unreadable: tuple[str, ...] = Field(
        description="Plans, Drones and Grants that could not be compared, because they are invalid: KIND NAMESPACE/NAME."
    )


@router.post(
    "/restrictions",
    status_code=HTTPStatus.CREATED,
    response_model=Restriction,
    responses={
        201: located(
            "Published.", follow=("read_restriction", "change_restriction", "delete_restriction"), name="/name"
        ),
        **problems(408, 409, 413),
    },
)
async def publish_restriction(caller: CallerOf, restriction: NewRestriction) -> Response:
    """Publish a restriction. Flights in the air obey it at once. A repeated request with the same content has no further effect."""
    created = await restrictions.create(caller.client, restriction.name, restriction.zone, restriction.policy)
    response = _response(created, HTTPStatus.CREATED)
    response.headers["Location"] = f"/v1/restrictions/{restriction.name}"
    return response


@router.get("/restrictions", response_model=RestrictionList, responses=problems(410))
async def list_restrictions(caller: CallerOf, limit: Limit = 100, continue_: Continue = "") -> Response:
    """List the restrictions."""
    params = {"labelSelector": RESTRICTION, "limit": str(limit)} | ({"continue": continue_} if continue_ else {})
    listed = await caller.client.request("GET", POLICY.path(""), params=params)
    zones = await caller.client.list(ZONE, selectors={"labelSelector": RESTRICTION})
    by_name = {zone["metadata"]["name"]: zone for zone in zones}
    page: Body = {
        "items": [
            Stored(policy, by_name.get(policy["spec"]["selector"]["zones"][0])).public()
            for policy in listed.get("items") or ()
            if restrictions.is_restriction(policy)
        ]
    }
    if listed["metadata"].get("continue"):
        page["continue"] = listed["metadata"]["continue"]
    return JSONResponse(page)


@router.get("/restrictions/{name}", response_model=Restriction, responses={200: etag_header("The restriction.")})
async def read_restriction(caller: CallerOf, name: RestrictionName) -> Response:
    """Read a restriction."""
    return _response(await restrictions.read(caller.client, name))


@router.patch(
    "/restrictions/{name}",
    response_model=Restriction,
    responses={200: etag_header("Changed."), **problems(408, 409, 412, 413, 428)},
)
async def change_restriction(
    caller: CallerOf, name: RestrictionName, patch: MergePatch, if_match: IfMatch = None
) -> Response:
    """Change zone and policy of a restriction by a JSON merge patch (RFC 7396). Both change at the same time."""

    def changed(present: Body) -> tuple[ZoneSpec, PolicySpec]:
        if unknown := sorted(patch.keys() - {"zone", "policy"}):
            raise InvalidObject(unknown[0], "cannot be changed; give zone, policy or both")
        body = merged(present, patch)
        return _below("zone", _zone, body.get("zone")), _below("policy", _policy, body.get("policy"))

    try:
        return _response(await restrictions.change(caller.client, name, required(if_match), changed))
    except InvalidObject as error:
        raise invalid(error) from None


@router.delete("/restrictions/{name}", status_code=HTTPStatus.NO_CONTENT, responses=problems(409, 412, 428))
async def delete_restriction(caller: CallerOf, name: RestrictionName, if_match: IfMatch = None) -> Response:
    """Delete a restriction."""
    await restrictions.delete(caller.client, name, required(if_match))
    return Response(status_code=HTTPStatus.NO_CONTENT)


@router.post("/restrictions:impact", response_model=Impact, responses=problems(408, 413))
async def restriction_impact(caller: CallerOf, restriction: NewRestriction) -> Response:
    """Get the plans and flights in all namespaces that a restriction would affect. Nothing is written."""
    plans = [
        plan
        for plan in await caller.client.list(PLAN)
        if not plan["spec"].get("dryRun") and (plan.get("status") or {}).get("state") in RESERVING
    ]
    drones = await caller.client.list(kind_of(Drone))
    grants = await caller.client.list(kind_of(Grant))
    # The comparison with thousands of plans takes seconds, and other requests must not wait for it.
    impact = await asyncio.to_thread(_impact, restriction, plans, drones, grants)
    return JSONResponse(impact.to_dict())


def _impact(
    restriction: NewRestriction, plans: Iterable[Body], drones: Iterable[Body], grants: Iterable[Body]
) -> Impact:
    unreadable: list[str] = []
    named = {drone.name: drone for drone in _readable(Drone, drones, unreadable)}
    zone = Zone(metadata=_NAMED, spec=restriction.zone)
    now_s = time.time()
    return Impact(
        plans=tuple(affected_plans(restriction.policy, zone, _readable(FlightPlan, plans, unreadable), named, now_s)),
        flights=tuple(affected_flights(restriction.policy, zone, _readable(Grant, grants, unreadable), named, now_s)),
        unreadable=tuple(unreadable),
    )


_Kind = TypeVar("_Kind", bound=Resource)


def _readable(kind: type[_Kind], bodies: Iterable[Body], unreadable: list[str]) -> list[_Kind]:
    """Return the valid objects, and add the names of the others to a list."""
    readable = []
    for body in bodies:
        try:
            readable.append(kind.from_body({**body, "kind": kind.KIND}))
        except InvalidObject:
            metadata = body["metadata"]
            unreadable.append(f"{kind.KIND} {metadata.get('namespace', '')}/{metadata['name']}")
    return readable


_Spec = TypeVar("_Spec")


def _below(field: str, parse: Callable[[Any, Any], _Spec], value: Any) -> _Spec:
    """Parse a field of a body, and name it in errors."""
    try:
        return parse(value, None)
    except InvalidObject as error:
        raise InvalidObject(f"{field}.{error.field}".removesuffix("."), error.problem) from None


def _response(restriction: Stored, status: int = HTTPStatus.OK) -> JSONResponse:
    return JSONResponse(restriction.public(), status, {"ETag": restriction.etag})
