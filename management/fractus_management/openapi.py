"""OpenAPI description, generated from the routes and the models of the kinds."""

from __future__ import annotations

import json
from typing import Any

from fastapi import FastAPI

from fractus_management.problem_details import MEDIA_TYPE, Problem

Responses = dict[int | str, dict[str, Any]]

_EVERYWHERE = (400, 401, 403, 404, 422, 429, 500, 503)
_ETAG = {"description": "Version of the object, for If-Match.", "schema": {"type": "string"}}
_LOCATION = {"description": "Path of the object.", "schema": {"type": "string"}}


def problems(*statuses: int) -> Responses:
    """Return the error responses of a route, by default those of every route."""
    return {status: {"$ref": "#/components/responses/Problem"} for status in statuses or _EVERYWHERE}


def etag_header(description: str = "The plan.", model: Any = None) -> dict[str, Any]:
    """Return the description of a response with an ETag."""
    return {"description": description, "headers": {"ETag": _ETAG}} | ({"model": model} if model else {})


def located(
    description: str, model: Any = None, follow: tuple[str, ...] = (), name: str = "/metadata/name"
) -> dict[str, Any]:
    """Return the description of a response to a submission.

    Args:
        description: Meaning of the response.
        model: Model of the body, unless it is that of the route.
        follow: Names of the routes to which the name of the created object can be passed.
        name: JSON pointer to this name in the body.
    """
    response = etag_header(description, model)
    parameters = {"name": f"$response.body#{name}"}
    links = {operation: {"operationId": operation, "parameters": parameters} for operation in follow}
    return response | {"headers": {"ETag": _ETAG, "Location": _LOCATION}, "links": links}


def install_document(app: FastAPI) -> None:
    """Let an app serve its description with the schema of problems."""
    generate = app.openapi

    def document() -> dict[str, Any]:
        if app.openapi_schema is None:
            components = generate()["components"]
            schema = Problem.model_json_schema(by_alias=True, ref_template="#/components/schemas/{model}")
            components["schemas"] |= {**schema.pop("$defs"), "Problem": schema}
            content = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
            components["responses"] = {"Problem": {"description": "Error (RFC 9457).", "content": content}}
        assert app.openapi_schema is not None
        return app.openapi_schema

    app.openapi = document  # type: ignore[method-assign]  # FastAPI documents this way of extending the description


def text(app: FastAPI) -> str:
    """Return the description as JSON."""
    return json.dumps(app.openapi(), indent=1, sort_keys=True) + "\n"
