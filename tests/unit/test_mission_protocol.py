"""Upload and download of lists by the mission protocol over a link that loses messages."""

from __future__ import annotations

import asyncio

import pytest
from fractus_runtime.mavlink_codec import Message, message
from fractus_services.errors import AutopilotError
from fractus_services.mobility.mavlink import mission_protocol
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER
from fractus_services.mobility.mavlink.companion import COMPONENT_ID, SYSTEM_ID
from fractus_services.mobility.mavlink.fence import MissionItem
from fractus_services.mobility.mavlink.mavlink_autopilot import MavlinkAutopilot
from fractus_services.mobility.mavlink.mission_protocol import ItemsUnsupported, NoSpace, download, upload
from pymavlink.dialects.v20 import ardupilotmega as mavlink

ITEMS = tuple(MissionItem(5001, 3.0, 393600000 + i, 229500000 - i) for i in range(3))


class ListVehicle(MavlinkAutopilot):
    """Fake autopilot that stores one list.

    `lost` contains the numbers of messages that get lost in either direction.
    """

    def __init__(self, *lost: int, result: int = 0) -> None:
        super().__init__("tcp:nowhere:1", ARDUCOPTER)
        self.target = (1, 1)
        self.vehicle.heartbeat_at = asyncio.get_running_loop().time()
        self.items: list[Message] = []
        self.expected_count = 0
        self.result = result
        self._lost = set(lost)
        self._count = 0

    def _passes(self) -> bool:
        self._count += 1
        return self._count not in self._lost

    def send(self, outgoing: Message) -> None:
        if self._passes():
            answer = self._answer(outgoing)
            if answer is not None and self._passes():
                self.take(
                    message("MISSION_ACK", mission_type=mavlink.MAV_MISSION_TYPE_MISSION)
                )  # an acknowledgement for another list must be ignored
                self.take(answer)

    def _answer(self, outgoing: Message) -> Message | None:
        kind = outgoing.name
        if self.result:
            return message("MISSION_ACK", type=self.result, mission_type=mavlink.MAV_MISSION_TYPE_FENCE)
        if kind == "MISSION_COUNT":
            self.items = []
            self.expected_count = outgoing.integer("count")
        elif kind == "MISSION_ITEM_INT" and outgoing.integer("seq") == len(self.items):
            self.items.append(outgoing)
        elif kind == "MISSION_REQUEST_LIST":
            return message("MISSION_COUNT", count=len(self.items), mission_type=mavlink.MAV_MISSION_TYPE_FENCE)
        elif kind == "MISSION_REQUEST_INT":
            addresses = {"target_system": SYSTEM_ID, "target_component": COMPONENT_ID}
            return message("MISSION_ITEM_INT", **self.items[outgoing.integer("seq")].values | addresses)
        elif kind == "MISSION_ACK":
            return None
        if len(self.items) < self.expected_count:
            return message("MISSION_REQUEST", seq=len(self.items), mission_type=mavlink.MAV_MISSION_TYPE_FENCE)
        return message("MISSION_ACK", mission_type=mavlink.MAV_MISSION_TYPE_FENCE)


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mission_protocol, "ITEM_TIMEOUT_S", 0.01)


@pytest.mark.parametrize("lost", [(), (1,), (2,), (3, 4), (6,), (8, 9, 10), (11,)])
async def test_uploaded_items_are_downloaded_despite_lost_messages(lost: tuple[int, ...]) -> None:
    vehicle = ListVehicle(*lost)
    await upload(vehicle, ITEMS)
    assert await download(vehicle) == ITEMS
    await upload(vehicle, ())
    assert await download(vehicle) == ()


@pytest.mark.parametrize(("result", "why"), [(4, "no space"), (14, "denied"), (77, "result 77")])
async def test_upload_raises_the_reason_of_a_refusal(result: int, why: str) -> None:
    with pytest.raises(AutopilotError, match=why):
        await upload(ListVehicle(result=result), ITEMS)


async def test_unsupported_list_raises_items_unsupported() -> None:
    with pytest.raises(ItemsUnsupported):
        await upload(ListVehicle(result=3), ITEMS)
    with pytest.raises(ItemsUnsupported):
        await download(ListVehicle(result=3))


async def test_upload_and_download_raise_when_the_vehicle_is_silent() -> None:
    silent = range(1, 100)
    with pytest.raises(AutopilotError, match="stopped answering") as written:
        await upload(ListVehicle(*silent), ITEMS)
    with pytest.raises(AutopilotError, match="stopped answering") as read:
        await download(ListVehicle(*silent))
    assert written.value.link
    assert read.value.link


async def test_nothing_is_sent_without_a_connected_vehicle() -> None:
    vehicle = ListVehicle()
    vehicle.target = None
    with pytest.raises(AutopilotError, match="not connected"):
        await download(vehicle)


@pytest.mark.parametrize(
    ("result", "kind"), [(mavlink.MAV_MISSION_ERROR, AutopilotError), (mavlink.MAV_MISSION_NO_SPACE, NoSpace)]
)
async def test_refusal_contains_the_status_text_of_the_autopilot(result: int, kind: type[AutopilotError]) -> None:
    vehicle = ListVehicle(result=result)
    text = message("STATUSTEXT", severity=4, text=b"Invalid vertex count (2)")
    asyncio.get_running_loop().call_later(0.1, vehicle.take, text)
    with pytest.raises(kind, match=r"refused the fence: .*: Invalid vertex count \(2\)"):
        await upload(vehicle, ITEMS)


async def test_lost_acknowledgement_of_the_last_item_is_not_a_refusal() -> None:
    class Finished(ListVehicle):
        """Fake autopilot that responds with ERROR to an item after the upload has ended, as ArduPilot does."""

        def _answer(self, outgoing: Message) -> Message | None:
            if outgoing.name == "MISSION_ITEM_INT" and len(self.items) == self.expected_count:
                return message(
                    "MISSION_ACK", type=mavlink.MAV_MISSION_ERROR, mission_type=mavlink.MAV_MISSION_TYPE_FENCE
                )
            return super()._answer(outgoing)

    vehicle = Finished(8)
    await upload(vehicle, ITEMS)
    assert await download(vehicle) == ITEMS


async def test_duplicate_item_does_not_end_the_upload() -> None:
    class Impatient(ListVehicle):
        """Fake autopilot that requests the second item twice, and reports the second copy as out of order."""

        def _answer(self, outgoing: Message) -> Message | None:
            if outgoing.name == "MISSION_ITEM_INT" and outgoing.integer("seq") < len(self.items):
                return message(
                    "MISSION_ACK",
                    type=mavlink.MAV_MISSION_INVALID_SEQUENCE,
                    mission_type=mavlink.MAV_MISSION_TYPE_FENCE,
                )
            answer = super()._answer(outgoing)
            if answer is not None and answer.name == "MISSION_REQUEST" and answer.integer("seq") == 1:
                self.take(answer)
            return answer

    vehicle = Impatient()
    await upload(vehicle, ITEMS)
    assert await download(vehicle) == ITEMS


async def test_persistent_invalid_sequence_ends_the_upload() -> None:
    with pytest.raises(AutopilotError, match="stopped answering"):
        await upload(ListVehicle(result=mavlink.MAV_MISSION_INVALID_SEQUENCE), ITEMS)
