"""Flight of the stored mission: its items in order, as calls of the mobility service."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from typing import Protocol

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.gateway.mission_route import Place, lands, requests_of
from fractus_services.gateway.translate import Request
from fractus_services.mavlink_server.mission_items import Item
from fractus_services.mavlink_server.stored_mission import ARRIVALS, Mission, hold_s, title

ITEM_PAUSE_S = 0.1
"""Minimum duration of an item."""


class MissionReports(Protocol):
    """Reports about a mission to the programs of the instance."""

    def send_text(self, severity: int, text: str) -> None:
        """Send a text."""

    def report_current(self) -> None:
        """Report the current item."""

    def report_reached(self, number: int) -> None:
        """Report a completed item."""


async def fly_mission(
    mission: Mission,
    first: int,
    at: Place,
    perform: Callable[[Request], Awaitable[None]],
    reports: MissionReports,
) -> None:
    """Fly a mission, beginning with a given item, until it is complete.

    An upload during the flight replaces the items. The mission then continues with the next number, and is complete if there
    is no item with this number.

    Args:
        mission: Mission, whose progress is updated.
        first: Number of the first item.
        at: Present place of the drone.
        perform: Makes a call, and returns when its motion is complete. Exceptions propagate.
        reports: Receives the progress.
    """

    def report(text: str) -> None:
        reports.send_text(mavlink.MAV_SEVERITY_INFO, text)

    number: int | None = first
    while number is not None and number < len(mission.items):
        item = mission.items[number]
        if item.navigates:
            mission.current = number
            reports.report_current()
        report(f"Mission: {number} {title(item)}")
        requests, at = requests_of(mission, number, at)
        for request in requests:
            await perform(request)
        # The pause keeps a loop of items without a motion from blocking the gateway.
        await _hold(max(_duration_s(item), ITEM_PAUSE_S))
        if item.command in ARRIVALS:
            report(f"Reached command #{number}")
        reports.report_reached(number)
        number = None if lands(item) else mission.next_after(number, report)
    mission.complete = True
    reports.report_current()


def _duration_s(item: Item) -> float:
    """Return how long an item lasts after its motion is complete, in seconds."""
    if item.command == mavlink.MAV_CMD_CONDITION_DELAY:
        return item.param1
    return hold_s(item) if item.navigates else 0.0


async def _hold(time_s: float) -> None:
    if math.isinf(time_s):
        await asyncio.Event().wait()
    await asyncio.sleep(time_s)
