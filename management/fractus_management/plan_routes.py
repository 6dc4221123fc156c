"""Routes of flight plans: submit, check, read, change, activate and end them."""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import secrets
from collections.abc import Callable
from contextlib import aclosing
from http import HTTPStatus
from typing import Annotated, Any

import fastapi
from fastapi import APIRouter, Header, Response
from fastapi.responses import JSONResponse
from fractus_core.api import GROUP, Application, Drone, FlightPlan, InvalidObject
from fractus_core.api.applications import ApplicationStatus
from fractus_core.api.flight_plans import FlightPlanSpec, FlightPlanStatus
from fractus_core.api.model import Model
from fractus_core.api.nodes import DroneStatus
from fractus_runtime.kubernetes import Body, Conflict, KubeError, NotFound
from pydantic import BeforeValidator, Field, WrapValidator

from fractus_management.api_server import Caller, CallerOf, Continue, Limit, Namespace, ObjectName, kind_of, public
from fractus_management.openapi import etag_header, located, problems
from fractus_management.preconditions import IfMatch, check_version, mismatch, required
from fractus_management.problem_details import invalid, refused
from fractus_management.request_bodies import check_values, merged, parsed_spec, spec_of

log = logging.getLogger(__name__)

PLAN = kind_of(FlightPlan)
REQUEST_DIGEST = f"{GROUP}/request-digest"
"""Annotation of a plan: digest of the request that created it. A repeated request must have the same content."""

_WRITE_ATTEMPTS = 5

router = APIRouter(tags=["plans"], responses=problems())

PlanSpec = Annotated[FlightPlanSpec, WrapValidator(spec_of(FlightPlan))]
IdempotencyKey = Annotated[
    str | None,
    Header(
        min_length=1,
        max_length=255,
        description="Unique key of the request. A request with the key of an earlier request of the same user returns the plan of"
        " that request, so that it can be repeated safely. Unset: each request creates a plan.",
    ),
]


def _object(value: Any) -> Any:
    if not isinstance(value, dict):
        raise InvalidObject("", "the body must be a JSON object with Content-Type: application/merge-patch+json")
    check_values(value)
    return value


MergePatch = Annotated[
    dict[str, Any], fastapi.Body(media_type="application/merge-patch+json"), BeforeValidator(_object)
]


class PlanList(Model):
    """One page of plans."""

    items: tuple[FlightPlan, ...] = Field(description="Plans without dry runs. A page may have fewer than `limit`.")
    continue_: str | None = Field(
        default=None, alias="continue", description="Parameter of the next page; unset: no more."
    )


class PlanProgress(Model):
    """Progress of a plan."""

    plan: FlightPlanStatus = Field(description="Status of the plan.")
    application: ApplicationStatus | None = Field(
        default=None, description="Status of the Application that flies; unset: none exists, or you may not read it."
    )
    drone: DroneStatus | None = Field(
        default=None, description="State of the reserved drone; unset: none is reserved, or you may not read it."
    )


@router.post(
    "/plans",
    status_code=HTTPStatus.CREATED,
    response_model=FlightPlan,
    responses={
        201: located("Decided.", follow=("read", "progress", "replace", "change", "activate", "end", "delete")),
        202: located("Not decided in time.", FlightPlan),
        **problems(408, 409, 413),
    },
)
async def submit(
    caller: CallerOf, spec: PlanSpec, namespace: Namespace = None, idempotency_key: IdempotencyKey = None
) -> Response:
    """Submit a plan. The response contains the decision: `status.state` is Accepted, Rejected, or Draft if you must select actions."""
    _refuse_dry_run(spec)
    body = _new(caller, namespace, f"plan-{secrets.token_hex(8)}", spec)
    if idempotency_key is not None:
        key = f"{await caller.user()}\0{idempotency_key}"
        body["metadata"]["name"] = f"plan-{hashlib.sha256(key.encode()).hexdigest()[:32]}"
        digest = hashlib.sha256(json.dumps(spec.to_dict(), sort_keys=True).encode()).hexdigest()
        body["metadata"]["annotations"] = {REQUEST_DIGEST: digest}
    try:
        created = await caller.client.create(PLAN, body)
    except Conflict as conflict:
        if conflict.reason != "AlreadyExists" or idempotency_key is None:
            raise
        created = await caller.client.get(PLAN, body["metadata"]["name"], body["metadata"]["namespace"])
        if created["metadata"].get("annotations", {}).get(REQUEST_DIGEST) != digest:
            message = "the Idempotency-Key belongs to a plan with other content; use a new key"
            raise refused(422, "IdempotencyKeyReused", message, "Idempotency-Key") from None
    return await _decided_response(caller, created, HTTPStatus.CREATED)


@router.post("/plans:check", response_model=FlightPlan, responses=problems(408, 409, 413))
async def check(caller: CallerOf, spec: PlanSpec, namespace: Namespace = None) -> Response:
    """Get the decision on a plan without a reservation. The response is a plan that is never flown and deleted after a minute."""
    return JSONResponse(public(await dry_run(caller, spec, namespace), PLAN))


@router.post("/plans/{name:object}:check", response_model=FlightPlan, responses=problems(408, 409, 413))
async def check_change(caller: CallerOf, name: ObjectName, spec: PlanSpec, namespace: Namespace = None) -> Response:
    """Get the decision on a change of a plan without changing it. The response is a plan that is never flown and deleted after a minute.

    The changed plan does not conflict with its present version.
    """
    original = await _get(caller, name, namespace)
    return JSONResponse(public(await dry_run(caller, spec, namespace, original), PLAN))


async def dry_run(caller: Caller, spec: FlightPlanSpec, namespace: str | None, original: Body | None = None) -> Body:
    """Return the decision on a plan without a reservation.

    Args:
        caller: Sender of the request.
        spec: Specification of the plan.
        namespace: Namespace of the plan; None: the default namespace.
        original: Plan whose change is decided; None: a new plan.

    Raises:
        Refused: The operator has not decided in time.
        KubeError: The API server refused the plan.
    """
    name = f"check-{secrets.token_hex(8)}"
    change_of = original["metadata"]["name"] if original is not None else None
    checked = spec.model_copy(update={"dry_run": True, "change_of": change_of})
    created = await caller.client.create(PLAN, _new(caller, namespace, name, checked))
    decided = await _decided(caller, created)
    if not _considered(decided):
        raise refused(503, "NotDecided", "the operator has not decided in time, try again; check that it runs")
    return decided


@router.get("/plans", response_model=PlanList, responses=problems(410))
async def list_plans(
    caller: CallerOf, namespace: Namespace = None, limit: Limit = 100, continue_: Continue = ""
) -> Response:
    """List the plans of a namespace."""
    page = await caller.page(PLAN, namespace or caller.settings.namespace, limit, continue_)
    page["items"] = [item for item in page["items"] if not item["spec"].get("dryRun")]
    return JSONResponse(page)


@router.get("/plans/{name:object}", response_model=FlightPlan, responses={200: etag_header()})
async def read(caller: CallerOf, name: ObjectName, namespace: Namespace = None) -> Response:
    """Read a plan."""
    return _response(await _get(caller, name, namespace))


@router.put(
    "/plans/{name:object}",
    response_model=FlightPlan,
    responses={
        200: etag_header("Decided."),
        202: etag_header("Not decided in time.", FlightPlan),
        **problems(408, 409, 412, 413, 428),
    },
)
async def replace(
    caller: CallerOf, name: ObjectName, spec: PlanSpec, namespace: Namespace = None, if_match: IfMatch = None
) -> Response:
    """Replace the specification of a plan. If the change is refused, the earlier version stays in force (`status.refusals`)."""
    return await _write(caller, name, namespace, required(if_match), lambda _: spec)


@router.patch(
    "/plans/{name:object}",
    response_model=FlightPlan,
    responses={
        200: etag_header("Decided."),
        202: etag_header("Not decided in time.", FlightPlan),
        **problems(408, 409, 412, 413, 428),
    },
)
async def change(
    caller: CallerOf, name: ObjectName, patch: MergePatch, namespace: Namespace = None, if_match: IfMatch = None
) -> Response:
    """Change the specification of a plan by a JSON merge patch (RFC 7396)."""
    return await _write(
        caller, name, namespace, required(if_match), lambda spec: parsed_spec(FlightPlan, merged(spec, patch))
    )


@router.delete(
    "/plans/{name:object}",
    status_code=HTTPStatus.NO_CONTENT,
    responses={202: etag_header("The flight ends, then the plan is deleted.", FlightPlan), **problems(409, 412, 428)},
)
async def delete(caller: CallerOf, name: ObjectName, namespace: Namespace = None, if_match: IfMatch = None) -> Response:
    """Delete a plan. A flight is aborted: the drone returns home."""
    present = await _get(caller, name, namespace)
    options: Body = {"propagationPolicy": "Background"}
    version = _version(required(if_match), present)
    if version is not None:
        options["preconditions"] = {"resourceVersion": version}
    path = PLAN.path(present["metadata"]["namespace"], name)
    try:
        left = await caller.client.request("DELETE", path, options)
    except Conflict as conflict:
        raise mismatch() from conflict
    if left.get("kind") == "Status":
        return Response(status_code=HTTPStatus.NO_CONTENT)
    return _response(left, HTTPStatus.ACCEPTED)


@router.post(
    "/plans/{name:object}:activate",
    response_model=FlightPlan,
    responses={
        200: etag_header("Decided."),
        202: etag_header("Not decided in time.", FlightPlan),
        **problems(409, 412),
    },
)
async def activate(
    caller: CallerOf, name: ObjectName, namespace: Namespace = None, if_match: IfMatch = None
) -> Response:
    """Permit the takeoff from the start of the window (`use: InUse`)."""
    return await _use(caller, name, namespace, if_match, "InUse")


@router.post(
    "/plans/{name:object}:end",
    response_model=FlightPlan,
    responses={
        200: etag_header("Decided."),
        202: etag_header("Not decided in time.", FlightPlan),
        **problems(409, 412),
    },
)
async def end(caller: CallerOf, name: ObjectName, namespace: Namespace = None, if_match: IfMatch = None) -> Response:
    """End a plan, also in flight: the drone returns home (`use: Closed`)."""
    return await _use(caller, name, namespace, if_match, "Closed")


@router.get("/plans/{name:object}/status", response_model=PlanProgress)
async def progress(caller: CallerOf, name: ObjectName, namespace: Namespace = None) -> Response:
    """Read the status of a plan, of its Application and of its drone."""
    plan = await _get(caller, name, namespace)
    status = plan.get("status") or {}
    found: Body = {"plan": status}
    related = (
        ("application", kind_of(Application), status.get("application"), plan["metadata"]["namespace"]),
        ("drone", kind_of(Drone), status.get("drone"), ""),
    )
    for part, kind, other, place in related:
        if other is None:
            continue
        try:
            read_status = (await caller.client.get(kind, other, place)).get("status")
        except KubeError as error:
            if error.status not in {HTTPStatus.FORBIDDEN, HTTPStatus.NOT_FOUND}:
                raise
            continue
        if read_status:
            found[part] = read_status
    return JSONResponse(found)


# -- requests to the API server --


async def _get(caller: Caller, name: str, namespace: str | None) -> Body:
    return await caller.client.get(PLAN, name, namespace or caller.settings.namespace)


def _new(caller: Caller, namespace: str | None, name: str, spec: FlightPlanSpec) -> Body:
    return {**PLAN.header(name, namespace or caller.settings.namespace), "spec": spec.to_dict()}


async def _use(caller: Caller, name: str, namespace: str | None, if_match: str | None, use: str) -> Response:
    """Set `use` of a plan."""

    def used(spec: Body) -> FlightPlanSpec:
        changed: FlightPlanSpec = parsed_spec(FlightPlan, {**spec, "use": use})
        return changed

    return await _write(caller, name, namespace, if_match or "*", used)


async def _write(
    caller: Caller, name: str, namespace: str | None, if_match: str, change_spec: Callable[[Body], FlightPlanSpec]
) -> Response:
    """Change the specification of a plan, and wait for the decision.

    Raises:
        Refused: The plan has another version than `if_match`, or the change is invalid.
        KubeError: The API server refused the change.
    """
    for _ in range(_WRITE_ATTEMPTS):
        present = await _get(caller, name, namespace)
        expected = _version(if_match, present)
        try:
            spec = change_spec(present["spec"])
        except InvalidObject as error:
            raise invalid(error) from None
        _refuse_dry_run(spec)
        try:
            written = await caller.client.replace(PLAN, {**present, "spec": spec.to_dict()})
        except Conflict as conflict:
            if expected is not None:
                raise mismatch() from conflict
            # The operator has written the status meanwhile.
            continue
        return await _decided_response(caller, written, HTTPStatus.OK)
    raise refused(409, "Conflict", "other writers change the plan all the time; try again")


async def _decided(caller: Caller, plan: Body) -> Body:
    """Return a plan after the operator has considered its version, or its latest known state after the time limit.

    Raises:
        NotFound: The plan was deleted meanwhile.
    """
    metadata = plan["metadata"]
    generation = metadata["generation"]
    timeout_s = caller.settings.decision_timeout_s
    try:
        async with asyncio.timeout(timeout_s):
            while not _considered(plan, generation):
                changes = caller.client.watch(
                    PLAN,
                    resource_version=plan["metadata"]["resourceVersion"],
                    namespace=metadata["namespace"],
                    selectors={"fieldSelector": f"metadata.name={metadata['name']}"},
                    timeout_s=int(timeout_s) + 1,
                    silence_s=timeout_s + 5,
                )
                async with aclosing(changes):
                    async for type_, body in changes:
                        if type_ == "DELETED":
                            raise NotFound(404, "NotFound", f"the plan {metadata['name']} was deleted")
                        if type_ != "BOOKMARK":
                            plan = body
                        if _considered(plan, generation):
                            break
    except TimeoutError:
        pass
    except NotFound:
        raise
    except KubeError as error:
        # The plan is stored, so the request has succeeded. The caller may lack the permission to watch.
        log.info("management: decision not observed (plan=%s error=%s)", metadata["name"], error)
    return plan


def _considered(plan: Body, generation: int | None = None) -> bool:
    """Return True if the operator has considered a generation of a plan, by default its present one."""
    considered = (plan.get("status") or {}).get("observedGeneration") or 0
    return bool(considered >= (generation or plan["metadata"]["generation"]))


# -- versions and responses --


def _refuse_dry_run(spec: FlightPlanSpec) -> None:
    if spec.dry_run:
        raise refused(422, "Invalid", "dryRun: remove it, and use /v1/plans:check", "dryRun")


def _version(if_match: str, present: Body) -> str | None:
    """Return the version that a write must replace, or None for any version.

    Raises:
        Refused: The header does not contain the present version.
    """
    version: str = present["metadata"]["resourceVersion"]
    return version if check_version(if_match, f'"{version}"') else None


def _response(plan: Body, status: int = HTTPStatus.OK) -> JSONResponse:
    headers = {"ETag": f'"{plan["metadata"]["resourceVersion"]}"'}
    return JSONResponse(public(plan, PLAN), status, headers)


async def _decided_response(caller: Caller, plan: Body, status: int) -> Response:
    """Return the plan with the decision, or with status 202 without one."""
    generation = plan["metadata"]["generation"]
    decided = await _decided(caller, plan)
    response = _response(decided, status if _considered(decided, generation) else HTTPStatus.ACCEPTED)
    if status == HTTPStatus.CREATED:
        metadata = plan["metadata"]
        response.headers["Location"] = f"/v1/plans/{metadata['name']}?namespace={metadata['namespace']}"
    return response
