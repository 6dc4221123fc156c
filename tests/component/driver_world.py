"""Driver programs of the SDK against the real handlers of the mobility service, in virtual time and without a network."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import grpc
import grpc.aio
from fractus.channel import ServiceChannel
from fractus.drone import Mobility
from fractus.environment import Endpoint
from fractus_core.api.names import component_name
from fractus_services.error_details import abort
from fractus_services.errors import PolicyDenied, Refused
from fractus_services.grant_files import ActiveGrant
from fractus_services.mobility.rpc.handlers import MobilityHandlers
from mobility_world import World

STREAMS = frozenset({"GetControl", "Takeoff", "Land", "Goto", "ReturnToLaunch", "SubscribeTelemetry"})
_END = object()


class Admission:
    """Admits every call of a known driver, without certificates and rate limits, which count real time."""

    def __init__(self, world: World) -> None:
        self._world = world

    @asynccontextmanager
    async def call(self, context: Any, urgent: bool = False, lasting: bool = False) -> AsyncIterator[Any]:
        del urgent, lasting
        try:
            yield SimpleNamespace(identity=context.identity, left_s=3600.0, check=lambda: None)
        except Refused as refusal:
            await abort(context, refusal)

    def grant_of(self, caller: Any) -> ActiveGrant:
        grant = self._world.grants.active.get(caller.identity)
        if grant is None:
            raise PolicyDenied("NoGrant", f"{component_name(caller.identity)} has no Grant on this node")
        return grant


class Context:
    """Context of one call at the server."""

    def __init__(self, identity: str, timeout_s: float | None) -> None:
        self.identity = identity
        self.messages: asyncio.Queue[Any] = asyncio.Queue()
        self._timeout_s = timeout_s

    def time_remaining(self) -> float | None:
        return self._timeout_s

    async def write(self, message: Any) -> None:
        self.messages.put_nowait(message)

    async def abort(self, code: grpc.StatusCode, text: str, metadata: Any = ()) -> None:
        raise grpc.aio.AioRpcError(code, grpc.aio.Metadata(), grpc.aio.Metadata(*metadata), details=text)


class Process:
    """Process of a driver: its connection to the service, which breaks when the process dies.

    A process that hangs neither sends nor receives, while its connection stays open. A program that blocks the event loop
    behaves in this way.
    """

    def __init__(self, world: World, identity: str) -> None:
        self.handlers = MobilityHandlers(
            world.service,
            world.control,
            world.streams,
            grants=world.grants,  # type: ignore[arg-type]
            node="drone-1",
            clock=lambda: 1_790_000_000.0 + world.plane.now,
        )
        self.handlers.admission = Admission(world)  # type: ignore[assignment]
        self.identity = identity
        self._calls: set[asyncio.Task[Any]] = set()
        self._running = asyncio.Event()
        self._running.set()
        self._dead = False

    def drone(self, *, strict: bool = False) -> Mobility:
        """Return a client that uses this connection."""
        client = Mobility(Endpoint("drone-1:50051", "drone-1.node.fractus.dev", Path()), strict=strict)
        client._channel = MemoryChannel(self)
        return client

    def hang(self, seconds: float) -> None:
        """Hang for some time, or until the end if the time is infinite."""
        self._running.clear()
        if seconds < float("inf"):
            asyncio.get_running_loop().call_later(seconds, self._running.set)

    def die(self) -> None:
        """Break the connection, and never answer again."""
        self._running.clear()
        self._dead = True
        for call in self._calls:
            call.cancel()

    async def wait_running(self) -> None:
        """Wait while the process hangs."""
        await self._running.wait()

    def serve(self, method: str, request: Any, context: Context) -> asyncio.Task[Any]:
        """Start a call at the server."""
        call = asyncio.ensure_future(getattr(self.handlers, method)(request, context))
        self._calls.add(call)
        call.add_done_callback(self._calls.discard)
        if self._dead:
            call.cancel()
        return call


class MemoryChannel(ServiceChannel):
    """Channel of the SDK to the handlers of a process's connection."""

    def __init__(self, process: Process) -> None:
        super().__init__(Endpoint("drone-1:50051", "drone-1.node.fractus.dev", Path()), lambda _channel: None)
        self._process = process

    @asynccontextmanager
    async def stub(self) -> AsyncIterator[Any]:
        yield _Stub(self._process)


class _Stub:
    def __init__(self, process: Process) -> None:
        self._process = process

    def __getattr__(self, method: str) -> Any:
        kind = _Stream if method in STREAMS else self._unary
        return lambda request, timeout=None: kind(self._process, method, request, timeout)

    @staticmethod
    async def _unary(process: Process, method: str, request: Any, timeout_s: float | None) -> Any:
        await process.wait_running()
        call = process.serve(method, request, Context(process.identity, timeout_s))
        try:
            async with asyncio.timeout(timeout_s):
                response = await call
        except TimeoutError:
            raise grpc.aio.AioRpcError(
                grpc.StatusCode.DEADLINE_EXCEEDED, grpc.aio.Metadata(), grpc.aio.Metadata()
            ) from None
        await process.wait_running()
        return response


class _Stream:
    """Call with a stream of responses."""

    def __init__(self, process: Process, method: str, request: Any, timeout_s: float | None) -> None:
        self._process = process
        self._context = Context(process.identity, timeout_s)
        self._call = process.serve(method, request, self._context)
        self._call.add_done_callback(lambda _: self._context.messages.put_nowait(_END))
        self._cancelled = False

    def cancel(self) -> None:
        self._cancelled = True
        self._call.cancel()

    async def __aiter__(self) -> AsyncIterator[Any]:
        try:
            while (message := await self._context.messages.get()) is not _END:
                await self._process.wait_running()
                yield message
            await self._process.wait_running()
            if self._cancelled or self._call.cancelled():
                raise asyncio.CancelledError
            self._call.result()
        finally:
            self._call.cancel()
            with contextlib.suppress(BaseException):
                await self._call
