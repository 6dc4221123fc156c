"""Control and calls of one instance of the gateway, with a mobility service that a test controls."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from fractus_proto.v1 import gateway_pb2, mobility_pb2
from fractus_runtime.mavlink_codec import Endpoint, Parser
from fractus_services.gateway import instance as instance_module
from fractus_services.gateway import session as session_module
from fractus_services.gateway.instance import Instance
from fractus_services.gateway.mobility_client import CallRefused, MobilityClient
from fractus_services.gateway.session import Call, Session
from fractus_services.gateway.translate import set_speed
from fractus_services.mavlink_server.mission_items import Item
from google.rpc import code_pb2
from pymavlink.dialects.v20 import ardupilotmega as mavlink

ControlEvent = mobility_pb2.ControlEvent
ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
TEMPORARILY_REJECTED = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
WAYPOINT = Item(mavlink.MAV_CMD_NAV_WAYPOINT, x=10_000_000, y=10_000_000, z=10.0)


class Service:
    """A mobility service that grants control and accepts all calls, except calls that the test delays."""

    def __init__(self) -> None:
        self.closed = asyncio.Event()
        self.calls: list[str] = []
        self.streams = 0
        self.grants = True
        self.events: asyncio.Queue[Any] = asyncio.Queue()
        self.verdict = asyncio.Event()
        self.verdict.set()
        """Cleared while targets, speeds and missions wait for their verdict."""
        self.deferred: set[str] = set()
        """Methods whose calls have to be repeated later."""

    @property
    def controlled(self) -> bool:
        return self.streams > 0

    async def stream(
        self, method: str, _request: Any, reply: Any, _timeout_s: float = 0.0
    ) -> AsyncGenerator[Any, None]:
        self.calls.append(method)
        if method == "GetControl":
            self.streams += 1
            try:
                if self.grants:
                    yield ControlEvent(state=ControlEvent.STATE_GRANTED)
                while (event := await self.events.get()) is not None:
                    yield event
                return
            finally:
                self.streams -= 1
        if method == "SubscribeVehicle":
            await asyncio.Event().wait()
        if method in self.deferred:
            raise CallRefused(code_pb2.UNAVAILABLE, "wait until contact returns")
        if method in {"Goto", "SetSpeed"}:
            await self.verdict.wait()
        yield reply()

    async def call(self, method: str, *_arguments: Any) -> Any:
        self.calls.append(method)
        if method == "CheckRoute":
            await self.verdict.wait()
            return gateway_pb2.RouteVerdict()
        if method == "ConfirmAlive":
            raise CallRefused(code_pb2.UNAVAILABLE, "too many calls")
        return mobility_pb2.ReturnControlResponse()

    async def close(self) -> None:
        self.closed.set()


class Program:
    """A session with the frames of a program."""

    def __init__(self, instance: Instance) -> None:
        self._instance = instance
        self._loop = asyncio.get_running_loop()
        self._endpoint = Endpoint(255, 190)
        self.session = Session(instance.vehicle, instance.parameters, instance.missions)
        self.acks: list[tuple[int, int]] = []
        self.mission_acks: list[int] = []
        instance.sessions.add(self.session)

    def send(self, name: str, **values: Any) -> None:
        data = self._endpoint.encode(name, {"target_system": 1, "target_component": 1, **values})
        for call in self.session.receive(data, self._loop.time()):
            self._instance.start(self.session, call)

    def beat(self) -> None:
        for call in self.session.receive(self._endpoint.encode("HEARTBEAT", {}), self._loop.time()):
            raise AssertionError(call)

    def command(self, number: int, *params: float) -> None:
        self.send("COMMAND_LONG", command=number, **{f"param{at}": value for at, value in enumerate(params, 1)})

    def target(self, lat: int = 10_000_000) -> None:
        self.send(
            "SET_POSITION_TARGET_GLOBAL_INT", coordinate_frame=6, type_mask=0b110111111000,
            lat_int=lat, lon_int=10_000_000, alt=10.0,
        )  # fmt: skip

    def write_item(self, number: int, altitude_m: float) -> None:
        """Replace one waypoint of the stored mission."""
        self.send("MISSION_WRITE_PARTIAL_LIST", start_index=number, end_index=number)
        place = {"x": 10_000_000, "y": 10_000_000, "z": altitude_m}
        self.send("MISSION_ITEM_INT", seq=number, frame=3, command=mavlink.MAV_CMD_NAV_WAYPOINT, **place)

    def results(self) -> list[tuple[int, int]]:
        for message in Parser().feed(self.session.take()):
            if message.name == "COMMAND_ACK":
                self.acks.append((message.integer("command"), message.integer("result")))
            if message.name == "MISSION_ACK":
                self.mission_acks.append(message.integer("type"))
        return self.acks

    def close(self) -> None:
        self._instance.sessions.discard(self.session)


@contextlib.asynccontextmanager
async def running(monkeypatch: pytest.MonkeyPatch, service: Service) -> AsyncIterator[Instance]:
    async def connect(*_arguments: Any) -> Service:
        service.closed.clear()
        return service

    monkeypatch.setattr(MobilityClient, "open", connect)
    monkeypatch.setattr(instance_module, "SUPERVISE_S", 0.005)
    monkeypatch.setattr(instance_module, "RETRY_S", 0.005)
    instance = Instance("spiffe://fractus.dev/x", Path("unused"))
    instance.parameters.replace({"WPNAV_SPEED": 1000.0})
    task = asyncio.create_task(instance.run())
    try:
        yield instance
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def report_flight(instance: Instance, lat: int = 10_000_000) -> None:
    """Report an armed drone."""
    drone = Endpoint(1, 1)
    heartbeat = drone.encode("HEARTBEAT", {"base_mode": mavlink.MAV_MODE_FLAG_SAFETY_ARMED})
    position = drone.encode("GLOBAL_POSITION_INT", {"lat": lat, "lon": 10_000_000})
    for message in Parser().feed(heartbeat + position):
        instance.vehicle.take(message, asyncio.get_running_loop().time())


async def breach_fence(instance: Instance, program: Program) -> None:
    """Let the drone leave a fence of about 1 km."""
    corners = [(9_950_000, 9_950_000), (10_050_000, 9_950_000), (10_050_000, 10_050_000), (9_950_000, 10_050_000)]
    program.send("MISSION_COUNT", count=len(corners), mission_type=1)
    for number, (x, y) in enumerate(corners):
        item = {"seq": number, "frame": 0, "command": 5001, "param1": 4.0, "x": x, "y": y, "mission_type": 1}
        program.send("MISSION_ITEM_INT", **item)
    program.command(mavlink.MAV_CMD_DO_FENCE_ENABLE, 1)
    report_flight(instance)
    await until(lambda: (mavlink.MAV_CMD_DO_FENCE_ENABLE, ACCEPTED) in program.results())
    await asyncio.sleep(0.05)
    report_flight(instance, 10_100_000)
    await until(lambda: instance.vehicle.flying_mode == mavlink.COPTER_MODE_RTL)


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(5.0):
        while not condition():  # noqa: ASYNC110 - the instance has no notification
            await asyncio.sleep(0.005)


Scenario = Callable[[Instance, Service], Awaitable[None]]


def run(monkeypatch: pytest.MonkeyPatch, scenario: Scenario) -> None:
    async def work() -> None:
        service = Service()
        async with running(monkeypatch, service) as instance:
            await scenario(instance, service)

    asyncio.run(work())


def test_control_ends_when_the_steering_program_closes_while_a_ground_station_listens(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        program = Program(instance)
        station = Program(instance)
        program.beat()
        station.beat()
        await until(lambda: instance.vehicle.granted)
        program.target()
        program.close()
        await until(lambda: not service.controlled)
        for _ in range(10):
            station.beat()
            await asyncio.sleep(0.01)
        assert not service.controlled
        restarted = Program(instance)
        restarted.beat()
        await until(lambda: service.controlled)

    run(monkeypatch, scenario)


def test_control_ends_when_the_steering_program_is_silent_and_returns_with_its_heartbeats(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(session_module, "HEARTBEAT_SILENCE_S", 0.2)

    async def scenario(instance: Instance, service: Service) -> None:
        program = Program(instance)
        station = Program(instance)
        program.beat()
        await until(lambda: instance.vehicle.granted)
        program.target()

        def station_sees(controlled: bool) -> bool:
            station.beat()
            return service.controlled is controlled

        await until(lambda: station_sees(controlled=False))
        program.beat()
        await until(lambda: station_sees(controlled=True))

    run(monkeypatch, scenario)


def test_control_continues_when_a_listening_ground_station_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        program = Program(instance)
        station = Program(instance)
        program.beat()
        station.beat()
        await until(lambda: instance.vehicle.granted)
        program.target()
        station.close()
        await asyncio.sleep(0.1)
        assert service.calls.count("GetControl") == 1
        assert service.controlled

    run(monkeypatch, scenario)


@pytest.mark.parametrize("number", [20, 21, 17])
def test_target_of_an_earlier_goto_is_forgotten_when_another_motion_is_accepted(
    number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        program = Program(instance)
        program.beat()
        await until(lambda: instance.vehicle.granted)
        program.target()
        await until(lambda: instance.vehicle.target is not None)
        program.command(number)
        await until(lambda: (number, ACCEPTED) in program.results())
        assert instance.vehicle.target is None

    run(monkeypatch, scenario)


def test_target_of_an_earlier_goto_is_forgotten_when_a_velocity_is_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        program = Program(instance)
        program.beat()
        await until(lambda: instance.vehicle.granted)
        program.target()
        await until(lambda: instance.vehicle.target is not None)
        program.send("SET_POSITION_TARGET_LOCAL_NED", coordinate_frame=1, type_mask=0b110111000111, vx=1.0)
        await until(lambda: "SetVelocity" in service.calls)
        await asyncio.sleep(0.05)
        assert instance.vehicle.target is None

    run(monkeypatch, scenario)


@pytest.mark.parametrize("mode", [mavlink.COPTER_MODE_BRAKE, mavlink.COPTER_MODE_LAND, mavlink.COPTER_MODE_RTL])
def test_waiting_target_is_dropped_when_the_program_stops_or_lands_later(
    mode: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        program = Program(instance)
        program.beat()
        await until(lambda: instance.vehicle.granted)
        service.verdict.clear()
        program.target()
        await until(lambda: "Goto" in service.calls)
        program.target(11_000_000)
        program.command(mavlink.MAV_CMD_DO_SET_MODE, 1, mode)
        await until(lambda: (mavlink.MAV_CMD_DO_SET_MODE, ACCEPTED) in program.results())
        service.verdict.set()
        await asyncio.sleep(0.05)
        assert service.calls.count("Goto") == 1

    run(monkeypatch, scenario)


def test_calls_that_wait_for_control_are_rejected_when_the_mobility_service_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        service.grants = False
        program = Program(instance)
        await until(lambda: "SubscribeVehicle" in service.calls)
        await asyncio.sleep(0.05)
        program.command(400, 1)
        program.send("PARAM_SET", param_id=b"WPNAV_SPEED", param_value=500.0, param_type=9)
        program.send("PARAM_SET", param_id=b"WPNAV_SPEED", param_value=600.0, param_type=9)
        service.closed.set()
        await until(lambda: (400, TEMPORARILY_REJECTED) in program.results())
        assert instance.parameters.values["WPNAV_SPEED"] == 1000.0

    run(monkeypatch, scenario)


def test_new_program_gets_control_after_a_mission_of_the_instance_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        idle = Program(instance)
        idle.beat()
        await until(lambda: instance.vehicle.granted)
        instance.vehicle.flown = True
        service.events.put_nowait(ControlEvent(state=ControlEvent.STATE_COMPLETE))
        await until(lambda: not instance.vehicle.granted)
        assert not instance.vehicle.flown
        service.events.put_nowait(None)
        await until(lambda: not service.controlled)
        await asyncio.sleep(0.05)
        assert not service.controlled
        program = Program(instance)
        program.beat()
        await until(lambda: instance.vehicle.granted)

    run(monkeypatch, scenario)


def test_control_continues_when_one_confirmation_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        program = Program(instance)
        program.beat()
        await until(lambda: instance.vehicle.granted)
        service.events.put_nowait(ControlEvent(state=ControlEvent.STATE_PING))
        await until(lambda: "ConfirmAlive" in service.calls)
        await asyncio.sleep(0.05)
        assert service.calls.count("GetControl") == 1
        assert instance.vehicle.granted

    run(monkeypatch, scenario)


@pytest.mark.parametrize("mode", [mavlink.COPTER_MODE_BRAKE, mavlink.COPTER_MODE_RTL])
def test_mission_is_not_flown_if_a_later_command_arrives_before_its_verdict(
    mode: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        program = Program(instance)
        program.beat()
        await until(lambda: instance.vehicle.granted)
        report_flight(instance)
        instance.missions.mission.store.items = [WAYPOINT, WAYPOINT]
        service.verdict.clear()
        program.command(300)
        await until(lambda: "CheckRoute" in service.calls)
        program.command(176, 1, mode)
        await until(lambda: (176, mavlink.MAV_RESULT_ACCEPTED) in program.results())
        service.verdict.set()
        await until(lambda: (300, mavlink.MAV_RESULT_TEMPORARILY_REJECTED) in program.results())
        assert instance.vehicle.mode == mode
        assert "Goto" not in service.calls

    run(monkeypatch, scenario)


def test_one_upload_is_judged_at_a_time_and_the_latest_one_is_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        program = Program(instance)
        program.beat()
        await until(lambda: instance.vehicle.granted)
        report_flight(instance)
        instance.missions.mission.store.items = [WAYPOINT, WAYPOINT]
        service.verdict.clear()
        for altitude_m in range(20, 50):
            program.write_item(1, altitude_m)
            await asyncio.sleep(0.0)
        await until(lambda: "CheckRoute" in service.calls)
        assert service.calls.count("CheckRoute") == 1
        service.verdict.set()
        await until(lambda: instance.missions.mission.items[1].z == 49.0)
        assert service.calls.count("CheckRoute") == 2
        program.results()
        assert program.mission_acks == [mavlink.MAV_MISSION_ACCEPTED]

    run(monkeypatch, scenario)


def test_one_start_of_a_mission_is_judged_at_a_time_and_the_latest_one_is_flown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        program = Program(instance)
        program.beat()
        await until(lambda: instance.vehicle.granted)
        report_flight(instance)
        instance.missions.mission.store.items = [WAYPOINT, WAYPOINT]
        service.verdict.clear()
        program.command(300)
        await until(lambda: "CheckRoute" in service.calls)
        program.command(193, 1)
        program.command(176, 1, mavlink.COPTER_MODE_AUTO)
        await until(lambda: (193, TEMPORARILY_REJECTED) in program.results())
        assert service.calls.count("CheckRoute") == 1
        service.verdict.set()
        await until(lambda: (176, ACCEPTED) in program.results())
        assert (300, TEMPORARILY_REJECTED) in program.acks
        await until(lambda: "Goto" in service.calls)
        assert service.calls.count("CheckRoute") == 2

    run(monkeypatch, scenario)


def test_start_that_waits_for_another_start_is_dropped_when_the_program_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        program = Program(instance)
        program.beat()
        await until(lambda: instance.vehicle.granted)
        report_flight(instance)
        instance.missions.mission.store.items = [WAYPOINT, WAYPOINT]
        service.verdict.clear()
        program.command(300)
        await until(lambda: "CheckRoute" in service.calls)
        program.command(193, 1)
        program.command(17)
        await until(lambda: (193, TEMPORARILY_REJECTED) in program.results())
        service.verdict.set()
        await until(lambda: (300, TEMPORARILY_REJECTED) in program.results())
        await asyncio.sleep(0.2)
        assert service.calls.count("CheckRoute") == 1
        assert "Goto" not in service.calls

    run(monkeypatch, scenario)


def test_uploads_that_wait_for_their_verdict_are_refused_when_the_mobility_service_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        program = Program(instance)
        program.beat()
        await until(lambda: instance.vehicle.granted)
        report_flight(instance)
        instance.missions.mission.store.items = [WAYPOINT, WAYPOINT]
        service.verdict.clear()
        program.write_item(1, 20)
        await until(lambda: "CheckRoute" in service.calls)
        program.write_item(1, 21)
        service.closed.set()
        await until(lambda: program.results() or program.mission_acks)
        assert program.mission_acks == [mavlink.MAV_MISSION_DENIED]
        assert instance.missions.transfers.uploads == {}

    run(monkeypatch, scenario)


@pytest.mark.parametrize("items", [[], [WAYPOINT], [WAYPOINT, WAYPOINT, WAYPOINT]])
def test_mission_is_not_flown_if_its_list_changes_before_its_verdict(
    items: list[Item], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        program = Program(instance)
        program.beat()
        await until(lambda: instance.vehicle.granted)
        report_flight(instance)
        instance.missions.mission.store.items = [WAYPOINT, WAYPOINT]
        service.verdict.clear()
        program.command(300)
        await until(lambda: "CheckRoute" in service.calls)
        instance.missions.mission.store.items = items
        service.verdict.set()
        await until(lambda: (300, TEMPORARILY_REJECTED) in program.results())
        await asyncio.sleep(0.05)
        assert "Goto" not in service.calls

    run(monkeypatch, scenario)


def test_start_from_an_item_that_was_removed_before_its_judgement_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        program = Program(instance)
        program.beat()
        await until(lambda: instance.vehicle.granted)
        report_flight(instance)
        instance.vehicle.flying_mode = mavlink.COPTER_MODE_AUTO
        instance.missions.mission.store.items = [WAYPOINT, WAYPOINT, WAYPOINT]
        program.command(224, 2)
        instance.missions.mission.store.items = [WAYPOINT, WAYPOINT]
        await until(lambda: (224, mavlink.MAV_RESULT_DENIED) in program.results())
        assert "CheckRoute" not in service.calls

    run(monkeypatch, scenario)


@pytest.mark.parametrize("number", [21, 17, 300])
def test_return_after_a_fence_breach_is_not_repeated_after_a_later_command(
    number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        program = Program(instance)
        program.beat()
        await until(lambda: instance.vehicle.granted)
        instance.missions.mission.store.items = [WAYPOINT, WAYPOINT]
        service.deferred.add("ReturnToLaunch")
        await breach_fence(instance, program)
        await until(lambda: service.calls.count("ReturnToLaunch") > 1)
        program.command(number)
        await until(lambda: (number, ACCEPTED) in program.results())
        await asyncio.sleep(0.02)
        service.calls.clear()
        await asyncio.sleep(0.1)
        assert "ReturnToLaunch" not in service.calls

    run(monkeypatch, scenario)


def test_return_after_a_fence_breach_ends_with_control(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        program = Program(instance)
        program.beat()
        await until(lambda: instance.vehicle.granted)
        service.deferred.add("ReturnToLaunch")
        await breach_fence(instance, program)
        await until(lambda: service.calls.count("ReturnToLaunch") > 1)
        service.events.put_nowait(ControlEvent(state=ControlEvent.STATE_LOST))
        await until(lambda: not instance.vehicle.granted)
        service.calls.clear()
        await asyncio.sleep(0.1)
        assert "ReturnToLaunch" not in service.calls

    run(monkeypatch, scenario)


@pytest.mark.parametrize(
    ("number", "result"), [(17, ACCEPTED), (20, ACCEPTED), (21, ACCEPTED), (400, ACCEPTED), (22, TEMPORARILY_REJECTED)]
)
def test_drone_is_stopped_and_landed_while_many_calls_have_no_verdict(
    number: int, result: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario(instance: Instance, service: Service) -> None:
        program = Program(instance)
        program.beat()
        await until(lambda: instance.vehicle.granted)
        service.verdict.clear()
        for sender in range(instance_module.MAX_CALLS):
            instance.start(program.session, Call(set_speed(3.0), "DO_CHANGE_SPEED", (sender, 1), 178))
        program.command(number)
        await until(lambda: (number, result) in program.results())

    run(monkeypatch, scenario)
