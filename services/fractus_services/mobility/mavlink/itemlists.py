"""Lists of items in the autopilot, by the MAVLink mission protocol: its fence, written whole and read back."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

from fractus_runtime.mavlink_codec import Message, message
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.errors import AutopilotError
from fractus_services.mobility.mavlink.autopilot import MavlinkAutopilot
from fractus_services.mobility.mavlink.bounds import Item

ANSWER_TIMEOUT_S = 1.0
TEXT_TIMEOUT_S = 0.3
ATTEMPTS = 4

_REASONS: dict[int, str] = {
    mavlink.MAV_MISSION_ERROR: "an error",
    mavlink.MAV_MISSION_UNSUPPORTED_FRAME: "the frame",
    mavlink.MAV_MISSION_UNSUPPORTED: "no such lists",
    mavlink.MAV_MISSION_NO_SPACE: "no space",
    mavlink.MAV_MISSION_INVALID: "an invalid value",
    mavlink.MAV_MISSION_INVALID_SEQUENCE: "the order",
    mavlink.MAV_MISSION_DENIED: "denied",
}


class NoLists(AutopilotError):
    """The autopilot keeps no lists of this kind."""


class NoSpace(AutopilotError):
    """The list is longer than what the autopilot can hold."""


async def upload(
    autopilot: MavlinkAutopilot, items: Sequence[Item], kind: int = mavlink.MAV_MISSION_TYPE_FENCE
) -> None:
    """Replace a list; it is to be read back.

    Raises:
        NoLists: the autopilot has no such list.
        NoSpace: it is too long for it.
        AutopilotError: it refuses, or falls silent.
    """
    begin = message("MISSION_COUNT", count=len(items), mission_type=kind, **autopilot.address())
    kinds = "MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ACK"
    with autopilot.listening(*kinds) as answers, autopilot.listening("STATUSTEXT") as texts:
        outgoing, silent, ended, repeated = begin, 0, 0, False
        while True:
            if not repeated:
                autopilot.send(outgoing)
                ended += outgoing.values.get("seq") == len(items) - 1
            answer = await _answer(answers, kind)
            # It has an item already that it asked for twice, for the first one was late: it goes on with the next.
            repeated = answer is not None and _is_repeated(answer) and silent + 1 < ATTEMPTS
            if answer is None or repeated:
                silent += 1
                if silent == ATTEMPTS:
                    raise AutopilotError("the autopilot stopped answering while its fence was written", link=True)
            elif answer.name == "MISSION_ACK":
                if answer.integer("type") == mavlink.MAV_MISSION_ERROR and ended > 1:
                    return  # it awaits no item any more: its answer to the last one was lost, and reading back tells which
                if answer.integer("type") != mavlink.MAV_MISSION_ACCEPTED:
                    await asyncio.sleep(TEXT_TIMEOUT_S)  # the texts that say why may follow the answer
                _check(answer.integer("type"), [texts.get_nowait().text("text") for _ in range(texts.qsize())])
                return
            # The vehicle says which item it lacks: one that was lost is asked for again, and so is one whose request was.
            elif (seq := answer.integer("seq")) < len(items):
                silent = 0
                outgoing = _item(autopilot, items[seq], seq, kind)


def _is_repeated(answer: Message) -> bool:
    return answer.name == "MISSION_ACK" and answer.integer("type") == mavlink.MAV_MISSION_INVALID_SEQUENCE


async def download(autopilot: MavlinkAutopilot, kind: int = mavlink.MAV_MISSION_TYPE_FENCE) -> tuple[Item, ...]:
    """Read a list.

    Raises:
        NoLists: the autopilot has no such list.
        AutopilotError: it falls silent.
    """
    with autopilot.listening("MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_ACK") as answers:
        ask = message("MISSION_REQUEST_LIST", mission_type=kind, **autopilot.address())
        count = (await _asked(autopilot, ask, answers, "MISSION_COUNT")).integer("count")
        found = []
        for seq in range(count):
            ask = message("MISSION_REQUEST_INT", seq=seq, mission_type=kind, **autopilot.address())
            item = await _asked(autopilot, ask, answers, "MISSION_ITEM_INT", seq)
            found.append(Item(item.integer("command"), item.real("param1"), item.integer("x"), item.integer("y")))
    autopilot.send(message("MISSION_ACK", mission_type=kind, **autopilot.address()))
    return tuple(found)


async def _asked(
    autopilot: MavlinkAutopilot, ask: Message, answers: asyncio.Queue[Message], wanted: str, seq: int | None = None
) -> Message:
    for _ in range(ATTEMPTS):
        autopilot.send(ask)
        while (answer := await _answer(answers, ask.integer("mission_type"))) is not None:
            if answer.name == "MISSION_ACK":
                _check(answer.integer("type"))
            elif answer.name == wanted and seq in {None, answer.values.get("seq")}:
                return answer
    raise AutopilotError("the autopilot stopped answering while its fence was read", link=True)


async def _answer(answers: asyncio.Queue[Message], kind: int) -> Message | None:
    try:
        async with asyncio.timeout(ANSWER_TIMEOUT_S):
            while True:
                answer = await answers.get()
                # Mission, fence and rally points share the messages; another station may be reading another list.
                if answer.integer("mission_type") == kind:
                    return answer
    except TimeoutError:
        return None


def _check(result: int, texts: Sequence[str] = ()) -> None:
    if result == mavlink.MAV_MISSION_UNSUPPORTED:
        raise NoLists("the autopilot keeps no fence items")
    if result != mavlink.MAV_MISSION_ACCEPTED:
        why = ": ".join(filter(None, (_REASONS.get(result, f"result {result}"), "; ".join(texts))))
        kind = NoSpace if result == mavlink.MAV_MISSION_NO_SPACE else AutopilotError
        raise kind(f"the autopilot refused the fence: {why}")


def _item(autopilot: MavlinkAutopilot, item: Item, seq: int, kind: int) -> Message:
    return message(
        "MISSION_ITEM_INT", seq=seq, frame=mavlink.MAV_FRAME_GLOBAL, command=item.command, param1=item.param1, x=item.lat_e7, y=item.lon_e7,
        autocontinue=1, mission_type=kind, **autopilot.address(),
    )  # fmt: skip
