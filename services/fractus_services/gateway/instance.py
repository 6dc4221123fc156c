"""One component instance: its connection to the mobility service, its control stream, and the calls of its sessions."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine, Mapping
from contextlib import aclosing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fractus_proto.v1 import gateway_pb2, mobility_pb2, types_pb2
from fractus_runtime.mavlink_codec import Parser
from google.protobuf.message import Message as ProtobufMessage
from google.rpc import code_pb2
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.gateway import translate
from fractus_services.gateway.mission_flight import fly_mission
from fractus_services.gateway.mission_route import Place, route_of
from fractus_services.gateway.missions import MissionLists
from fractus_services.gateway.mobility_client import CallRefused, MobilityClient
from fractus_services.gateway.parameters import ParameterView
from fractus_services.gateway.session import Call, Session
from fractus_services.gateway.translate import CHECK_MISSION, FLY_MISSION, Request, Untranslatable
from fractus_services.gateway.virtual_vehicle import VirtualVehicle
from fractus_services.mavlink_server.stored_mission import Mission

log = logging.getLogger(__name__)

RETRY_S = 1.0
"""Delay before the gateway calls the mobility service again after a failure."""

CALL_TIMEOUT_S = 10.0
ARM_TIMEOUT_S = 20.0
PARAMETERS_TIMEOUT_S = 200.0
RETURN_TIMEOUT_S = 5.0
ROUTE_TIMEOUT_S = 30.0

MISSION_POLL_S = 0.1
"""Interval at which the flight of a mission checks if the drone is armed, or at rest."""

JUDGEMENT_PAUSE_S = 0.1
"""Pause after each judgement of a mission, so that uploads of one instance leave processor time to the others."""

REST_MPS = 0.3
REST_TIMEOUT_S = 5.0
"""Speed below which the next item of a mission begins after a leg, and the maximum time to wait for this speed."""

CONTROL_WAIT_S = 15.0
"""Time for which arming waits for control. Programs arm as soon as the telemetry looks ready."""

RESPONSE_TIMEOUT_S = 5.0
"""Time within which the gateway answers liveness requests. If it hangs for longer, its instances lose control."""

SUPERVISE_S = 0.25
MAX_CALLS = 16
MAX_CALLS_WITH_URGENT = 32
"""Maximum numbers of concurrent calls of an instance: for most methods, and for the methods in `_URGENT`."""

REPLACED = "a later command replaced this command"

_REPLIES: Mapping[str, type[ProtobufMessage]] = {
    "Arm": mobility_pb2.ArmResponse,
    "Disarm": mobility_pb2.DisarmResponse,
    "Takeoff": mobility_pb2.MotionProgress,
    "Land": mobility_pb2.MotionProgress,
    "Goto": mobility_pb2.MotionProgress,
    "ReturnToLaunch": mobility_pb2.MotionProgress,
    "Hover": mobility_pb2.HoverResponse,
    "SetSpeed": mobility_pb2.SetSpeedResponse,
    "SetVelocity": mobility_pb2.SetVelocityResponse,
    "PointGimbal": mobility_pb2.PointGimbalResponse,
}
_CHECKED = {
    "Takeoff": "takeoff",
    "Land": "land",
    "Goto": "goto",
    "ReturnToLaunch": "return_to_launch",
    "SetSpeed": "set_speed",
    "PointGimbal": "point_gimbal",
}
"""Fields of CheckCallRequest by the method that a mission calls."""

_MOTIONS = frozenset({"Takeoff", "Land", "Goto", "ReturnToLaunch"})
"""Methods whose call lasts until the motion is complete."""

_TIMEOUTS_S = {"Arm": ARM_TIMEOUT_S, **dict.fromkeys(_MOTIONS, 0.0)}
"""Timeouts other than `CALL_TIMEOUT_S`. 0: no timeout."""

_MISSION_METHODS = frozenset({FLY_MISSION, CHECK_MISSION})
_STEERING = _MOTIONS | {"Hover", "SetVelocity"}
"""Methods that move or stop the drone. A call of one of them ends the previous motion."""

_URGENT = frozenset({"Hover", "Land", "ReturnToLaunch", "Disarm"})
"""Methods that are called although other calls of the instance have no verdict yet."""

_RESULTS = {
    code_pb2.PERMISSION_DENIED: mavlink.MAV_RESULT_DENIED,
    code_pb2.INVALID_ARGUMENT: mavlink.MAV_RESULT_DENIED,
    code_pb2.UNAVAILABLE: mavlink.MAV_RESULT_TEMPORARILY_REJECTED,
    code_pb2.RESOURCE_EXHAUSTED: mavlink.MAV_RESULT_TEMPORARILY_REJECTED,
}
_PASSING = frozenset({code_pb2.UNAVAILABLE, code_pb2.RESOURCE_EXHAUSTED, code_pb2.DEADLINE_EXCEEDED})
"""Status codes after which the control stream is opened again without a request of the program."""

_FINAL = frozenset({mobility_pb2.ControlEvent.STATE_LOST, mobility_pb2.ControlEvent.STATE_COMPLETE})


@dataclass(slots=True)
class _Setpoint:
    """Requests of one kind, of which one at a time is judged. While a call waits for its verdict, only the latest request is kept.

    Attributes:
        busy: True while a call waits for its verdict.
        pending: The latest request that arrived meanwhile.
        flying: Request of the leg that is being flown. A repeated request has no effect.
    """

    busy: bool = False
    pending: tuple[Session, Call] | None = None
    flying: ProtobufMessage | None = None


def ignore_duration(_duration_s: float) -> None:
    """Record nothing."""


class Instance:
    """A component instance with at least one connection.

    Args:
        identity: SPIFFE ID.
        socket: Unix socket of the mobility service.
        missions: File that keeps the stored missions. None: they are kept in memory only.
        observe: Callback that receives the time to the verdict on each call, in seconds.

    Attributes:
        certificate: PEM certificate of the latest connection.
        vehicle: Vehicle as the instance sees it.
        parameters: Parameters as the instance sees them.
        missions: Stored missions, fences and rally points.
        sessions: Sessions of the connections.
    """

    def __init__(
        self,
        identity: str,
        socket: Path,
        missions: Path | None = None,
        observe: Callable[[float], None] = ignore_duration,
    ) -> None:
        self.identity = identity
        self._observe = observe
        self.certificate = b""
        self.vehicle = VirtualVehicle()
        self.parameters = ParameterView()
        self.missions = MissionLists(self.vehicle, missions, self.send_text)
        self.sessions: set[Session] = set()
        self._socket = socket
        self._loop = asyncio.get_running_loop()
        self._client: MobilityClient | None = None
        self._control: asyncio.Task[None] | None = None
        self._ended = False
        # Sessions that have received a valid frame.
        self._known: set[Session] = set()
        # Sessions that have moved the drone. Control ends when one of them is lost.
        self._steering: set[Session] = set()
        self._granted = asyncio.Event()
        self._calls: set[asyncio.Task[None]] = set()
        self._flight: asyncio.Task[None] | None = None  # of the mission, or home after a fence breach
        self._motions = 0  # number of requests that end the motion before them
        self._in_fence = True
        kinds = ("motion", "gimbal", "speed", CHECK_MISSION, FLY_MISSION)
        self._setpoints = {kind: _Setpoint() for kind in kinds}

    @property
    def connected(self) -> bool:
        """True if the mobility service is connected."""
        return self._client is not None

    # Connection to the mobility service

    async def run(self) -> None:
        """Keep the connection to the mobility service open until cancelled."""
        while True:
            try:
                self._client = client = await MobilityClient.open(self._socket, self.certificate)
            except OSError:
                self._report("the mobility service is not available")
                await asyncio.sleep(RETRY_S)
                continue
            try:
                async with asyncio.TaskGroup() as tasks:
                    helpers = [
                        tasks.create_task(self._follow_vehicle(client)),
                        tasks.create_task(self._read_parameters(client)),
                        tasks.create_task(self._supervise(client)),
                    ]
                    await client.closed.wait()
                    for helper in helpers:
                        helper.cancel()
            finally:
                await self._disconnect(client)
            await asyncio.sleep(RETRY_S)

    async def _disconnect(self, client: MobilityClient) -> None:
        """End the connection and its calls."""
        await self._end_control(client)
        self._client = None
        self._report("the connection to the mobility service was closed")
        for setpoint in self._setpoints.values():
            self._drop_pending(setpoint, "the connection to the mobility service was closed")
        await asyncio.sleep(0.0)  # let new calls begin, so that each of them ends with a result
        calls = list(self._calls)
        for call in calls:
            call.cancel()
        await client.close()
        await asyncio.gather(*calls, return_exceptions=True)
        self._ended = False

    async def _end_control(self, client: MobilityClient) -> None:
        """Close the control stream. If the drone has landed, first return control, so that the mission is complete."""
        if self._control is None:
            return
        landed = self.vehicle.flown and not self.vehicle.armed
        if landed and self.vehicle.granted and not client.closed.is_set():
            request = mobility_pb2.ReturnControlRequest()
            try:
                await client.call("ReturnControl", request, mobility_pb2.ReturnControlResponse, RETURN_TIMEOUT_S)
                self.vehicle.flown = False
            except CallRefused as refusal:
                log.info("gateway: control not returned (instance=%s reason=%s)", self.identity, refusal.reason)
        self._control.cancel()
        await asyncio.gather(self._control, return_exceptions=True)
        self._control = None

    async def _follow_vehicle(self, client: MobilityClient) -> None:
        """Store the vehicle's messages. None arrive if the Grant does not include GetPosition."""
        parser = Parser()
        request = gateway_pb2.VehicleFrames()
        while True:
            try:
                async with aclosing(client.stream("SubscribeVehicle", request, gateway_pb2.VehicleFrames)) as batches:
                    async for batch in batches:
                        for message in parser.feed(batch.frames):
                            self.vehicle.take(message, self._loop.time())
                            if message.name == "STATUSTEXT":
                                for session in self.sessions:
                                    session.deliver_text(message)
            except CallRefused as refusal:
                self._report(f"no telemetry: {refusal.reason}")
            await asyncio.sleep(RETRY_S)

    async def _read_parameters(self, client: MobilityClient) -> None:
        request = gateway_pb2.ParameterList()
        while not self.parameters.loaded:
            try:
                reply = await client.call("ListParameters", request, gateway_pb2.ParameterList, PARAMETERS_TIMEOUT_S)
            except CallRefused as refusal:
                log.info("gateway: no parameters (instance=%s reason=%s)", self.identity, refusal.reason)
            else:
                if reply.values:
                    self.parameters.replace(reply.values)
            await asyncio.sleep(RETRY_S)

    def _report(self, sentence: str) -> None:
        """Set the reason for waiting, and send it to all sessions if it has changed."""
        if sentence == self.vehicle.waiting_reason:
            return
        self.vehicle.waiting_reason = sentence
        for session in self.sessions:
            session.send_text(mavlink.MAV_SEVERITY_INFO, sentence, self._loop.time())

    # Control

    async def _supervise(self, client: MobilityClient) -> None:
        """Hold a control stream while a session is alive, and no session that has moved the drone is lost."""
        was_alive = False
        while True:
            now = self._loop.time()
            known = {session for session in self.sessions if session.frames}
            alive = {session for session in known if not session.silent(now)}
            if self._control is not None and (not alive or self._steering - alive):
                log.info("gateway: program lost, control stream closed (instance=%s)", self.identity)
                await self._end_control(client)
            requested = bool(known - self._known) or any(session.reopen for session in self.sessions)
            if requested:
                self._steering &= alive
            if requested or (alive and not was_alive):
                self._ended = False
            self._known = known
            was_alive = bool(alive)
            if alive and self._control is None and not self._ended and not self._steering - alive:
                self._control = self._loop.create_task(self._hold_control(client))
            if self._control is not None and self._control.done():
                self._control = None
            self._check_fence()
            await asyncio.sleep(SUPERVISE_S)

    def _clear_requests(self) -> None:
        for session in self.sessions:
            session.reopen = False

    async def _hold_control(self, client: MobilityClient) -> None:
        self._clear_requests()
        request = mobility_pb2.GetControlRequest(response_timeout_s=RESPONSE_TIMEOUT_S)
        try:
            async with aclosing(client.stream("GetControl", request, mobility_pb2.ControlEvent)) as events:
                async for event in events:
                    await self._take_event(client, event)
        except CallRefused as refusal:
            self._report(refusal.reason)
            self._ended = refusal.status not in _PASSING
            if not self._ended:
                await asyncio.sleep(RETRY_S)
        finally:
            self._lose_control()

    async def _take_event(self, client: MobilityClient, event: mobility_pb2.ControlEvent) -> None:
        if event.state == mobility_pb2.ControlEvent.STATE_PING:
            request = mobility_pb2.ConfirmAliveRequest(ping=event.ping)
            with suppress(CallRefused):  # control ends only if all confirmations fail until the response timeout
                await client.call("ConfirmAlive", request, mobility_pb2.ConfirmAliveResponse, CALL_TIMEOUT_S)
        elif event.state == mobility_pb2.ControlEvent.STATE_GRANTED:
            self.vehicle.granted = True
            self.vehicle.flying_mode = mavlink.COPTER_MODE_GUIDED
            self.vehicle.target = None
            self._clear_requests()
            self._granted.set()
            self._report("control granted")
        elif event.state in _FINAL:
            self._ended = True
            self.vehicle.flown = False
            self._lose_control()
            self._report(f"control ended: {event.reason}")
        else:
            self._report(f"waiting for control: {event.reason}")

    def _lose_control(self) -> None:
        self._stop_flight()
        self.vehicle.granted = False
        self.vehicle.target = None
        self._granted.clear()

    # Calls

    def start(self, session: Session, call: Call) -> None:
        """Start a call of a session.

        A setpoint, an upload or a start of a mission waits for the verdict of the previous one, and replaces a waiting one.
        """
        steers = call.request.method in _STEERING
        if (steers or call.request.method == FLY_MISSION) and self.vehicle.granted:
            self._steering.add(session)
        problem = self._fence_problem(call.request)
        if problem:
            session.finish(call, mavlink.MAV_RESULT_DENIED, problem, self._loop.time())
            return
        if call.request == translate.fly_mission() and self._flies_mission:
            session.finish(call, mavlink.MAV_RESULT_ACCEPTED, "", self._loop.time())
            return
        setpoint = self._setpoint(call)
        if setpoint is not None:
            if setpoint.busy:
                self._drop_pending(setpoint, REPLACED)
                setpoint.pending = (session, call)
                return
            if setpoint.flying is not None and setpoint.flying == call.request.message:
                return
        limit = MAX_CALLS_WITH_URGENT if call.request.method in _URGENT else MAX_CALLS
        if self._client is None or len(self._calls) >= limit:
            reason = "the mobility service is not available" if self._client is None else "too many calls in progress"
            session.finish(call, mavlink.MAV_RESULT_TEMPORARILY_REJECTED, reason, self._loop.time())
            return
        if setpoint is not None:
            setpoint.busy = True
        elif steers:
            self._setpoints["motion"].pending = None  # sent before this call
        if call.request.method == FLY_MISSION:
            self._motions += 1
        if steers:
            self._stop_flight()
        work = self._run_mission_call if call.request.method in _MISSION_METHODS else self._run_call
        self._spawn(work(self._client, session, call, setpoint))

    def _spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = self._loop.create_task(work)
        self._calls.add(task)
        task.add_done_callback(self._calls.discard)
        return task

    def _drop_pending(self, setpoint: _Setpoint, reason: str) -> None:
        """Drop the pending request. Uploads and starts of missions have a response, which contains the reason."""
        pending = setpoint.pending
        setpoint.pending = None
        if pending is not None and pending[1].request.method in _MISSION_METHODS:
            session, call = pending
            session.finish(call, mavlink.MAV_RESULT_TEMPORARILY_REJECTED, reason, self._loop.time())

    def _setpoint(self, call: Call) -> _Setpoint | None:
        if call.request.method in _MISSION_METHODS:
            return self._setpoints[call.request.method]
        if call.parameter:
            return self._setpoints["speed"]
        if not call.is_setpoint:
            return None
        return self._setpoints["gimbal" if call.request.method == "PointGimbal" else "motion"]

    async def _run_call(self, client: MobilityClient, session: Session, call: Call, setpoint: _Setpoint | None) -> None:
        method = call.request.method
        judged = False
        began_s = self._loop.time()
        try:
            await self._wait_for_control(call)
            timeout_s = _TIMEOUTS_S.get(method, CALL_TIMEOUT_S)
            stream = client.stream(method, self._content(call.request), _REPLIES[method], timeout_s)
            async with aclosing(stream) as replies:
                async for reply in replies:
                    if not judged:
                        judged = True
                        self._observe_verdict(call, began_s)
                        self._accept(session, call, reply)
                        self._free(setpoint, call.request.message if method == "Goto" else None)
        except asyncio.CancelledError:
            if not judged:
                reason = "the connection to the mobility service was closed"
                session.finish(call, mavlink.MAV_RESULT_TEMPORARILY_REJECTED, reason, self._loop.time())
            raise
        except CallRefused as refusal:
            result = _RESULTS.get(refusal.status, mavlink.MAV_RESULT_FAILED)
            guided = method == "Hover" and call.request.mode == mavlink.COPTER_MODE_GUIDED
            if guided and refusal.code == "NotFlying" and self.vehicle.granted:
                # On the ground, the mode AUTO ends without a motion.
                self.vehicle.flying_mode = mavlink.COPTER_MODE_GUIDED
                session.finish(call, mavlink.MAV_RESULT_ACCEPTED, "", self._loop.time())
            elif not judged:
                if refusal.code == "Replaced" and call.is_setpoint:
                    return
                self._observe_verdict(call, began_s)
                session.finish(call, result, refusal.reason, self._loop.time())
            elif refusal.code != "Replaced":
                text = f"{call.name} ended: {refusal.reason}"
                session.send_text(mavlink.MAV_SEVERITY_WARNING, text, self._loop.time())
        finally:
            if not judged:
                self._free(setpoint, None)
            elif setpoint is not None and setpoint.flying is call.request.message:
                setpoint.flying = None

    def _content(self, request: Request) -> ProtobufMessage:
        """Return the message of a request. A return flight gets the altitude that the program has written."""
        message: ProtobufMessage = request.message
        if request.method != "ReturnToLaunch":
            return message
        return mobility_pb2.ReturnToLaunchRequest(altitude_m=self.parameters.return_altitude_m)

    def _observe_verdict(self, call: Call, began_s: float) -> None:
        if not _waits_for_control(call):
            self._observe(self._loop.time() - began_s)

    async def _wait_for_control(self, call: Call) -> None:
        """Wait for control if the call arms the drone or sets a parameter. Other calls do not wait."""
        if not _waits_for_control(call):
            return
        try:
            async with asyncio.timeout(None if call.parameter else CONTROL_WAIT_S):
                await self._granted.wait()
        except TimeoutError:
            raise CallRefused(code_pb2.UNAVAILABLE, self.vehicle.waiting_reason) from None

    def _accept(self, session: Session, call: Call, reply: Any) -> None:
        """Send the result of a call that the mobility service has accepted."""
        text = self._note(call.request, call.name, reply)
        session.finish(call, mavlink.MAV_RESULT_ACCEPTED, text, self._loop.time())

    def _note(self, request: Request, name: str, reply: Any) -> str:
        """Note a request that the mobility service has accepted. Return the sentence about its correction."""
        vehicle = self.vehicle
        if request.mode is not None and vehicle.granted:
            vehicle.flying_mode = request.mode
        corrected = reply.decision.action == types_pb2.Decision.ACTION_CORRECT
        if request.method == "Goto":
            target = reply.target
            vehicle.target = (target.latitude_deg, target.longitude_deg, target.altitude_m)
            if corrected:
                return (
                    f"flown to {target.latitude_deg:.6f}, {target.longitude_deg:.6f}, {target.altitude_m:.1f} m: "
                    f"{reply.decision.reason}"
                )
        elif request.method in _STEERING:
            vehicle.target = None
        return f"{name} corrected: {reply.decision.reason}" if corrected else ""

    def _free(self, setpoint: _Setpoint | None, flying: ProtobufMessage | None) -> None:
        """Mark that no call waits for its verdict, and start the call of the pending message."""
        if setpoint is None:
            return
        setpoint.busy = False
        setpoint.flying = flying
        pending = setpoint.pending
        setpoint.pending = None
        if pending is not None:
            self.start(*pending)

    # Missions

    def send_text(self, severity: int, text: str) -> None:
        """Send a text to all sessions."""
        for session in self.sessions:
            session.send_text(severity, text, self._loop.time())

    def report_current(self) -> None:
        """Report the current item of the mission to all sessions."""
        for session in self.sessions:
            session.report_current()

    def report_reached(self, number: int) -> None:
        """Report a completed item of the mission to all sessions."""
        for session in self.sessions:
            session.report_reached(number)

    async def _run_mission_call(
        self, client: MobilityClient, session: Session, call: Call, setpoint: _Setpoint | None
    ) -> None:
        """Judge an uploaded mission, or judge and fly the rest of the stored mission. Then start the pending request."""
        try:
            await self._judge_mission(client, session, call)
            await asyncio.sleep(JUDGEMENT_PAUSE_S)
        finally:
            self._free(setpoint, None)

    async def _judge_mission(self, client: MobilityClient, session: Session, call: Call) -> None:
        flies = call.request.method == FLY_MISSION
        motions = self._motions
        mission = self.missions.mission if flies else self.missions.with_items(call.request.message)
        items = mission.items
        try:
            first = mission.next_after(0) if not flies else self._first_item(call.request.message)
            at = self._place()
            corrections = await self._check_route(client, mission, first, at)
        except asyncio.CancelledError:
            reason = "the connection to the mobility service was closed"
            session.finish(call, mavlink.MAV_RESULT_TEMPORARILY_REJECTED, reason, self._loop.time())
            raise
        except Untranslatable as problem:
            session.finish(call, problem.result, str(problem), self._loop.time())
            return
        except CallRefused as refusal:
            result = _RESULTS.get(refusal.status, mavlink.MAV_RESULT_FAILED)
            session.finish(call, result, refusal.reason, self._loop.time())
            return
        replaced = motions != self._motions or self._setpoints[FLY_MISSION].pending is not None
        if flies and (replaced or not self.vehicle.granted):
            session.finish(call, mavlink.MAV_RESULT_TEMPORARILY_REJECTED, REPLACED, self._loop.time())
            return
        if mission.items is not items:
            reason = "the mission changed while it was judged; start it again"
            session.finish(call, mavlink.MAV_RESULT_TEMPORARILY_REJECTED, reason, self._loop.time())
            return
        session.finish(call, mavlink.MAV_RESULT_ACCEPTED, corrections, self._loop.time())
        if flies and first is not None:
            self._stop_flight()
            self.vehicle.flying_mode = mavlink.COPTER_MODE_AUTO
            self._flight = self._spawn(self._fly_mission(client, first))

    def _first_item(self, number: int | None) -> int | None:
        """Return the item from which the stored mission is flown. A completed mission starts again.

        Raises:
            Untranslatable: The mission has become shorter since the request.
        """
        mission = self.missions.mission
        if mission.complete:
            mission.rewind()
        if number is None:
            return mission.current if mission.current > 0 else mission.next_after(0)
        if number >= len(mission.items):
            raise Untranslatable(f"the mission has no item {number} to fly")
        return number

    def _place(self) -> Place:
        """Return the present place of the drone.

        Raises:
            Untranslatable: The position is unknown.
        """
        pose = self.vehicle.pose(self._loop.time())
        if pose is None:
            raise Untranslatable("the drone's position is not known", mavlink.MAV_RESULT_TEMPORARILY_REJECTED)
        return Place(pose.lat, pose.lon, pose.altitude_m)

    async def _check_route(self, client: MobilityClient, mission: Mission, first: int | None, at: Place) -> str:
        """Judge the route of a mission. Return a sentence about corrected items.

        Raises:
            Untranslatable: An item is refused.
            CallRefused: The mobility service did not judge the route.
        """
        if first is None:
            return ""
        route = route_of(mission, first, at, on_ground=self.vehicle.on_ground)
        for number, request in route:
            problem = self._fence_problem(request)
            if problem:
                raise Untranslatable(f"item {number}: {problem}")
        calls = [mobility_pb2.CheckCallRequest(**{_CHECKED[request.method]: request.message}) for _, request in route]
        verdict = await client.call(
            "CheckRoute", gateway_pb2.Route(calls=calls), gateway_pb2.RouteVerdict, ROUTE_TIMEOUT_S
        )
        sentences = [f"item {route[call.index][0]}: {call.decision.reason}" for call in verdict.calls]
        if verdict.calls and not verdict.calls[-1].permitted:
            raise Untranslatable(sentences[-1])
        return f"corrected in flight: {sentences[0]}" if sentences else ""

    async def _fly_mission(self, client: MobilityClient, first: int) -> None:
        mission = self.missions.mission
        while not self.vehicle.armed:  # noqa: ASYNC110 - the heartbeat may arrive later than the result of arming
            await asyncio.sleep(MISSION_POLL_S)

        async def perform(request: Request) -> None:
            await self._perform(client, request)

        try:
            await fly_mission(mission, first, self._place(), perform, self)
        except (CallRefused, Untranslatable) as problem:
            if self.vehicle.in_mission:
                self.vehicle.flying_mode = mavlink.COPTER_MODE_BRAKE
            self.send_text(mavlink.MAV_SEVERITY_WARNING, f"Mission stopped at item {mission.current}: {problem}")

    async def _perform(self, client: MobilityClient, request: Request) -> None:
        """Make one call of the mission, and wait until its motion is complete. Repeat a call that the service defers.

        Raises:
            CallRefused: The call was refused.
            Untranslatable: The target is outside the fence.
        """
        problem = self._fence_problem(request)
        if problem:
            raise Untranslatable(problem)
        method = request.method
        while True:
            noted = False
            try:
                timeout_s = _TIMEOUTS_S.get(method, CALL_TIMEOUT_S)
                stream = client.stream(method, self._content(request), _REPLIES[method], timeout_s)
                async with aclosing(stream) as replies:
                    async for reply in replies:
                        if not noted:
                            noted = True
                            text = self._note(request, "Mission", reply)
                            if text:
                                self.send_text(mavlink.MAV_SEVERITY_NOTICE, text)
            except CallRefused as refusal:
                if noted or refusal.status not in _PASSING or client.closed.is_set():
                    raise
            else:
                break
            await asyncio.sleep(RETRY_S)
        if method == "Goto":
            await self._come_to_rest()

    async def _come_to_rest(self) -> None:
        """Wait until the drone is at rest, because the next leg was judged for a drone at rest."""
        with suppress(TimeoutError):
            async with asyncio.timeout(REST_TIMEOUT_S):
                while self.vehicle.speed_mps > REST_MPS:  # noqa: ASYNC110 - the vehicle has no notification
                    await asyncio.sleep(MISSION_POLL_S)

    @property
    def _flies_mission(self) -> bool:
        return self.vehicle.in_mission and self._flight is not None and not self._flight.done()

    def _stop_flight(self) -> None:
        """End the flight of the mission or home, and starts that wait for a verdict. The current item does not change."""
        self._motions += 1
        self._drop_pending(self._setpoints[FLY_MISSION], REPLACED)
        if self._flight is not None:
            self._flight.cancel()
            self._flight = None

    def _fence_problem(self, request: Request) -> str:
        """Return why the fence of the program forbids a request, or an empty string."""
        if request.method != "Goto":
            return ""
        target = request.message.target
        problem = self.missions.fence_problem(target.latitude_deg, target.longitude_deg)
        return f"the target is {problem}" if problem else ""

    def _check_fence(self) -> None:
        """Return home when the drone leaves the fence of the program, as ArduCopter does."""
        pose = self.vehicle.pose(self._loop.time())
        if pose is None or not (self.vehicle.granted and self.vehicle.armed):
            return
        problem = self.missions.fence_problem(pose.lat, pose.lon)
        left = self._in_fence and bool(problem)
        self._in_fence = not problem
        if left and self._client is not None:
            self.send_text(mavlink.MAV_SEVERITY_NOTICE, "Polygon fence breached: the drone returns home")
            self._stop_flight()
            self._setpoints["motion"].pending = None
            self.vehicle.flying_mode = mavlink.COPTER_MODE_RTL  # refuses the targets that follow
            self._flight = self._spawn(self._return_home(self._client))

    async def _return_home(self, client: MobilityClient) -> None:
        try:
            await self._perform(client, translate.return_to_launch())
        except CallRefused as refusal:
            if self.vehicle.flying_mode == mavlink.COPTER_MODE_RTL:
                self.vehicle.flying_mode = mavlink.COPTER_MODE_BRAKE
            self.send_text(mavlink.MAV_SEVERITY_WARNING, f"return after a fence breach ended: {refusal.reason}")


def _waits_for_control(call: Call) -> bool:
    return call.request.method == "Arm" or bool(call.parameter)
