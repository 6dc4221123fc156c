"""One component instance: its connection to the mobility service, its control stream, and the calls of its sessions."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from contextlib import aclosing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fractus_proto.v1 import gateway_pb2, mobility_pb2, types_pb2
from fractus_runtime.mavlink_codec import Parser
from google.protobuf.message import Message as ProtobufMessage
from google.rpc import code_pb2
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_services.gateway.mobility_client import CallRefused, MobilityClient
from fractus_services.gateway.parameters import ParameterView
from fractus_services.gateway.session import Call, Session
from fractus_services.gateway.virtual_vehicle import VirtualVehicle

log = logging.getLogger(__name__)

RETRY_S = 1.0
"""Delay before the gateway calls the mobility service again after a failure."""

CALL_TIMEOUT_S = 10.0
ARM_TIMEOUT_S = 20.0
PARAMETERS_TIMEOUT_S = 200.0
RETURN_TIMEOUT_S = 5.0

CONTROL_WAIT_S = 15.0
"""Time for which arming waits for control. Programs arm as soon as the telemetry looks ready."""

RESPONSE_TIMEOUT_S = 5.0
"""Time within which the gateway answers liveness requests. If it hangs for longer, its instances lose control."""

SUPERVISE_S = 0.25
MAX_CALLS = 16
"""Maximum number of concurrent calls of an instance."""

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
_MOTIONS = frozenset({"Takeoff", "Land", "Goto", "ReturnToLaunch"})
"""Methods whose call lasts until the motion is complete."""

_TIMEOUTS_S = {"Arm": ARM_TIMEOUT_S, **dict.fromkeys(_MOTIONS, 0.0)}
"""Timeouts other than `CALL_TIMEOUT_S`. 0: no timeout."""

_STEERING = _MOTIONS | {"Hover", "SetVelocity"}
"""Methods that move or stop the drone. A call of one of them ends the previous motion."""

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
    """Messages of one kind without a response. While a call waits for its verdict, only the latest message is kept.

    Attributes:
        busy: True while a call waits for its verdict.
        pending: The latest message that arrived meanwhile.
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
        observe: Callback that receives the time to the verdict on each call, in seconds.

    Attributes:
        certificate: PEM certificate of the latest connection.
        vehicle: Vehicle as the instance sees it.
        parameters: Parameters as the instance sees them.
        sessions: Sessions of the connections.
    """

    def __init__(self, identity: str, socket: Path, observe: Callable[[float], None] = ignore_duration) -> None:
        self.identity = identity
        self._observe = observe
        self.certificate = b""
        self.vehicle = VirtualVehicle()
        self.parameters = ParameterView()
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
        self._setpoints = {"motion": _Setpoint(), "gimbal": _Setpoint(), "speed": _Setpoint()}

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
            setpoint.pending = None
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
        self.vehicle.granted = False
        self.vehicle.target = None
        self._granted.clear()

    # Calls

    def start(self, session: Session, call: Call) -> None:
        """Start a call of a session. A setpoint waits for the verdict of the previous one, and replaces a waiting one."""
        steers = call.request.method in _STEERING
        if steers and self.vehicle.granted:
            self._steering.add(session)
        setpoint = self._setpoint(call)
        if setpoint is not None:
            if setpoint.busy:
                setpoint.pending = (session, call)
                return
            if setpoint.flying == call.request.message:
                return
        if self._client is None or len(self._calls) >= MAX_CALLS:
            reason = "the mobility service is not available" if self._client is None else "too many calls in progress"
            session.finish(call, mavlink.MAV_RESULT_TEMPORARILY_REJECTED, reason, self._loop.time())
            return
        if setpoint is not None:
            setpoint.busy = True
        elif steers:
            self._setpoints["motion"].pending = None  # sent before this call
        task = self._loop.create_task(self._run_call(self._client, session, call, setpoint))
        self._calls.add(task)
        task.add_done_callback(self._calls.discard)

    def _setpoint(self, call: Call) -> _Setpoint | None:
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
            stream = client.stream(method, call.request.message, _REPLIES[method], timeout_s)
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
            if not judged:
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
        vehicle = self.vehicle
        if call.request.mode is not None and vehicle.granted:
            vehicle.flying_mode = call.request.mode
        text = ""
        corrected = reply.decision.action == types_pb2.Decision.ACTION_CORRECT
        if call.request.method == "Goto":
            target = reply.target
            vehicle.target = (target.latitude_deg, target.longitude_deg, target.altitude_m)
            if corrected:
                text = (
                    f"flown to {target.latitude_deg:.6f}, {target.longitude_deg:.6f}, {target.altitude_m:.1f} m: "
                    f"{reply.decision.reason}"
                )
        elif call.request.method in _STEERING:
            vehicle.target = None
        if corrected and not text:
            text = f"{call.name} corrected: {reply.decision.reason}"
        session.finish(call, mavlink.MAV_RESULT_ACCEPTED, text, self._loop.time())

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


def _waits_for_control(call: Call) -> bool:
    return call.request.method == "Arm" or bool(call.parameter)
