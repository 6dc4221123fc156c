"""Order and progress of a mission that the gateway flies."""

from __future__ import annotations

import asyncio

from fractus_services.gateway.mission_flight import fly_mission
from fractus_services.gateway.mission_route import Place
from fractus_services.gateway.translate import Request
from fractus_services.mavlink_server.mission_items import Item
from fractus_services.mavlink_server.stored_mission import Mission
from pymavlink.dialects.v20 import ardupilotmega as mavlink

HOME = Item(mavlink.MAV_CMD_NAV_WAYPOINT, frame=mavlink.MAV_FRAME_GLOBAL)
WAYPOINT = Item(mavlink.MAV_CMD_NAV_WAYPOINT, x=393_700_000, y=229_500_000, z=10.0)


class Reports:
    """Progress that a mission reports."""

    def __init__(self) -> None:
        self.reached: list[int] = []
        self.texts: list[str] = []

    def send_text(self, _severity: int, text: str) -> None:
        self.texts.append(text)

    def report_current(self) -> None:
        pass

    def report_reached(self, number: int) -> None:
        self.reached.append(number)


async def _fly(*items: Item, time_s: float = 5.0) -> tuple[Mission, Reports, list[str]]:
    """Fly a mission whose calls end at once, for a limited time."""
    mission = Mission()
    mission.store.items = [HOME, *items]
    reports = Reports()
    methods: list[str] = []

    async def perform(request: Request) -> None:
        methods.append(request.method)

    flight = asyncio.create_task(fly_mission(mission, 1, Place(39.36, 22.95, 5.0), perform, reports))
    await asyncio.wait({flight}, timeout=time_s)
    flight.cancel()
    await asyncio.gather(flight, return_exceptions=True)
    return mission, reports, methods


async def test_items_are_flown_in_order_until_a_landing() -> None:
    land = Item(mavlink.MAV_CMD_NAV_LAND)
    mission, reports, methods = await _fly(WAYPOINT, Item(mavlink.MAV_CMD_DO_CHANGE_SPEED, param2=4.0), land, WAYPOINT)
    assert methods == ["Goto", "SetSpeed", "Land"]
    assert reports.reached == [1, 2, 3]
    assert mission.complete
    assert mission.current == 3


async def test_condition_delay_waits_before_the_next_item() -> None:
    delay = Item(mavlink.MAV_CMD_CONDITION_DELAY, param1=0.6)
    _, _, methods = await _fly(WAYPOINT, delay, WAYPOINT, time_s=0.5)
    assert methods == ["Goto"]
    _, reports, methods = await _fly(WAYPOINT, delay, WAYPOINT)
    assert methods == ["Goto", "Goto"]
    assert reports.reached == [1, 2, 3]


async def test_jump_is_repeated_as_often_as_it_says() -> None:
    jump = Item(mavlink.MAV_CMD_DO_JUMP, param1=1, param2=2)
    mission, reports, methods = await _fly(WAYPOINT, jump, WAYPOINT)
    assert reports.reached == [1, 1, 1, 3]
    assert "Mission: 2 Jump 1/2" in reports.texts
    assert methods == ["Goto"] * 4
    assert mission.complete


async def test_endless_loop_without_a_motion_does_not_block_other_tasks() -> None:
    speed = Item(mavlink.MAV_CMD_DO_CHANGE_SPEED, param2=-1.0)
    mission, reports, _ = await _fly(speed, Item(mavlink.MAV_CMD_DO_JUMP, param1=1, param2=-1), time_s=0.5)
    assert not mission.complete
    assert 1 <= len(reports.reached) <= 6


async def test_mission_is_complete_if_its_list_has_become_shorter_before_its_first_item() -> None:
    mission = Mission()
    mission.store.items = [HOME, WAYPOINT]
    reports = Reports()

    async def perform(request: Request) -> None:
        raise AssertionError(request)

    await fly_mission(mission, 2, Place(39.36, 22.95, 5.0), perform, reports)
    assert mission.complete


async def test_mission_continues_in_a_shorter_list_by_its_number() -> None:
    mission = Mission()
    mission.store.items = [HOME, WAYPOINT, WAYPOINT, WAYPOINT]
    reports = Reports()

    async def perform(_request: Request) -> None:
        mission.store.items = [HOME, WAYPOINT]

    await fly_mission(mission, 2, Place(39.36, 22.95, 5.0), perform, reports)
    assert reports.reached == [2]
    assert mission.complete
