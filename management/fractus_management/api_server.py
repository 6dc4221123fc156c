"""Access to the Kubernetes API server with the token of the caller."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Annotated

from fastapi import Depends, Path, Query, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from fractus_core.api import API_VERSION, Resource
from fractus_core.api.names import DNS_SUBDOMAIN, Name
from fractus_runtime.kubernetes import Body, Client, Kind
from starlette.convertors import StringConvertor, register_url_convertor

from fractus_management.problem_details import refused
from fractus_management.request_limits import RequestLimits
from fractus_management.settings import Settings

_TOKEN = re.compile(r"[A-Za-z0-9._~+/=-]+")
_REVIEW = "/apis/authentication.k8s.io/v1/selfsubjectreviews"
_BEARER = HTTPBearer(
    auto_error=False, description="Token of a user or ServiceAccount of the Kubernetes cluster (kubectl create token)."
)


class _ObjectConvertor(StringConvertor):
    """Path parameter without a colon, so that /plans/NAME does not match /plans/NAME:end."""

    regex = "[^/:]+"


register_url_convertor("object", _ObjectConvertor())

Namespace = Annotated[
    Name | None, Query(description="Namespace of the plans; unset: the namespace that the server is configured with.")
]
ObjectName = Annotated[str, Path(max_length=253, pattern=DNS_SUBDOMAIN, description="Name of the object.")]
Limit = Annotated[int, Query(ge=1, le=500, description="Maximum number of items in the response.")]
Continue = Annotated[
    str, Query(alias="continue", max_length=4096, description="Value of `continue` in the previous response.")
]


def kind_of(model: type[Resource]) -> Kind:
    """Return the Kubernetes kind of a model."""
    return Kind(API_VERSION, model.KIND, model.PLURAL, model.NAMESPACED)


@dataclass(frozen=True, slots=True)
class Caller:
    """The sender of a request.

    Attributes:
        client: Sends requests to the API server with the caller's token.
        settings: Settings of the API.
        limits: Limits of requests and streams.
        token: The caller's bearer token.
        token_hash: Identifies the token in limits.
    """

    client: Client
    settings: Settings
    limits: RequestLimits
    token: str = field(repr=False)
    token_hash: bytes

    async def user(self) -> str:
        """Return the user name that the API server assigns to the token.

        Raises:
            KubeError: The token is invalid, or the API server did not respond.
        """
        review: Body = {"apiVersion": "authentication.k8s.io/v1", "kind": "SelfSubjectReview"}
        return str((await self.client.request("POST", _REVIEW, review))["status"]["userInfo"]["username"])

    async def page(self, kind: Kind, namespace: str, limit: int, continue_: str) -> Body:
        """Return one page of a list: `items`, and `continue` unless it is the last page.

        Raises:
            KubeError: The API server refused the request.
        """
        params = {"limit": str(limit)} | ({"continue": continue_} if continue_ else {})
        listed = await self.client.request("GET", kind.path(namespace), params=params)
        page: Body = {"items": [public(item, kind) for item in listed.get("items") or ()]}
        if listed["metadata"].get("continue"):
            page["continue"] = listed["metadata"]["continue"]
        return page


async def _caller(
    request: Request, credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_BEARER)]
) -> Caller:
    """Return the sender of a request.

    Raises:
        Refused: The request has no token, or its token has sent too many requests.
    """
    if credentials is None or _TOKEN.fullmatch(credentials.credentials) is None:
        message = "send the header Authorization: Bearer TOKEN with a token of the cluster, as of kubectl create token"
        raise refused(HTTPStatus.UNAUTHORIZED, "Unauthorized", message)
    state = request.app.state
    token = credentials.credentials
    token_hash = hashlib.sha256(token.encode()).digest()
    state.limits.admit(token_hash)
    return Caller(state.client.on_behalf_of(token), state.settings, state.limits, token, token_hash)


CallerOf = Annotated[Caller, Depends(_caller)]
"""Dependency: the sender of a request."""


def public(body: Body, kind: Kind) -> Body:
    """Return an object of the API server as the API returns it: with its kind, without managedFields."""
    metadata = {name: value for name, value in body["metadata"].items() if name != "managedFields"}
    return {**body, "apiVersion": kind.api_version, "kind": kind.name, "metadata": metadata}
