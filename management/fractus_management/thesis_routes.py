"""Table 7.1 of the thesis: the paths of its client API, with names of objects instead of numbers."""

from __future__ import annotations

from fastapi import APIRouter
from fastapi.routing import APIRoute

from fractus_management import drone_routes, plan_routes, template_routes

_PATHS = {
    "/drones": "/drones",
    "/drones/{name}": "/drones/{name}",
    "/apps": "/apps",
    "/apps/{name}": "/apps/{name}",
    "/apps/{name}/drones": "/apps/{name}/drones",
    "/app_plan": "/plans",
    "/app_plan/{name}": "/plans/{name}",
    "/app_status/{name}": "/plans/{name}/status",
}
"""Paths of the thesis with the paths below /v1 that they stand for."""

router = APIRouter(tags=["thesis"])
for _alias, _path in _PATHS.items():
    for _route in (*drone_routes.router.routes, *template_routes.router.routes, *plan_routes.router.routes):
        if isinstance(_route, APIRoute) and _route.path_format == _path:
            router.add_api_route(
                _alias,
                _route.endpoint,
                methods=sorted(_route.methods or ()),
                status_code=_route.status_code,
                response_model=_route.response_model,
                responses=_route.responses,
                name=f"thesis_{_route.name}",
            )
