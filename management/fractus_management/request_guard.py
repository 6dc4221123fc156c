"""Middleware for every request: size and time limit of the body, log and metrics."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Iterator
from http import HTTPStatus
from urllib.parse import quote

from prometheus_client import Counter, Histogram, Metric
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fractus_management.settings import Settings

log = logging.getLogger(__name__)

_QUIET = frozenset({"/healthz", "/readyz"})


class RequestMetrics:
    """Prometheus metrics of the requests."""

    def __init__(self) -> None:
        self._responses = Counter(
            "fractus_api_requests_total", "Requests by method and status.", ["method", "code"], registry=None
        )
        self._seconds = Histogram(
            "fractus_api_response_seconds",
            "Time until the response begins, including the wait for a decision, by method.",
            ["method"],
            buckets=(0.01, 0.03, 0.1, 0.3, 0.5, 1, 3, 10, 30),
            registry=None,
        )

    def count(self, method: str, status: int, seconds: float) -> None:
        """Count a response."""
        known = method if method in {"GET", "POST", "PUT", "PATCH", "DELETE"} else "other"
        self._responses.labels(known, str(status)).inc()
        self._seconds.labels(known).observe(seconds)

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics."""
        yield from self._responses.collect()
        yield from self._seconds.collect()


class RequestGuard:
    """ASGI middleware that limits, logs and counts requests.

    Args:
        app: Application.
        settings: Limits of the body.
        metrics: Counts the responses.
    """

    def __init__(self, app: ASGIApp, settings: Settings, metrics: RequestMetrics) -> None:
        self._app = app
        self._settings = settings
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        begin_s = time.monotonic()
        status = 0

        async def observed(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                self._report(scope, status, time.monotonic() - begin_s)
            await send(message)

        try:
            await self._app(scope, self._limited(receive, begin_s), observed)
        except Exception:
            if not status:
                self._report(scope, HTTPStatus.INTERNAL_SERVER_ERROR, time.monotonic() - begin_s)
            raise

    def _limited(self, receive: Receive, begin_s: float) -> Receive:
        """Return a receiver that refuses a body that is too large or too slow."""
        size = 0
        complete = False

        async def limited() -> Message:
            nonlocal size, complete
            if complete:
                return await receive()
            left_s = begin_s + self._settings.body_timeout_s - time.monotonic()
            try:
                message = await asyncio.wait_for(receive(), left_s)
            except TimeoutError:
                raise HTTPException(
                    HTTPStatus.REQUEST_TIMEOUT, "the body did not arrive in time; send it again"
                ) from None
            size += len(message.get("body", b""))
            complete = not message.get("more_body", False)
            if size > self._settings.max_body_bytes:
                text = f"the body has more than {self._settings.max_body_bytes} bytes; send a smaller one"
                raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, text)
            return message

        return limited

    def _report(self, scope: Scope, status: int, seconds: float) -> None:
        self._metrics.count(scope["method"], status, seconds)
        level = logging.DEBUG if scope["path"] in _QUIET else logging.INFO
        log.log(
            level,
            "management: response sent (method=%s path=%s status=%d seconds=%.3f)",
            scope["method"],
            # The path is decoded, so it may contain line breaks.
            quote(scope["path"]),
            status,
            seconds,
        )
