"""Unix socket for the MAVLink gateway: a second transport of the handlers, without gRPC.

The gateway authenticates instances by TLS and sends the certificate of each instance. This process trusts the gateway
to do so. It accepts only connections of its own user, root, and the user of the gateway.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
import struct
from collections.abc import Awaitable, Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, Protocol

import grpc
from fractus_core.policy.decision_types import Call
from fractus_proto.v1 import gateway_pb2, mobility_pb2
from fractus_runtime.mavlink_codec import Message
from google.protobuf.message import DecodeError
from google.rpc import code_pb2, status_pb2

from fractus_services.error_details import decision
from fractus_services.grpc_server import CallAdmission
from fractus_services.mobility.rpc.handlers import MobilityHandlers
from fractus_services.mobility.rpc.proto_conversion import call_of
from fractus_services.mobility.settings import SETTINGS
from fractus_services.options import CannotServe

log = logging.getLogger(__name__)

MAX_MESSAGE_BYTES = 64 * 1024
"""Maximum size of a message from the gateway."""

MAX_QUEUED_BYTES = 256 * 1024
MAX_UNSENT_BYTES = 1024 * 1024
"""Sizes of unsent data above which vehicle messages are dropped, and above which the connection is closed."""

MAX_CALLS = 64
"""Maximum number of open calls of one connection."""

_LENGTH = struct.Struct(">I")
_PEER_CREDENTIALS = struct.Struct("3i")
_STATUS_KEY = "grpc-status-details-bin"

METHODS: Mapping[str, Any] = {
    "GetControl": mobility_pb2.GetControlRequest,
    "ConfirmAlive": mobility_pb2.ConfirmAliveRequest,
    "ReturnControl": mobility_pb2.ReturnControlRequest,
    "Arm": mobility_pb2.ArmRequest,
    "Disarm": mobility_pb2.DisarmRequest,
    "Takeoff": mobility_pb2.TakeoffRequest,
    "Land": mobility_pb2.LandRequest,
    "Goto": mobility_pb2.GotoRequest,
    "ReturnToLaunch": mobility_pb2.ReturnToLaunchRequest,
    "Hover": mobility_pb2.HoverRequest,
    "SetSpeed": mobility_pb2.SetSpeedRequest,
    "SetVelocity": mobility_pb2.SetVelocityRequest,
    "PointGimbal": mobility_pb2.PointGimbalRequest,
}
"""Methods of MobilityService that the gateway may call, with their request messages."""


class VehicleMessages(Protocol):
    """Access of the gateway to the vehicle's messages and parameters."""

    def subscribe(self, *names: str) -> contextlib.AbstractContextManager[asyncio.Queue[Message]]:
        """Queue the vehicle's messages with these names until the block ends."""

    async def known_parameters(self) -> dict[str, float]:
        """Return the parameters of the vehicle, as far as they are known."""

    def request_gateway_messages(self) -> None:
        """Request the messages that MAVLink programs expect and the service itself does not need."""


class CallEnded(Exception):
    """A call ended with a status."""

    def __init__(self, status: bytes) -> None:
        super().__init__()
        self.status = status


class SocketContext:
    """The part of `grpc.aio.ServicerContext` that handlers use, for a call over the socket.

    Args:
        certificate: PEM certificate of the caller.
        timeout_s: Deadline in seconds; 0 for none.
        send: Sends a response message of the call.
    """

    def __init__(self, certificate: bytes, timeout_s: float, send: Callable[[Any], Awaitable[None]]) -> None:
        self._certificate = certificate
        self._loop = asyncio.get_running_loop()
        self._deadline = self._loop.time() + timeout_s if timeout_s > 0 else None
        self._send = send

    def auth_context(self) -> dict[str, tuple[bytes, ...]]:
        """Return the certificate of the caller as gRPC does."""
        return {"x509_pem_cert": (self._certificate,)}

    def time_remaining(self) -> float | None:
        """Return the seconds until the deadline of the call; None if it has none."""
        return None if self._deadline is None else max(self._deadline - self._loop.time(), 0.0)

    async def write(self, message: Any) -> None:
        """Send one message of a stream."""
        await self._send(message)

    async def abort(self, code: grpc.StatusCode, details: str, trailing_metadata: Any = ()) -> NoReturn:
        """End the call with a status."""
        for key, value in trailing_metadata:
            if key == _STATUS_KEY:
                raise grpc.aio.AbortError(value)
        status = status_pb2.Status(code=code.value[0], message=details)
        raise grpc.aio.AbortError(status.SerializeToString())


class GatewaySocket:
    """Serves the gateway.

    Args:
        path: Path of the socket.
        handlers: Handlers of the mobility service for the interface `mavlink`.
        vehicle: Messages and parameters of the vehicle.
        delivered: Names of the vehicle's messages that applications may receive.
        user: Id of the gateway's user, if it is another one. The group of the socket's directory must be a group of this
            user, and the directory must have the set-group-ID bit.
    """

    def __init__(
        self,
        path: Path,
        handlers: MobilityHandlers,
        vehicle: VehicleMessages,
        delivered: tuple[str, ...],
        user: int | None = None,
    ) -> None:
        self._path = path
        self._users = {0, os.getuid()} if user is None else {0, os.getuid(), user}
        self._mode = 0o600 if user is None else 0o660
        self._handlers = handlers
        self._vehicle = vehicle
        self._delivered = delivered
        self._connections: set[asyncio.Task[Any]] = set()

    async def run(self) -> None:
        """Serve until cancelled.

        Raises:
            CannotServe: The socket cannot be created.
        """
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            if self._path.is_socket():  # left by an earlier process
                self._path.unlink()
            server = await asyncio.start_unix_server(self._serve, self._path)
            self._path.chmod(self._mode)
        except OSError as error:
            raise CannotServe(
                f"--gateway-socket {self._path}: cannot listen ({error.strerror}); name a file that does not exist, in an existing directory"
            ) from None
        log.info("gateway: serving (socket=%s)", self._path)
        try:
            await asyncio.Event().wait()
        finally:
            # Since Python 3.12, `Server.wait_closed` and `serve_forever` wait for connections that the gateway keeps open.
            server.close()
            self._path.unlink(missing_ok=True)
            connections = list(self._connections)
            for connection in connections:
                connection.cancel()
            await asyncio.gather(*connections, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None  # every coroutine runs in a task
        self._connections.add(task)
        try:
            uid = _peer_uid(writer)
            if uid not in self._users:
                log.warning("gateway: connection refused, this user may not use the socket (uid=%d)", uid)
                return
            await _Connection(reader, writer, self._handlers, self._vehicle, self._delivered).run()
        except (asyncio.IncompleteReadError, ConnectionError, DecodeError) as error:
            log.info("gateway: connection ended (reason=%s)", type(error).__name__)
        except asyncio.CancelledError:
            log.info("gateway: connection closed, the service stops")  # not raised, because asyncio would log an error
        finally:
            self._connections.discard(task)
            writer.close()


class _Connection:
    """The connection of one instance."""

    def __init__(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        handlers: MobilityHandlers,
        vehicle: VehicleMessages,
        delivered: tuple[str, ...],
    ) -> None:
        self._reader = reader
        self._writer = writer
        self._handlers = handlers
        self._vehicle = vehicle
        self._delivered = delivered
        self._certificate = b""
        self._calls: dict[int, asyncio.Task[None]] = {}

    async def run(self) -> None:
        """Serve calls until the connection ends. Then cancel the open calls."""
        try:
            while True:
                (length,) = _LENGTH.unpack(await self._reader.readexactly(_LENGTH.size))
                if length > MAX_MESSAGE_BYTES:
                    log.warning("gateway: connection closed, a message is too long (bytes=%d)", length)
                    return
                request = gateway_pb2.GatewayRequest.FromString(await self._reader.readexactly(length))
                self._take(request)
        finally:
            for task in list(self._calls.values()):
                task.cancel()
            await asyncio.gather(*self._calls.values(), return_exceptions=True)

    def _take(self, request: gateway_pb2.GatewayRequest) -> None:
        match request.WhichOneof("request"):
            case "certificate":
                self._certificate = request.certificate
            case "cancel":
                task = self._calls.get(request.id)
                if task is not None:
                    task.cancel()
            case "call" if request.id not in self._calls and len(self._calls) < MAX_CALLS:
                task = asyncio.get_running_loop().create_task(self._run_call(request.id, request.call))
                self._calls[request.id] = task
                task.add_done_callback(lambda _task: self._calls.pop(request.id, None))
            case _:
                status = status_pb2.Status(code=code_pb2.RESOURCE_EXHAUSTED, message="too many open calls")
                self._write(gateway_pb2.GatewayResponse(id=request.id, status=status.SerializeToString()))

    async def _run_call(self, number: int, call: gateway_pb2.GatewayCall) -> None:
        async def send(message: Any) -> None:
            self._write(gateway_pb2.GatewayResponse(id=number, message=message.SerializeToString()))

        status = status_pb2.Status().SerializeToString()
        try:
            context = SocketContext(self._certificate, call.timeout_s, send)
            async with asyncio.timeout(call.timeout_s or None):
                response = await self._handler(call.method)(call.request, context)
            if response is not None:
                await send(response)
        except grpc.aio.AbortError as ended:
            status = ended.args[0]
        except TimeoutError:
            reason = f"{call.method} took more than {call.timeout_s:.0f} s"
            status = status_pb2.Status(code=code_pb2.DEADLINE_EXCEEDED, message=reason).SerializeToString()
        except (DecodeError, KeyError):
            reason = f"{call.method} is not a method that the gateway may call, or its request is malformed"
            status = status_pb2.Status(code=code_pb2.INVALID_ARGUMENT, message=reason).SerializeToString()
        except asyncio.CancelledError:
            status = status_pb2.Status(code=code_pb2.CANCELLED, message="cancelled").SerializeToString()
            raise
        finally:
            self._write(gateway_pb2.GatewayResponse(id=number, status=status))

    def _handler(self, method: str) -> Callable[[bytes, SocketContext], Awaitable[Any]]:
        if method == "SubscribeVehicle":
            return self._subscribe_vehicle
        if method == "ListParameters":
            return self._list_parameters
        if method == "CheckRoute":
            return self._check_route
        return partial(_decode_and_call, METHODS[method], getattr(self._handlers, method))

    async def _subscribe_vehicle(self, _request: bytes, context: SocketContext) -> None:
        """Send the vehicle's messages while the caller may read the position of the drone."""
        handlers = self._handlers
        async with handlers.admission.call(context, lasting=True) as caller:
            self._vehicle.request_gateway_messages()
            loop = asyncio.get_running_loop()
            judged_at = float("-inf")
            with self._vehicle.subscribe(*self._delivered, "HEARTBEAT") as queue:
                while True:
                    if loop.time() - judged_at >= SETTINGS.telemetry_judge_interval_s:
                        judged_at = loop.time()
                        caller.check()
                        handlers.calls.allow(Call("GetPosition"), handlers.admission.grant_of(caller))
                    try:
                        async with asyncio.timeout(SETTINGS.telemetry_judge_interval_s):
                            frames = (await queue.get()).frame
                    except TimeoutError:
                        continue
                    while not queue.empty():
                        frames += queue.get_nowait().frame
                    if self._writer.transport.get_write_buffer_size() < MAX_QUEUED_BYTES:
                        await context.write(gateway_pb2.VehicleFrames(frames=frames))

    async def _list_parameters(self, _request: bytes, context: SocketContext) -> gateway_pb2.ParameterList:
        admission: CallAdmission = self._handlers.admission
        async with admission.call(context) as caller:
            admission.grant_of(caller)
            return gateway_pb2.ParameterList(values=await self._vehicle.known_parameters())

    async def _check_route(self, request: bytes, context: SocketContext) -> gateway_pb2.RouteVerdict:
        admission: CallAdmission = self._handlers.admission
        async with admission.call(context) as caller:
            calls = [call_of(call) for call in gateway_pb2.Route.FromString(request).calls]
            changed = await self._handlers.calls.check_route(calls, lambda: admission.grant_of(caller))
            return gateway_pb2.RouteVerdict(
                calls=[
                    gateway_pb2.RouteCall(index=position, decision=decision(verdict), permitted=verdict.permits)
                    for position, verdict in changed
                ]
            )

    def _write(self, response: gateway_pb2.GatewayResponse) -> None:
        data = response.SerializeToString()
        self._writer.write(_LENGTH.pack(len(data)) + data)
        if self._writer.transport.get_write_buffer_size() > MAX_UNSENT_BYTES:
            log.warning("gateway: connection closed, the gateway does not read")
            self._writer.transport.abort()


async def _decode_and_call(request_type: Any, handler: Callable[..., Awaitable[Any]], data: bytes, context: Any) -> Any:
    return await handler(request_type.FromString(data), context)


def _peer_uid(writer: asyncio.StreamWriter) -> int:
    connection = writer.get_extra_info("socket")
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER_CREDENTIALS.size)
    _, uid, _ = _PEER_CREDENTIALS.unpack(credentials)
    return int(uid)
