"""Error responses: problem details (RFC 9457) with the reasons of the error."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fractus_core.api.model import InvalidObject, Model
from fractus_runtime.kubernetes import KubeError
from pydantic import Field
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.routing import compile_path

log = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"
RETRY_S = 1
"""Value of Retry-After, in seconds, if the API server or the operator does not respond."""

_FORWARDED = frozenset({400, 401, 403, 404, 409, 410, 413, 422, 429})
"""Statuses of the API server that describe the request of the caller."""


class Reason(Model):
    """One reason of an error."""

    reason: str = Field(description="Machine-readable CamelCase reason.")
    message: str = Field(description="Human-readable explanation with the remedy.")
    field: str | None = Field(default=None, description="Field of the request to which the reason applies.")


class Problem(Model):
    """Error response (RFC 9457)."""

    type: str = Field(default="about:blank", description="Always about:blank: the title is that of the status.")
    title: str = Field(description="Name of the HTTP status.")
    status: int = Field(ge=400, le=599, description="HTTP status.")
    detail: str = Field(description="Human-readable explanation.")
    reasons: tuple[Reason, ...] = Field(min_length=1, description="Reasons of the error.")


class Refused(Exception):
    """A request is refused.

    Attributes:
        status: HTTP status.
        reasons: Reasons, at least one.
        headers: Additional headers of the response.
    """

    def __init__(self, status: int, *reasons: Reason, headers: Mapping[str, str] | None = None) -> None:
        self.status = status
        self.reasons = reasons
        self.headers = dict(headers or {})
        if status == HTTPStatus.UNAUTHORIZED:
            self.headers["WWW-Authenticate"] = "Bearer"
        if status in {HTTPStatus.SERVICE_UNAVAILABLE, HTTPStatus.TOO_MANY_REQUESTS}:
            self.headers.setdefault("Retry-After", str(RETRY_S))
        super().__init__(reasons[0].message)

    @property
    def problem(self) -> Problem:
        """The error as problem details."""
        detail = "; ".join(reason.message for reason in self.reasons)
        return Problem(title=HTTPStatus(self.status).phrase, status=self.status, detail=detail, reasons=self.reasons)

    def response(self) -> Response:
        """Return the error response."""
        content = json.dumps(self.problem.to_dict())
        return Response(content, self.status, self.headers, media_type=MEDIA_TYPE)


def refused(status: int, reason: str, message: str, field: str | None = None) -> Refused:
    """Return the error with a single reason."""
    return Refused(status, Reason(reason=reason, message=message, field=field))


def invalid(error: InvalidObject) -> Refused:
    """Return the error for an invalid request."""
    return refused(HTTPStatus.UNPROCESSABLE_ENTITY, "Invalid", str(error), error.field or None)


def from_kubernetes(error: KubeError) -> Refused:
    """Return the error for a refusal of the API server. Other failures of the API server are 503."""
    if error.status not in _FORWARDED:
        message = f"the Kubernetes API server did not process the request, try again: {error}"
        return refused(HTTPStatus.SERVICE_UNAVAILABLE, error.reason, message)
    if error.status == HTTPStatus.UNAUTHORIZED:
        message = "the bearer token is invalid or has expired; get a new one, for example with kubectl create token"
        return refused(HTTPStatus.UNAUTHORIZED, "Unauthorized", message)
    causes = [
        Reason(reason=cause.get("reason") or error.reason, message=str(cause["message"]), field=cause.get("field"))
        for cause in error.causes
        if cause.get("message")
    ]
    return Refused(error.status, *(causes or [Reason(reason=error.reason, message=str(error))]))


def install_handlers(app: FastAPI) -> None:
    """Let every error response of an app be problem details."""

    @app.exception_handler(Refused)
    async def _(_request: Request, error: Refused) -> Response:
        return error.response()

    @app.exception_handler(KubeError)
    async def _(_request: Request, error: KubeError) -> Response:
        return from_kubernetes(error).response()

    @app.exception_handler(RequestValidationError)
    async def _(_request: Request, error: RequestValidationError) -> Response:
        return _from_validation(error.errors()).response()

    @app.exception_handler(HTTPException)
    async def _(request: Request, error: HTTPException) -> Response:
        reason = HTTPStatus(error.status_code).phrase.title().replace(" ", "")
        headers = dict(error.headers or {})
        message = error.detail
        if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
            headers["Allow"] = ", ".join(sorted(_methods(app, request.url.path))) or headers.get("Allow", "")
            message = f"{request.method} is not possible here; use {headers['Allow']}"
        if error.status_code == HTTPStatus.NOT_FOUND:
            message = f"there is no {request.url.path}; see /openapi.json"
        return Refused(error.status_code, Reason(reason=reason, message=message), headers=headers).response()

    @app.exception_handler(Exception)
    async def _(_request: Request, _error: Exception) -> Response:
        # uvicorn logs the exception.
        return refused(HTTPStatus.INTERNAL_SERVER_ERROR, "InternalError", "internal error; see the log").response()


def _methods(app: FastAPI, path: str) -> set[str]:
    """Return the documented methods of a path. Starlette would return the methods of a single route."""
    documented = app.openapi()["paths"].items()
    patterns = ((compile_path(each.replace("}", ":object}"))[0], item) for each, item in documented)
    return {method.upper() for pattern, item in patterns if pattern.match(path) for method in item}


def _from_validation(findings: Sequence[Any]) -> Refused:
    status = HTTPStatus.UNPROCESSABLE_ENTITY
    reasons = []
    for finding in findings:
        place, *path = finding["loc"]
        inner = finding.get("ctx", {}).get("error")
        field = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path).removeprefix(".")
        message = str(finding["msg"])
        if finding["type"] == "json_invalid":
            status = HTTPStatus.BAD_REQUEST
            field = ""
            message = f"the body is not JSON: {inner}"
        elif isinstance(inner, InvalidObject):
            joint = "." if field and inner.field and not inner.field.startswith("[") else ""
            field += joint + inner.field
            message = f"{field}: {inner.problem}" if field else inner.problem
        elif place == "body":
            message = f"body: {message[:1].lower()}{message[1:]}"
        else:
            message = f"{place} parameter {field}: {message[:1].lower()}{message[1:]}"
        reasons.append(Reason(reason="Invalid", message=message, field=field or None))
    return Refused(status, *reasons)
