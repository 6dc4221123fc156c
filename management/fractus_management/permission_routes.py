"""Route of the permissions of the caller, with which clients show only the actions that the caller may take."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter
from fractus_core.api import GROUP, FlightPlan, Policy, Resource, Zone
from fractus_core.api.model import Model
from fractus_runtime.kubernetes import Body
from pydantic import Field

from fractus_management.api_server import Caller, CallerOf, Namespace
from fractus_management.openapi import problems

_REVIEW = "/apis/authorization.k8s.io/v1/selfsubjectaccessreviews"
_RESTRICTION_VERBS: dict[type[Resource], tuple[str, ...]] = {
    Policy: ("get", "create", "update", "delete"),
    Zone: ("get", "list", "create", "patch", "delete"),
}
"""Verbs that the routes of restrictions use."""

router = APIRouter(tags=["permissions"], responses=problems())


class Permissions(Model):
    """Permissions of the caller that the usual roles of users do not contain."""

    publish_restrictions: bool = Field(description="The caller may publish, change and delete restrictions.")
    prioritize: bool = Field(
        description="The caller may order flights of the priority classes elevated and emergency in the namespace."
    )


@router.get("/permissions", response_model=Permissions)
async def read_permissions(caller: CallerOf, namespace: Namespace = None) -> Permissions:
    """Get the permissions of the caller. The API server decides again on each request."""
    verbs = [(kind, verb) for kind, of_kind in _RESTRICTION_VERBS.items() for verb in of_kind]
    prioritize, *publish = await asyncio.gather(
        _allowed(caller, FlightPlan, "prioritize", namespace or caller.settings.namespace),
        *(_allowed(caller, kind, verb) for kind, verb in verbs),
    )
    return Permissions(publish_restrictions=all(publish), prioritize=prioritize)


async def _allowed(caller: Caller, kind: type[Resource], verb: str, namespace: str = "") -> bool:
    attributes = {"group": GROUP, "resource": kind.PLURAL, "verb": verb, "namespace": namespace}
    review: Body = {
        "apiVersion": "authorization.k8s.io/v1",
        "kind": "SelfSubjectAccessReview",
        "spec": {"resourceAttributes": attributes},
    }
    return bool((await caller.client.request("POST", _REVIEW, review))["status"]["allowed"])
