"""The web application: routes, error responses, limits and health."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from importlib.metadata import version

from fastapi import APIRouter, FastAPI, Request
from fastapi.responses import JSONResponse, Response
from fractus_runtime.kubernetes import Client
from fractus_runtime.metrics import gauge
from prometheus_client import Metric

from fractus_management import (
    drone_routes,
    event_routes,
    permission_routes,
    plan_routes,
    record_routes,
    restriction_routes,
    template_routes,
    thesis_routes,
)
from fractus_management.interuss import routes as interuss_routes
from fractus_management.openapi import install_document
from fractus_management.page_routes import page_router
from fractus_management.problem_details import install_handlers, refused
from fractus_management.request_guard import RequestGuard, RequestMetrics
from fractus_management.request_limits import RequestLimits
from fractus_management.settings import Settings

RESPONSE_TIMEOUT_S = 2.0
"""Time in which the API server must respond for this process to be ready."""

ROUTERS = (
    drone_routes.router,
    template_routes.router,
    plan_routes.router,
    event_routes.router,
    record_routes.router,
    restriction_routes.router,
    permission_routes.router,
)
"""Routers below /v1. Each resource has a module with its router."""

health = APIRouter(include_in_schema=False)


@health.get("/healthz")
async def _healthy() -> Response:
    return JSONResponse({"status": "ok"})


@health.get("/readyz")
async def _ready(request: Request) -> Response:
    if not await request.app.state.client.responds(RESPONSE_TIMEOUT_S):
        raise refused(503, "Unreachable", "the Kubernetes API server does not respond")
    return JSONResponse({"status": "ok"})


def create_app(settings: Settings, client: Client | None = None) -> FastAPI:
    """Return the application.

    Args:
        settings: Settings of the API.
        client: Connection to the API server without credentials. None only describes the API.
    """
    app = FastAPI(
        title="Fractus management API",
        description="Flights as a service. Each request acts with the permissions of its bearer token.",
        version=version("fractus-drones"),
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        separate_input_output_schemas=False,
        generate_unique_id_function=lambda route: route.name,
    )
    app.state.settings = settings
    app.state.client = client
    app.state.stopping = asyncio.Event()
    app.state.limits = RequestLimits(settings)
    app.state.requests = RequestMetrics()
    app.add_middleware(RequestGuard, settings=settings, metrics=app.state.requests)
    install_handlers(app)
    install_document(app)
    for router in ROUTERS:
        app.include_router(router, prefix="/v1")
    app.include_router(thesis_routes.router)
    app.include_router(health)
    app.include_router(page_router())
    if settings.automated_testing is not None:
        app.state.kept_responses = interuss_routes.KeptResponses()
        app.include_router(interuss_routes.router)
    return app


def collect(app: FastAPI) -> Iterator[Metric]:
    """Yield the metrics of the API."""
    yield from app.state.requests.collect()
    yield gauge("fractus_api_streams", "Open event streams and transfers of pictures.", app.state.limits.streams)
