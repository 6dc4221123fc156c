"""Client of the mobility service's Unix socket: calls of one instance with request ids over one connection."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import AsyncGenerator
from contextlib import aclosing
from pathlib import Path
from typing import Any, Self, TypeVar

from fractus_proto.v1 import gateway_pb2, types_pb2
from google.protobuf.message import Message as ProtobufMessage
from google.rpc import code_pb2, status_pb2

MAX_MESSAGE_BYTES = 4 * 1024 * 1024
"""Maximum size of a message from the mobility service. A list of parameters has about 40 kB."""

READ_BYTES = 64 * 1024

_LENGTH = struct.Struct(">I")

_Reply = TypeVar("_Reply", bound=ProtobufMessage)


class CallRefused(Exception):
    """The mobility service refused a call, or ended it early.

    Attributes:
        code: CamelCase code of the decision; empty if there is none.
        reason: Sentence for the program and its user.
        status: google.rpc.Code.
    """

    def __init__(self, status: int, reason: str, code: str = "") -> None:
        super().__init__(reason)
        self.status = status
        self.reason = reason
        self.code = code


class MobilityClient:
    """Connection of one instance to the mobility service. Use `open` to create it.

    Attributes:
        closed: Set when the connection has ended. All calls then fail.
    """

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.closed = asyncio.Event()
        self._reader = reader
        self._writer = writer
        self._next = 1
        self._waiting: dict[int, asyncio.Queue[gateway_pb2.GatewayResponse | None]] = {}
        self._reading = asyncio.get_running_loop().create_task(self._read())

    @classmethod
    async def open(cls, path: Path, certificate: bytes) -> Self:
        """Connect on behalf of an instance.

        Args:
            path: Path of the socket.
            certificate: PEM certificate that the instance presented.

        Raises:
            OSError: The mobility service is not running.
        """
        client = cls(*await asyncio.open_unix_connection(path))
        client._send(gateway_pb2.GatewayRequest(certificate=certificate))
        return client

    async def close(self) -> None:
        """Close the connection. The mobility service cancels the open calls."""
        self._reading.cancel()
        self._writer.close()
        await asyncio.gather(self._reading, return_exceptions=True)

    async def call(self, method: str, request: ProtobufMessage, reply: type[_Reply], timeout_s: float) -> _Reply:
        """Call a method with one response.

        Raises:
            CallRefused: The call was refused, or the connection has ended.
        """
        response: _Reply | None = None
        async with aclosing(self.stream(method, request, reply, timeout_s)) as replies:
            async for message in replies:
                response = message
        if response is None:
            raise CallRefused(code_pb2.INTERNAL, f"the mobility service sent no response to {method}")
        return response

    async def stream(
        self, method: str, request: ProtobufMessage, reply: type[_Reply], timeout_s: float = 0.0
    ) -> AsyncGenerator[_Reply, None]:
        """Call a method and yield its responses. The call is cancelled when the generator is closed.

        Raises:
            CallRefused: The call was refused, or the connection has ended.
        """
        number = self._next
        self._next += 1
        queue = self._waiting[number] = asyncio.Queue()
        ended = False
        try:
            if self.closed.is_set():
                queue.put_nowait(None)
            call = gateway_pb2.GatewayCall(method=method, request=request.SerializeToString(), timeout_s=timeout_s)
            self._send(gateway_pb2.GatewayRequest(id=number, call=call))
            while True:
                response = await queue.get()
                if response is None:
                    ended = True
                    raise CallRefused(code_pb2.UNAVAILABLE, "the mobility service is not available")
                if response.WhichOneof("response") == "message":
                    message = reply()
                    message.ParseFromString(response.message)
                    yield message
                    continue
                ended = True
                status = status_pb2.Status.FromString(response.status)
                if status.code != code_pb2.OK:
                    raise _refusal(status)
                return
        finally:
            del self._waiting[number]
            if not ended:
                self._send(gateway_pb2.GatewayRequest(id=number, cancel=True))

    async def _read(self) -> None:
        received = bytearray()
        try:
            while data := await self._reader.read(READ_BYTES):
                received += data
                if not self._take_responses(received):
                    return
        except ConnectionError:
            return
        finally:
            self.closed.set()
            for queue in self._waiting.values():
                queue.put_nowait(None)

    def _take_responses(self, received: bytearray) -> bool:
        """Remove complete responses from the received bytes. Return False if a response is too long."""
        start = 0
        while len(received) - start >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(received, start)
            if length > MAX_MESSAGE_BYTES:
                return False
            body = start + _LENGTH.size
            if len(received) - body < length:
                break
            start = body + length
            response = gateway_pb2.GatewayResponse.FromString(bytes(received[body:start]))
            queue = self._waiting.get(response.id)
            if queue is not None:
                queue.put_nowait(response)
        del received[:start]
        return True

    def _send(self, request: gateway_pb2.GatewayRequest) -> None:
        if not self._writer.is_closing():
            data = request.SerializeToString()
            self._writer.write(_LENGTH.pack(len(data)) + data)


def _refusal(status: Any) -> CallRefused:
    decision = types_pb2.Decision()
    for detail in status.details:
        if detail.Is(types_pb2.Decision.DESCRIPTOR):
            detail.Unpack(decision)
    return CallRefused(status.code, status.message, decision.code)
