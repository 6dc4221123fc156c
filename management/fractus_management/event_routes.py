"""Event stream of a flight plan: server-sent events that resume at a resource version."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import ExitStack, aclosing
from dataclasses import dataclass
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Header, Request, Response
from fractus_runtime.kubernetes import Body, Expired, KubeError, NotFound
from starlette.responses import StreamingResponse
from starlette.types import Message, Receive, Scope, Send

from fractus_management.api_server import Caller, CallerOf, Namespace, ObjectName, public
from fractus_management.openapi import problems
from fractus_management.plan_routes import PLAN
from fractus_management.problem_details import from_kubernetes

log = logging.getLogger(__name__)

WRITE_TIMEOUT_S = 30.0
"""Time after which a client that reads nothing is disconnected."""

WATCH_S = 300
"""Duration of one watch. Then the API server checks the token again."""

SILENCE_S = 100.0
"""Time without a message after which a watch counts as dead. The API server sends a bookmark about every minute."""

RETRY_S = 1.0

router = APIRouter(tags=["plans"], responses=problems())

LastEventId = Annotated[
    str,
    Header(
        alias="Last-Event-ID",
        max_length=64,
        description="Id of the last event that you received. Unset: the stream begins with the present plan.",
    ),
]


class EventStream(StreamingResponse):
    """Response with server-sent events.

    Args:
        messages: Encoded messages.
        slot: Closed at the end of the stream.
    """

    media_type = "text/event-stream"

    def __init__(self, messages: AsyncIterator[bytes], slot: ExitStack) -> None:
        super().__init__(messages, headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"})
        self._slot = slot

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the messages until they end or the client disconnects."""

        async def limited(message: Message) -> None:
            async with asyncio.timeout(WRITE_TIMEOUT_S):
                await send(message)

        with self._slot:
            await super().__call__(scope, receive, limited)


@router.get(
    "/plans/{name:object}/events",
    response_class=EventStream,
    status_code=HTTPStatus.OK,
    responses={
        200: {
            "description": "Events `plan` (data: the plan), `reset` (earlier events are lost, and the present plan follows),"
            " `deleted` (data: the plan; the stream ends) and `error` (data: a problem; the stream ends).",
            "content": {"text/event-stream": {"schema": {"type": "string"}}},
        }
    },
)
async def stream_plan(
    request: Request, caller: CallerOf, name: ObjectName, namespace: Namespace = None, last_event_id: LastEventId = ""
) -> Response:
    """Follow a plan by server-sent events. The id of an event is the resource version of the plan."""
    watched = _Watched(caller, name, namespace or caller.settings.namespace)
    snapshot = await watched.snapshot()
    slot = ExitStack()
    slot.enter_context(caller.limits.stream(caller.token_hash))
    messages = _messages(watched, snapshot, last_event_id)
    return EventStream(_with_keepalive(messages, caller.settings.keepalive_s, request.app.state.stopping), slot)


@dataclass(frozen=True, slots=True)
class _Watched:
    """A plan that is followed with the token of a caller."""

    caller: Caller
    name: str
    namespace: str

    @property
    def _selectors(self) -> dict[str, str]:
        return {"fieldSelector": f"metadata.name={self.name}"}

    async def snapshot(self) -> tuple[Body, str]:
        """Return the plan, and the resource version from which changes follow.

        Raises:
            KubeError: The plan does not exist, or the API server refused the request.
        """
        page = await self.caller.client.list_page(PLAN, namespace=self.namespace, selectors=self._selectors)
        if not page.items:
            raise NotFound(404, "NotFound", f"there is no plan {self.name} in namespace {self.namespace}")
        return page.items[0], page.resource_version

    def changes(self, position: str) -> AsyncGenerator[tuple[str, Body], None]:
        """Yield the changes after a resource version."""
        return self.caller.client.watch(
            PLAN,
            resource_version=position,
            namespace=self.namespace,
            selectors=self._selectors,
            timeout_s=WATCH_S,
            silence_s=SILENCE_S,
        )


async def _messages(watched: _Watched, snapshot: tuple[Body, str], last_id: str) -> AsyncGenerator[bytes, None]:
    """Yield the messages of a plan's stream until the plan is deleted or the caller may not read it any more."""
    plan, position = snapshot
    # The API server would wait for a version that it has not reached, such as one from before a restore.
    if last_id.isdecimal() and int(last_id) <= int(position):
        position = last_id
    else:
        if last_id:
            yield encoded("reset", {})
        yield message("plan", plan)
    while True:
        try:
            async with aclosing(watched.changes(position)) as changes:
                async for type_, body in changes:
                    position = body["metadata"]["resourceVersion"]
                    if type_ != "BOOKMARK":
                        yield message("deleted" if type_ == "DELETED" else "plan", body)
                    if type_ == "DELETED":
                        return
        except Expired:
            try:
                plan, position = await watched.snapshot()
            except KubeError as error:
                yield encoded("error", from_kubernetes(error).problem.to_dict())
                return
            yield encoded("reset", {})
            yield message("plan", plan)
        except KubeError as error:
            if error.status in {HTTPStatus.UNAUTHORIZED, HTTPStatus.FORBIDDEN}:
                yield encoded("error", from_kubernetes(error).problem.to_dict())
                return
            log.info(
                "management: watch failed, trying again (plan=%s/%s error=%s)", watched.namespace, watched.name, error
            )
            await asyncio.sleep(RETRY_S)


def message(event: str, plan: Body) -> bytes:
    """Return the event with a plan."""
    return encoded(event, public(plan, PLAN), plan["metadata"]["resourceVersion"])


def encoded(event: str, data: Any, id_: str = "") -> bytes:
    """Return a server-sent event."""
    head = f"id: {id_}\n" if id_ else ""
    return f"{head}event: {event}\ndata: {json.dumps(data)}\n\n".encode()


async def _with_keepalive(
    messages: AsyncGenerator[bytes, None], keepalive_s: float, stopping: asyncio.Event
) -> AsyncIterator[bytes]:
    """Yield messages until the server stops. Without messages, yield comments, by which broken connections are detected."""
    stopped = asyncio.ensure_future(stopping.wait())
    pending = asyncio.ensure_future(anext(messages, None))
    try:
        while True:
            await asyncio.wait({pending, stopped}, timeout=keepalive_s, return_when=asyncio.FIRST_COMPLETED)
            if stopped.done():
                return
            if not pending.done():
                yield b":\n\n"
                continue
            next_message = pending.result()
            if next_message is None:
                return
            pending = asyncio.ensure_future(anext(messages, None))
            yield next_message
    finally:
        stopped.cancel()
        pending.cancel()
        await asyncio.gather(stopped, pending, return_exceptions=True)
        await messages.aclose()
