"""Routes of the records of a plan's flight: verdicts, track and pictures, from the agent of its drone."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from http import HTTPStatus
from typing import Annotated, TypeVar

from fastapi import APIRouter, Path, Query, Response
from fastapi.responses import JSONResponse
from fractus_core.api.flight_records import PicturePage, TrackPage, VerdictPage
from fractus_core.api.model import OpenModel
from pydantic import ValidationError
from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from fractus_management.api_server import Caller, CallerOf, Limit, Namespace, ObjectName
from fractus_management.node_records import recording_node
from fractus_management.openapi import problems
from fractus_management.problem_details import refused

router = APIRouter(tags=["records"], responses=problems() | problems(409))

RecordContinue = Annotated[
    str,
    Query(
        alias="continue",
        max_length=64,
        pattern=r"^[0-9-]*$",
        description="Value of `continue` in the previous response.",
    ),
]
PictureId = Annotated[
    str, Path(alias="id", pattern=r"^[0-9]{1,9}-[0-9]{1,12}-[0-9]{1,9}$", description="Id of the picture in the list.")
]
Page = TypeVar("Page", bound=OpenModel)


class PictureResponse(StreamingResponse):
    """Response with a picture.

    Args:
        parts: Parts of the JPEG.
        size: Size in bytes.
        stack: Closed after the response.
    """

    media_type = "image/jpeg"

    def __init__(self, parts: AsyncIterator[bytes], size: int, stack: AsyncExitStack) -> None:
        # The content comes from a drone, so browsers must not guess another type.
        headers = {"Content-Length": str(size), "Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}
        super().__init__(parts, headers=headers)
        self._stack = stack

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the picture."""
        async with self._stack:
            await super().__call__(scope, receive, send)


@router.get("/plans/{name:object}/verdicts", response_model=VerdictPage)
async def list_verdicts(
    caller: CallerOf, name: ObjectName, namespace: Namespace = None, limit: Limit = 100, continue_: RecordContinue = ""
) -> Response:
    """List the verdicts on calls of the flight, changes of control, and alarms, from the audit logs of its drone."""
    return await _page(caller, VerdictPage, ("verdicts", name, namespace), limit, continue_)


@router.get("/plans/{name:object}/track", response_model=TrackPage)
async def list_track(
    caller: CallerOf, name: ObjectName, namespace: Namespace = None, limit: Limit = 100, continue_: RecordContinue = ""
) -> Response:
    """List the positions of the flight, from the audit log of its drone."""
    return await _page(caller, TrackPage, ("track", name, namespace), limit, continue_)


@router.get("/plans/{name:object}/pictures", response_model=PicturePage)
async def list_pictures(
    caller: CallerOf, name: ObjectName, namespace: Namespace = None, limit: Limit = 100, continue_: RecordContinue = ""
) -> Response:
    """List the recorded pictures that components of the flight received, after privacy filters."""
    return await _page(caller, PicturePage, ("pictures", name, namespace), limit, continue_)


@router.get(
    "/plans/{name:object}/pictures/{id}",
    response_class=PictureResponse,
    status_code=HTTPStatus.OK,
    responses={
        200: {
            "description": "The picture.",
            "content": {"image/jpeg": {"schema": {"type": "string", "format": "binary"}}},
        }
    },
)
async def read_picture(caller: CallerOf, name: ObjectName, id_: PictureId, namespace: Namespace = None) -> Response:
    """Read a recorded picture."""
    async with AsyncExitStack() as stack:
        stack.enter_context(caller.limits.stream(caller.token_hash))
        node = await recording_node(caller, namespace or caller.settings.namespace, name)
        size, parts = await node.picture(id_, stack)
        return PictureResponse(parts, size, stack.pop_all())


async def _page(
    caller: Caller, model: type[Page], source: tuple[str, str, str | None], limit: int, continue_: str
) -> Response:
    """Return a page of records. A node may be compromised, so its response is parsed, and only known fields are returned.

    Args:
        caller: Sender of the request.
        model: Model of the page.
        source: Kind of the records, name and namespace of the plan.
        limit: Maximum number of records.
        continue_: Continuation token of the previous page.
    """
    records, name, namespace = source
    node = await recording_node(caller, namespace or caller.settings.namespace, name)
    query = {"limit": str(limit)} | ({"continue": continue_} if continue_ else {})
    with caller.limits.page_of_drone(node.drone):
        content = await node.page(records, query)
        try:
            page = model.model_validate_json(content)
        except ValidationError as error:
            message = f"the records of {node.drone} cannot be read: its agent has another release, or is compromised"
            raise refused(HTTPStatus.SERVICE_UNAVAILABLE, "NodeInvalid", message) from error
    return JSONResponse(page.to_dict())
