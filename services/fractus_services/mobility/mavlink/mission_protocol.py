"""MAVLink mission protocol: upload and download of item lists, which the service uses for the fence."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass

from fractus_runtime.mavlink_codec import Message, message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.errors import AutopilotError
from fractus_services.mobility.mavlink.mavlink_autopilot import MavlinkAutopilot

ITEM_TIMEOUT_S = 1.0
TEXT_TIMEOUT_S = 0.3
ITEM_ATTEMPTS = 4

_REASONS: dict[int, str] = {
    mavlink.MAV_MISSION_ERROR: "error",
    mavlink.MAV_MISSION_UNSUPPORTED_FRAME: "unsupported frame",
    mavlink.MAV_MISSION_UNSUPPORTED: "unsupported list",
    mavlink.MAV_MISSION_NO_SPACE: "no space",
    mavlink.MAV_MISSION_INVALID: "invalid value",
    mavlink.MAV_MISSION_INVALID_SEQUENCE: "invalid sequence",
    mavlink.MAV_MISSION_DENIED: "denied",
}


@dataclass(frozen=True, slots=True)
class MissionItem:
    """One item of a list, for example a vertex or a circle of the fence.

    Attributes:
        command: MAV_CMD.
        param1: First parameter: number of vertices of the polygon, or radius in metres.
        lat_e7: Latitude, degrees times 1e7.
        lon_e7: Longitude, degrees times 1e7.
    """

    command: int
    param1: float
    lat_e7: int
    lon_e7: int


class ItemsUnsupported(AutopilotError):
    """The autopilot does not support item lists of this type."""


class NoSpace(AutopilotError):
    """The list exceeds the capacity of the autopilot."""


async def upload(
    autopilot: MavlinkAutopilot, items: Sequence[MissionItem], kind: int = mavlink.MAV_MISSION_TYPE_FENCE
) -> None:
    """Replace a list. The caller must read it back.

    Raises:
        ItemsUnsupported: The autopilot does not support this list.
        NoSpace: The list exceeds the autopilot's capacity.
        AutopilotError: The autopilot refused the list, or stopped answering.
    """
    begin = message("MISSION_COUNT", count=len(items), mission_type=kind, **autopilot.address())
    answer_names = "MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ACK"
    with autopilot.subscribe(*answer_names) as answers, autopilot.subscribe("STATUSTEXT") as texts:
        outgoing = begin
        silent = 0
        last_sent = 0
        repeated = False
        while True:
            if not repeated:
                autopilot.send(outgoing)
                last_sent += outgoing.values.get("seq") == len(items) - 1
            answer = await _answer(answers, kind)
            # The vehicle requested an item twice because the first copy was late. It now has the item and will request the next one.
            repeated = answer is not None and _is_repeated(answer) and silent + 1 < ITEM_ATTEMPTS
            if answer is None or repeated:
                silent += 1
                if silent == ITEM_ATTEMPTS:
                    raise AutopilotError("the autopilot stopped answering while its fence was written", link=True)
            elif answer.name == "MISSION_ACK":
                if answer.integer("type") == mavlink.MAV_MISSION_ERROR and last_sent > 1:
                    return  # The answer to the last item was lost. Reading the list back shows if it is complete.
                if answer.integer("type") != mavlink.MAV_MISSION_ACCEPTED:
                    await asyncio.sleep(TEXT_TIMEOUT_S)  # STATUSTEXTs with the reason may follow the MISSION_ACK.
                _check(answer.integer("type"), [texts.get_nowait().text("text") for _ in range(texts.qsize())])
                return
            # The vehicle requests its next item. It repeats the request if the request or the item was lost.
            elif (seq := answer.integer("seq")) < len(items):
                silent = 0
                outgoing = _item(autopilot, items[seq], seq, kind)


def _is_repeated(answer: Message) -> bool:
    return answer.name == "MISSION_ACK" and answer.integer("type") == mavlink.MAV_MISSION_INVALID_SEQUENCE


async def download(autopilot: MavlinkAutopilot, kind: int = mavlink.MAV_MISSION_TYPE_FENCE) -> tuple[MissionItem, ...]:
    """Return a list.

    Raises:
        ItemsUnsupported: The autopilot does not support this list.
        AutopilotError: The autopilot stopped answering.
    """
    with autopilot.subscribe("MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_ACK") as answers:
        request = message("MISSION_REQUEST_LIST", mission_type=kind, **autopilot.address())
        count = (await _request(autopilot, request, answers, "MISSION_COUNT")).integer("count")
        items = []
        for seq in range(count):
            request = message("MISSION_REQUEST_INT", seq=seq, mission_type=kind, **autopilot.address())
            item = await _request(autopilot, request, answers, "MISSION_ITEM_INT", seq)
            items.append(
                MissionItem(item.integer("command"), item.real("param1"), item.integer("x"), item.integer("y"))
            )
    autopilot.send(message("MISSION_ACK", mission_type=kind, **autopilot.address()))
    return tuple(items)


async def _request(
    autopilot: MavlinkAutopilot,
    request: Message,
    answers: asyncio.Queue[Message],
    answer_name: str,
    seq: int | None = None,
) -> Message:
    for _ in range(ITEM_ATTEMPTS):
        autopilot.send(request)
        while (answer := await _answer(answers, request.integer("mission_type"))) is not None:
            if answer.name == "MISSION_ACK":
                _check(answer.integer("type"))
            elif answer.name == answer_name and seq in {None, answer.values.get("seq")}:
                return answer
    raise AutopilotError("the autopilot stopped answering while its fence was read", link=True)


async def _answer(answers: asyncio.Queue[Message], kind: int) -> Message | None:
    try:
        async with asyncio.timeout(ITEM_TIMEOUT_S):
            while True:
                answer = await answers.get()
                # Mission, fence and rally points share the messages, and another station may be reading another list.
                if answer.integer("mission_type") == kind:
                    return answer
    except TimeoutError:
        return None


def _check(result: int, texts: Sequence[str] = ()) -> None:
    if result == mavlink.MAV_MISSION_UNSUPPORTED:
        raise ItemsUnsupported("the autopilot does not support fence items")
    if result != mavlink.MAV_MISSION_ACCEPTED:
        reason = ": ".join(filter(None, (_REASONS.get(result, f"result {result}"), "; ".join(texts))))
        error = NoSpace if result == mavlink.MAV_MISSION_NO_SPACE else AutopilotError
        raise error(f"the autopilot refused the fence: {reason}")


def _item(autopilot: MavlinkAutopilot, item: MissionItem, seq: int, kind: int) -> Message:
    return message(
        "MISSION_ITEM_INT", seq=seq, frame=mavlink.MAV_FRAME_GLOBAL, command=item.command, param1=item.param1, x=item.lat_e7, y=item.lon_e7,
        autocontinue=1, mission_type=kind, **autopilot.address(),
    )  # fmt: skip
