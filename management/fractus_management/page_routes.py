"""Web page of flight plans. The page sends requests to the API on its own host, with the token of its user."""

from __future__ import annotations

import mimetypes
from importlib.resources import files
from importlib.resources.abc import Traversable

from fastapi import APIRouter
from fastapi.responses import Response
from fractus_runtime.page_headers import PAGE_HEADERS


def page_router() -> APIRouter:
    """Return the routes of the page, which `make view` builds together with the page of the view.

    Raises:
        OSError: The page was not built.
    """
    page = files("fractus_view") / "page"
    router = APIRouter(include_in_schema=False)
    _add(router, "/", page / "plans.html")
    _add(router, "/icon.svg", page / "icon.svg")
    for asset in (page / "assets").iterdir():
        _add(router, f"/assets/{asset.name}", asset)
    return router


def _add(router: APIRouter, path: str, file: Traversable) -> None:
    content = file.read_bytes()
    media_type = mimetypes.guess_type(file.name)[0] or "application/octet-stream"
    if file.name.endswith((".js", ".mjs")):
        media_type = "text/javascript"
    # File names in assets contain a digest of the content.
    caching = "public, max-age=31536000, immutable" if path.startswith("/assets/") else "no-cache"

    @router.get(path)
    async def _file() -> Response:
        return Response(content, media_type=media_type, headers={**PAGE_HEADERS, "Cache-Control": caching})
