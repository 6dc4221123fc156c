"""Recording endpoint: HTTPS server that returns the records of a plan's flight to callers with permission to read them."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import re
import socket
import ssl
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any, Protocol

from aiohttp import hdrs, web
from fractus_core.api import FlightPlan, InvalidObject
from fractus_core.api.flight_records import MAX_RECORDS, PicturePage, TrackPage, VerdictPage
from fractus_core.api.names import is_subdomain
from fractus_runtime.connection_limit import ConnectionLimit, mark_authorized

from fractus_agent.identity import NodeIdentity
from fractus_agent.records.audit_records import InvalidContinue, read_track, read_verdicts
from fractus_agent.records.picture_records import NotRecorded, read_picture, read_pictures
from fractus_agent.records.planned_flight import NoFlight, PlannedFlight, planned_flight
from fractus_agent.store import KubeError, Object

log = logging.getLogger(__name__)

DEFAULT_LIMIT = 100
MAX_CONNECTIONS = 32
ACCEPT_INTERVAL_S = 0.05
"""Seconds between two accepted connections. Each connection serves one request, so at most 20 requests per second reach the API server."""
HANDSHAKE_TIMEOUT_S = 5.0
TURN_TIMEOUT_S = 10.0
"""Seconds for which a request waits for the requests before it. Records are read for one request at a time."""
SEND_TIMEOUT_S = 120.0
MAX_TRANSFERS = 16
MAX_UNSENT_BYTES = 24_000_000
"""Maximum size of the responses that are being sent. Above it, and above `MAX_TRANSFERS`, the oldest transfer is aborted."""
RETRY_S = 5.0
_CHUNK_BYTES = 64 * 1024
_TOKEN = re.compile(r"Bearer ([A-Za-z0-9._~+/=-]+)")

Read = Callable[[web.Request, PlannedFlight], tuple[str, bytes]]
"""Returns media type and content of a response. It runs in a thread."""


class PlanReader(Protocol):
    """Reads plans with the token of a caller."""

    async def plan_with_records(self, token: str, namespace: str, name: str) -> Object:
        """See `Store.plan_with_records`."""


class Refused(Exception):
    """A request is refused.

    Attributes:
        status: HTTP status.
        reason: CamelCase reason.
    """

    def __init__(self, status: int, reason: str, message: str) -> None:
        self.status = status
        self.reason = reason
        super().__init__(message)


@dataclass(frozen=True, slots=True, eq=False)
class _Transfer:
    """A response that is being sent, with its size in bytes."""

    request: web.Request
    size: int


class RecordServer:
    """HTTPS server of the recording endpoint.

    Args:
        listen: HOST:PORT.
        node: Name of the node.
        state: State directory of the node.
        tls: Directory of the node's certificate and key.
        plans: Reads plans with the token of a caller.
    """

    def __init__(self, listen: str, node: str, state: Path, tls: Path, plans: PlanReader) -> None:
        self._listen = listen
        self._node = node
        self._audit = state / "audit"
        self._pictures = state / "recordings" / "camera"
        self._tls = tls
        self._plans = plans
        self._turn = asyncio.Lock()
        self._transfers: dict[_Transfer, None] = {}
        """Responses that are being sent, oldest first."""
        self._problem = ""

    async def run(self, identity: NodeIdentity) -> None:
        """Serve until cancelled, once the node has a certificate."""
        await identity.ready.wait()
        runner = web.AppRunner(self._application(), access_log=None, handle_signals=False, shutdown_timeout=1.0)
        await runner.setup()
        assert runner.server is not None
        try:
            with await self._bound() as listener:
                await self._accept(listener, ConnectionLimit(runner.server, MAX_CONNECTIONS), identity)
        finally:
            await runner.cleanup()

    # -- connections --

    async def _bound(self) -> socket.socket:
        """Return a listening socket. Retry until the address can be bound."""
        reported = False
        while True:
            try:
                return await _listener(self._listen)
            except (OSError, OverflowError, ValueError) as error:
                if not reported:
                    log.warning("records: not served (address=%s error=%s)", self._listen, error)
                reported = True
                await asyncio.sleep(RETRY_S)

    async def _accept(self, listener: socket.socket, factory: ConnectionLimit, identity: NodeIdentity) -> None:
        loop = asyncio.get_running_loop()
        context: ssl.SSLContext | None = None
        serial = -1
        async with asyncio.TaskGroup() as handshakes:
            while True:
                try:
                    connection, _ = await loop.sock_accept(listener)
                except OSError as error:
                    log.debug("records: connection not accepted (error=%s)", error)
                    await asyncio.sleep(RETRY_S)
                    continue
                renewed = self._context() if serial != identity.serial else None
                if renewed is not None:
                    serial = identity.serial
                    context = renewed
                if context is None:
                    connection.close()
                else:
                    handshakes.create_task(_begin(connection, factory, context))
                await asyncio.sleep(ACCEPT_INTERVAL_S)

    def _context(self) -> ssl.SSLContext | None:
        """Return the TLS context with the present certificate, or None if it cannot be read."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_3
        try:
            context.load_cert_chain(self._tls / "tls.crt", self._tls / "tls.key")
        except (OSError, ValueError) as error:
            if str(error) != self._problem:
                log.warning("records: certificate not usable (directory=%s error=%s)", self._tls, error)
            self._problem = str(error)
            return None
        self._problem = ""
        return context

    # -- requests --

    def _application(self) -> web.Application:
        application = web.Application()
        root = "/v1/namespaces/{namespace}/plans/{name}"
        routes = (
            ("verdicts", self._verdicts),
            ("track", self._track),
            ("pictures", self._list_pictures),
            ("pictures/{id}", self._picture),
        )
        for path, read in routes:
            application.router.add_get(f"{root}/{path}", self._handler(read), allow_head=False)
        return application

    def _handler(self, read: Read) -> Callable[[web.Request], Awaitable[web.StreamResponse]]:
        async def handle(request: web.Request) -> web.StreamResponse:
            try:
                return await self._answer(request, read)
            except Refused as refusal:
                log.info("records: request refused (path=%s reason=%s)", request.rel_url.raw_path, refusal.reason)
                content = json.dumps({"reason": refusal.reason, "message": str(refusal)}).encode()
                return await _send(request, refusal.status, "application/json", content)

        return handle

    async def _answer(self, request: web.Request, read: Read) -> web.StreamResponse:
        flight = await self._permitted_flight(request)
        mark_authorized(request)
        try:
            await asyncio.wait_for(self._turn.acquire(), TURN_TIMEOUT_S)
        except TimeoutError:
            message = f"{self._node} is reading records for other requests; try again"
            raise Refused(HTTPStatus.SERVICE_UNAVAILABLE, "NodeBusy", message) from None
        try:
            media_type, content = await asyncio.to_thread(read, request, flight)
        except InvalidContinue as error:
            raise Refused(HTTPStatus.BAD_REQUEST, "InvalidContinue", str(error)) from error
        except NotRecorded:
            message = f"the camera service of {self._node} records no pictures; the provider of the drone can set camera.recordings.enabled"
            raise Refused(HTTPStatus.NOT_FOUND, "NotRecorded", message) from None
        except OSError as error:
            log.warning("records: cannot be read (error=%s)", error)
            message = f"the disk of {self._node} cannot be read: {error.strerror}"
            raise Refused(HTTPStatus.SERVICE_UNAVAILABLE, "Unreadable", message) from error
        finally:
            self._turn.release()
        log.info("records: sending (path=%s bytes=%d)", request.rel_url.raw_path, len(content))
        return await self._transfer(request, media_type, content)

    async def _transfer(self, request: web.Request, media_type: str, content: bytes) -> web.StreamResponse:
        """Send records. The next request is read meanwhile, so slow callers do not block other callers."""
        others = self._transfers
        while others and (
            len(others) >= MAX_TRANSFERS or sum(each.size for each in others) + len(content) > MAX_UNSENT_BYTES
        ):
            oldest = next(iter(others))
            log.info("records: transfer aborted for another one (path=%s)", oldest.request.rel_url.raw_path)
            del others[oldest]
            _abort(oldest.request)
        transfer = _Transfer(request, len(content))
        self._transfers[transfer] = None
        try:
            return await _send(request, HTTPStatus.OK, media_type, content)
        finally:
            self._transfers.pop(transfer, None)

    async def _permitted_flight(self, request: web.Request) -> PlannedFlight:
        """Return the flight whose records the caller may read.

        Raises:
            Refused: The caller may not read them, the API server does not respond, or there is no flight.
        """
        token = _TOKEN.fullmatch(request.headers.get(hdrs.AUTHORIZATION, ""))
        if token is None:
            raise Refused(HTTPStatus.UNAUTHORIZED, "Unauthorized", "send the header Authorization: Bearer TOKEN")
        namespace = request.match_info["namespace"]
        name = request.match_info["name"]
        # Other texts would change the path of the request to the API server.
        if not is_subdomain(namespace) or not is_subdomain(name):
            raise Refused(HTTPStatus.NOT_FOUND, "NotFound", "not the name of a namespace or a flight plan")
        try:
            plan = FlightPlan.from_body(await self._plans.plan_with_records(token[1], namespace, name))
            return planned_flight(plan, self._node)
        except KubeError as error:
            if error.status in {HTTPStatus.UNAUTHORIZED, HTTPStatus.FORBIDDEN, HTTPStatus.NOT_FOUND}:
                raise Refused(error.status, error.reason, str(error)) from error
            message = (
                f"{self._node} cannot check your permission, because the API server does not respond to it; try again"
            )
            raise Refused(HTTPStatus.SERVICE_UNAVAILABLE, "Unreachable", message) from error
        except InvalidObject as error:
            raise Refused(HTTPStatus.SERVICE_UNAVAILABLE, "Invalid", f"the flight plan is invalid: {error}") from error
        except NoFlight as error:
            raise Refused(HTTPStatus.CONFLICT, "NoFlight", str(error)) from error

    # -- records; these methods run in threads --

    def _verdicts(self, request: web.Request, flight: PlannedFlight) -> tuple[str, bytes]:
        verdicts = read_verdicts(self._audit, flight, *_paging(request))
        return _json(VerdictPage(items=tuple(verdicts.items), continue_=verdicts.continue_).to_dict())

    def _track(self, request: web.Request, flight: PlannedFlight) -> tuple[str, bytes]:
        track = read_track(self._audit, flight, *_paging(request))
        return _json(TrackPage(items=tuple(track.items), continue_=track.continue_).to_dict())

    def _list_pictures(self, request: web.Request, flight: PlannedFlight) -> tuple[str, bytes]:
        pictures = read_pictures(self._pictures, flight, *_paging(request))
        return _json(PicturePage(items=tuple(pictures.items), continue_=pictures.continue_).to_dict())

    def _picture(self, request: web.Request, flight: PlannedFlight) -> tuple[str, bytes]:
        jpeg = read_picture(self._pictures, flight, request.match_info["id"])
        if jpeg is None:
            message = (
                "the flight has no recorded picture with this id; its recording may have been removed to free space"
            )
            raise Refused(HTTPStatus.NOT_FOUND, "NotFound", message)
        return "image/jpeg", jpeg


async def _listener(listen: str) -> socket.socket:
    """Return a listening socket of HOST:PORT.

    Raises:
        OSError, OverflowError, ValueError: The address cannot be bound.
    """
    host, _, port = listen.rpartition(":")
    loop = asyncio.get_running_loop()
    candidates = await loop.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)
    family, _, _, _, address = candidates[0]
    listener = socket.create_server(address, family=family)
    listener.setblocking(False)
    return listener


async def _begin(connection: socket.socket, factory: ConnectionLimit, context: ssl.SSLContext) -> None:
    """Perform the TLS handshake of a connection, and pass the connection to the web server."""
    loop = asyncio.get_running_loop()
    try:
        await loop.connect_accepted_socket(
            factory, connection, ssl=context, ssl_handshake_timeout=HANDSHAKE_TIMEOUT_S, ssl_shutdown_timeout=1.0
        )
    except (OSError, ValueError) as error:
        log.debug("records: handshake failed (error=%s)", error)
        connection.close()


def _paging(request: web.Request) -> tuple[int, str]:
    """Return the parameters limit and continue.

    Raises:
        Refused: `limit` is invalid.
    """
    text = request.query.get("limit", str(DEFAULT_LIMIT))
    limit = int(text) if re.fullmatch(r"[0-9]{1,6}", text) else 0
    if not 1 <= limit <= MAX_RECORDS:
        raise Refused(HTTPStatus.BAD_REQUEST, "InvalidLimit", f"limit: use a number from 1 to {MAX_RECORDS}")
    return limit, request.query.get("continue", "")


def _json(body: dict[str, Any]) -> tuple[str, bytes]:
    return "application/json", json.dumps(body).encode()


async def _send(request: web.Request, status: int, media_type: str, content: bytes) -> web.StreamResponse:
    """Send a response in limited time, and close the connection."""
    response = web.StreamResponse(
        status=status, headers={hdrs.CONTENT_TYPE: media_type, hdrs.CACHE_CONTROL: "no-store"}
    )
    response.content_length = len(content)
    response.force_close()
    try:
        async with asyncio.timeout(SEND_TIMEOUT_S):
            await response.prepare(request)
            for begin in range(0, len(content), _CHUNK_BYTES):
                await response.write(content[begin : begin + _CHUNK_BYTES])
            await response.write_eof()
    except (ConnectionError, TimeoutError):
        _abort(request)
    return response


def _abort(request: web.Request) -> None:
    """Close the connection of a request at once."""
    if request.transport is not None:
        with contextlib.suppress(RuntimeError):
            request.transport.abort()
