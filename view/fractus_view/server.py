"""Web server of the view. It serves the page, the event stream and pictures to clients with the token."""

from __future__ import annotations

import asyncio
import hmac
import logging
import mimetypes
import secrets
from base64 import b64decode
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from dataclasses import asdict, dataclass, field
from ipaddress import ip_address
from pathlib import Path

from aiohttp import hdrs, web
from fractus_runtime.connection_limit import mark_authorized
from fractus_runtime.metrics import gauge
from fractus_runtime.page_headers import PAGE_HEADERS
from fractus_runtime.thumbnails import thumbnail
from prometheus_client import Counter, Metric

from fractus_view.base_map import MAX_ZOOM, BaseMap, image_type
from fractus_view.sources import Source

log = logging.getLogger(__name__)

PAGE = Path(__file__).parent / "page"
"""Page built from `view/web` by `make view`."""

WRITE_TIMEOUT_S = 30.0
"""Time, in seconds, after which a client that reads nothing is disconnected."""

KEEPALIVE_S = 15.0
"""Time without events, in seconds, after which a comment is sent to detect broken connections."""

MAX_STREAMS = 64

TRANSPARENT_PNG = b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNkYPhfDwAChwGA60e6kgAAAABJRU5ErkJggg=="
)
"""Image for a missing tile. Browsers would report every other response as an error."""

HEALTH_PATH = "/healthz"
"""The only path that needs no token."""

_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


@dataclass
class ViewServer:
    """The server.

    Attributes:
        source: Source of events and pictures.
        names: Host names by which browsers may address the server, besides IP addresses and localhost.
        token: Token that clients need. After a change, open pages with the old token are disconnected within `KEEPALIVE_S`.
        page: Directory of the built page.
        base_map: Base map of the page, or None for a plain background.
    """

    source: Source
    names: frozenset[str]
    token: str = field(default_factory=lambda: secrets.token_urlsafe(32))
    page: Path = PAGE
    base_map: BaseMap | None = None
    _streams: set[object] = field(default_factory=set)
    _responses: Counter = field(
        default_factory=lambda: Counter(
            "fractus_view_requests_total",
            "Requests by status code of the response, including health checks. 401: without the token.",
            ["code"],
            registry=None,
        )
    )
    _running: asyncio.Task[None] | None = None

    def application(self) -> web.Application:
        """Return the aiohttp application.

        Raises:
            OSError: The page was not built.
        """
        application = web.Application(middlewares=[self._check_method, self._check_host, self._check_token])
        application.on_response_prepare.extend((_add_security_headers, self._count))
        files = {path.relative_to(self.page).as_posix(): path.read_bytes() for path in _files(self.page)}
        for name, data in files.items():
            application.router.add_get("/" if name == "index.html" else f"/{name}", _static(name, data))
        application.router.add_get(HEALTH_PATH, self._health)
        application.router.add_get("/stream", self._stream)
        application.router.add_get("/pictures/{id}", self._picture)
        application.router.add_get("/thumbnails/{id}", self._thumbnail)
        application.router.add_get("/map.json", self._map)
        application.router.add_get(r"/tiles/{zoom:[0-9]{1,2}}/{x:[0-9]{1,8}}/{y:[0-9]{1,8}}", self._tile)
        application.cleanup_ctx.append(self._run)
        return application

    def metrics(self) -> Iterator[Metric]:
        """Yield the metrics of the server."""
        yield from self._responses.collect()
        yield gauge("fractus_view_pages", f"Open pages, at most {MAX_STREAMS}.", len(self._streams))

    async def _count(self, _request: web.Request, response: web.StreamResponse) -> None:
        self._responses.labels(str(response.status)).inc()

    async def _run(self, _application: web.Application) -> AsyncIterator[None]:
        """Run the source while the server runs. If the source fails, the health check reports it."""
        self._running = task = asyncio.create_task(self.source.run())
        task.add_done_callback(_log_failure)
        yield
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    async def _health(self, _request: web.Request) -> web.Response:
        """Health check for restarts. The response contains no data of flights."""
        task = self._running
        failed = task is None or (task.done() and (task.cancelled() or task.exception() is not None))
        if failed:
            return web.Response(status=503, text="the source of events has failed; restart the view\n")
        return web.Response(text="ok\n")

    @web.middleware
    async def _check_method(self, request: web.Request, handler: _Handler) -> web.StreamResponse:
        if request.method not in {hdrs.METH_GET, hdrs.METH_HEAD}:
            text = "this server is read-only; use GET or HEAD\n"
            return web.Response(status=405, text=text, headers={hdrs.ALLOW: "GET, HEAD"})
        return await handler(request)

    @web.middleware
    async def _check_host(self, request: web.Request, handler: _Handler) -> web.StreamResponse:
        """Reject other host names, by which a web site could read the page through a user's browser (DNS rebinding)."""
        if not _is_permitted_host(request.headers.get(hdrs.HOST, ""), self.names):
            return web.Response(
                status=421, text="use the IP address of this server, localhost, or a name of --listen or --hostname\n"
            )
        return await handler(request)

    @web.middleware
    async def _check_token(self, request: web.Request, handler: _Handler) -> web.StreamResponse:
        token = request.query.get("token")
        if request.path == "/" and token is not None and self._is_token(token):
            # Redirect, so that the address in histories and logs does not contain the token.
            response = web.Response(status=303, headers={hdrs.LOCATION: "/"})
            response.set_cookie(
                _cookie(request), self.token, httponly=True, secure=_uses_tls(request), samesite="Strict", path="/"
            )
            return response
        if self._is_authorized(request):
            mark_authorized(request)
            return await handler(request)
        if request.path == HEALTH_PATH:
            return await handler(request)
        return web.Response(status=401, text="open the address that `fractus view` printed; it contains the token\n")

    def _is_authorized(self, request: web.Request) -> bool:
        bearer = request.headers.get(hdrs.AUTHORIZATION, "").removeprefix("Bearer ")
        return self._is_token(request.cookies.get(_cookie(request), "")) or self._is_token(bearer)

    def _is_token(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(errors="replace"), self.token.encode())

    async def _thumbnail(self, request: web.Request) -> web.Response:
        jpeg = await asyncio.to_thread(self.source.picture, request.match_info["id"])
        return _jpeg(await asyncio.to_thread(thumbnail, jpeg) if jpeg is not None else None)

    async def _picture(self, request: web.Request) -> web.Response:
        return _jpeg(await asyncio.to_thread(self.source.picture, request.match_info["id"]))

    async def _map(self, _request: web.Request) -> web.Response:
        """Return the description of the base map as JSON, or null without a base map."""
        return web.json_response(None if self.base_map is None else asdict(self.base_map.info))

    async def _tile(self, request: web.Request) -> web.Response:
        """Return a tile of the base map. A missing tile is transparent."""
        zoom, x, y = (int(request.match_info[name]) for name in ("zoom", "x", "y"))
        if self.base_map is None or zoom > MAX_ZOOM or max(x, y) >= 1 << zoom:
            return web.Response(status=404, text="the base map has no such tile\n")
        data = await asyncio.to_thread(self.base_map.tile, zoom, x, y)
        type_ = image_type(data) if data is not None else None
        if type_ is None:
            data = TRANSPARENT_PNG
            type_ = "image/png"
        return web.Response(body=data, content_type=type_, headers={hdrs.CACHE_CONTROL: "private, max-age=3600"})

    async def _stream(self, request: web.Request) -> web.StreamResponse:
        head = {hdrs.CONTENT_TYPE: "text/event-stream", hdrs.CACHE_CONTROL: "no-store", "X-Accel-Buffering": "no"}
        if request.method == hdrs.METH_HEAD:
            return web.Response(headers=head)
        if len(self._streams) >= MAX_STREAMS:
            return web.Response(status=503, text=f"{MAX_STREAMS} pages are open, which is the limit; close one\n")
        response = web.StreamResponse(headers=head)
        stream = object()
        self._streams.add(stream)
        try:
            await response.prepare(request)
            await self._send(request, response)
        except (ConnectionError, TimeoutError):
            # The client has disconnected or is too slow. It reconnects with the id of its last message.
            if request.transport is not None:
                request.transport.abort()
        finally:
            self._streams.discard(stream)
        return response

    async def _send(self, request: web.Request, response: web.StreamResponse) -> None:
        messages = self.source.stream(request.headers.get("Last-Event-ID", ""))
        pending = asyncio.ensure_future(anext(messages, None))
        try:
            while True:
                done, _ = await asyncio.wait({pending}, timeout=KEEPALIVE_S)
                message = pending.result() if done else b":\n\n"
                if message is None or not self._is_authorized(request):
                    return
                if done:
                    pending = asyncio.ensure_future(anext(messages, None))
                async with asyncio.timeout(WRITE_TIMEOUT_S):
                    await response.write(message)
        finally:
            pending.cancel()


def _jpeg(data: bytes | None) -> web.Response:
    """Return the response with a picture."""
    if data is None:
        return web.Response(status=404, text="picture not found; its recording may have been removed to free space\n")
    return web.Response(body=data, content_type="image/jpeg", headers={hdrs.CACHE_CONTROL: "private, max-age=3600"})


def _log_failure(task: asyncio.Task[None]) -> None:
    if not task.cancelled() and task.exception() is not None:
        log.error("view: source failed, restart the view", exc_info=task.exception())


def _cookie(request: web.Request) -> str:
    """Return the name of the cookie.

    The name contains the port, because browsers send cookies to all servers of a host.
    """
    _, _, port = request.headers.get(hdrs.HOST, "").rpartition(":")
    return f"fractus-view-{port if port.isdecimal() else 80}"


def _uses_tls(request: web.Request) -> bool:
    """Return True if the browser uses TLS, to this server or to a proxy before it.

    The header of the proxy is not authenticated. A client that forges the header only makes its own cookie unusable.
    """
    return request.secure or request.headers.get("X-Forwarded-Proto", "").lower() == "https"


def _is_permitted_host(host: str, names: frozenset[str]) -> bool:
    """Return True if a Host header contains an IP address, localhost or a permitted name."""
    name = host.rpartition(":")[0] if host.rpartition(":")[2].isdecimal() else host
    name = name.removeprefix("[").removesuffix("]").lower()
    if name in names | {"localhost"}:
        return True
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


async def _add_security_headers(_request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(PAGE_HEADERS)


def _files(page: Path) -> list[Path]:
    (page / "index.html").stat()
    # The management API serves plans.html, because that page sends requests to the API on its own host.
    return sorted(path for path in page.rglob("*") if path.is_file() and path.name != "plans.html")


def _static(name: str, data: bytes) -> _Handler:
    media_type = mimetypes.guess_type(name)[0] or "application/octet-stream"
    if name.endswith((".js", ".mjs")):
        media_type = "text/javascript"
    # File names in assets contain a digest of the content.
    caching = "private, max-age=31536000, immutable" if name.startswith("assets/") else "no-store"

    async def respond(_request: web.Request) -> web.Response:
        charset = "utf-8" if media_type.startswith("text/") else None
        return web.Response(body=data, content_type=media_type, charset=charset, headers={hdrs.CACHE_CONTROL: caching})

    return respond
