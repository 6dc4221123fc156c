"""Lists of items in the autopilot, by the MAVLink mission protocol: its fence, written whole and read back."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from fractus_services.errors import AutopilotError
from fractus_services.mobility.mavlink.dialect import message
from fractus_services.mobility.mavlink.link import Autopilot

FENCE = 1
ANSWER_S = 1.0
ATTEMPTS = 4

_GLOBAL = 0
_ACCEPTED, _UNSUPPORTED = 0, 3
_REASONS = {
    1: "an error", 2: "the frame", 3: "no such lists", 4: "no space", 5: "an invalid value", 13: "the order", 14: "denied",
}  # fmt: skip


class NoLists(AutopilotError):
    """The autopilot keeps no lists of this kind."""


@dataclass(frozen=True, slots=True)
class Item:
    """One item: a vertex, a circle.

    Attributes:
        command: MAV_CMD.
        param1: the first parameter: vertices in the polygon, or a radius in metres.
        lat_e7: degrees north, times 1e7.
        lon_e7: degrees east, times 1e7.
    """

    command: int
    param1: float
    lat_e7: int
    lon_e7: int


async def upload(autopilot: Autopilot, items: Sequence[Item], kind: int = FENCE) -> None:
    """Replace a list.

    Raises:
        NoLists: the autopilot has no such list.
        AutopilotError: it refuses, or falls silent.
    """
    begin = message("MISSION_COUNT", count=len(items), mission_type=kind, **autopilot.address())
    with autopilot.listening("MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ACK") as answers:
        outgoing, silent = begin, 0
        while True:
            autopilot.send(outgoing)
            answer = await _answer(answers, kind)
            if answer is None:
                silent += 1
                if silent == ATTEMPTS:
                    raise AutopilotError("the autopilot stopped answering while its fence was written", link=True)
            elif answer.get_type() == "MISSION_ACK":
                _check(answer.type)
                return
            elif answer.seq < len(items):
                silent = 0
                outgoing = _item(autopilot, items[answer.seq], answer.seq, kind)


async def download(autopilot: Autopilot, kind: int = FENCE) -> tuple[Item, ...]:
    """Read a list.

    Raises:
        NoLists: the autopilot has no such list.
        AutopilotError: it falls silent.
    """
    with autopilot.listening("MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_ACK") as answers:
        ask = message("MISSION_REQUEST_LIST", mission_type=kind, **autopilot.address())
        count = (await _asked(autopilot, ask, answers, "MISSION_COUNT")).count
        found = []
        for seq in range(count):
            ask = message("MISSION_REQUEST_INT", seq=seq, mission_type=kind, **autopilot.address())
            item = await _asked(autopilot, ask, answers, "MISSION_ITEM_INT", seq)
            found.append(Item(item.command, item.param1, item.x, item.y))
    autopilot.send(message("MISSION_ACK", mission_type=kind, **autopilot.address()))
    return tuple(found)


async def _asked(
    autopilot: Autopilot, ask: Any, answers: asyncio.Queue[Any], wanted: str, seq: int | None = None
) -> Any:
    for _ in range(ATTEMPTS):
        autopilot.send(ask)
        while (answer := await _answer(answers, ask.mission_type)) is not None:
            if answer.get_type() == "MISSION_ACK":
                _check(answer.type)
            elif answer.get_type() == wanted and seq in {None, getattr(answer, "seq", None)}:
                return answer
    raise AutopilotError("the autopilot stopped answering while its fence was read", link=True)


async def _answer(answers: asyncio.Queue[Any], kind: int) -> Any:
    try:
        async with asyncio.timeout(ANSWER_S):
            while True:
                answer = await answers.get()
                if answer.mission_type == kind:
                    return answer
    except TimeoutError:
        return None


def _check(result: int) -> None:
    if result == _UNSUPPORTED:
        raise NoLists("the autopilot keeps no fence items")
    if result != _ACCEPTED:
        raise AutopilotError(f"the autopilot refused the fence: {_REASONS.get(result, f'result {result}')}")


def _item(autopilot: Autopilot, item: Item, seq: int, kind: int) -> Any:
    return message(
        "MISSION_ITEM_INT", seq=seq, frame=_GLOBAL, command=item.command, param1=item.param1, x=item.lat_e7, y=item.lon_e7,
        autocontinue=1, mission_type=kind, **autopilot.address(),
    )  # fmt: skip
