"""What every handler does: authenticate the caller, limit its rate, and turn errors into a status with details."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import grpc
from fractus_core.policy.decision_types import Verdict
from fractus_runtime import spans
from google.protobuf.message import DecodeError

from fractus_services.auth import Caller, Callers
from fractus_services.error_details import abort
from fractus_services.errors import (
    InternalError,
    InvalidRequest,
    NotAuthenticated,
    PolicyDenied,
    Refused,
    ResourceExhausted,
)
from fractus_services.grant_files import ActiveGrant, GrantFiles

log = logging.getLogger(__name__)

CALLS_PER_S = 50.0
BURST = 100.0
"""What one identity may ask of a service; a driver that streams setpoints stays far below it."""

URGENT_PER_S = 20.0
URGENT_BURST = 40.0
"""The same for calls that only make things safer; these are counted apart, so that no other call uses them up."""

MAX_OPEN_CALLS = 32
"""How many calls of one identity may be under way at a time, streams included."""

REQUEST_TIMEOUT_S = 10.0
"""Within which the request of a call has to come. Clients send both at once, but a bad link may lose the second part."""

_MAX_COUNTED = 1_000


class Allowance:
    """A token bucket for each caller: a flood costs its sender, not the drone."""

    def __init__(self, rate: float = CALLS_PER_S, burst: float = BURST) -> None:
        self.rate = rate
        self._burst = burst
        self._left: dict[str, tuple[float, float]] = {}

    def take(self, identity: str, time_s: float) -> float:
        """Use up one call; 0, or in how many seconds to try again when there is none left. Times are monotonic."""
        left, at = self._left.get(identity, (self._burst, time_s))
        left = min(self._burst, left + max(time_s - at, 0.0) * self.rate)
        if left < 1.0:
            self._left[identity] = (left, time_s)
            return (1.0 - left) / self.rate
        self._left[identity] = (left - 1.0, time_s)
        if len(self._left) > _MAX_COUNTED:
            full_s = self._burst / self.rate
            self._left = {name: entry for name, entry in self._left.items() if time_s - entry[1] < full_s}
        return 0.0


class CallAdmission:
    """Lets calls of one service in, and ends them with a status.

    Args:
        grants: grants of this node.
        clock: Unix time.
        translate: a failure of the service's own kind as a refusal; None for what it does not know.
        failed: called with the verdict on an error that no one foresaw.
    """

    def __init__(
        self,
        grants: GrantFiles,
        clock: Callable[[], float],
        translate: Callable[[Exception], Refused | None] = lambda _error: None,
        failed: Callable[[Verdict], None] = lambda _verdict: None,
    ) -> None:
        self._grants = grants
        self._callers = Callers(clock)
        self._translate = translate
        self._failed = failed
        self._allowance = Allowance()
        self._urgent = Allowance(URGENT_PER_S, URGENT_BURST)
        self._open: Counter[str] = Counter()

    @asynccontextmanager
    async def call(self, context: Any, urgent: bool = False, lasting: bool = False) -> AsyncIterator[Caller]:
        """The caller of a call; exceptions inside end it with a status.

        Args:
            context: gRPC's context of the call.
            urgent: the call only makes things safer: it needs no deadline and no certificate of this moment, and no flood of
                other calls holds it up.
            lasting: a stream that is the caller's sign of life, and needs no deadline either.
        """
        admitted = ""
        try:
            caller = self._callers.of(context.auth_context(), urgent)
            spans.call().note("fractus.caller", caller.identity)
            self._admit(caller.identity, self._urgent if urgent else self._allowance, urgent)
            admitted = caller.identity
            self._open[admitted] += 1
            if not (urgent or lasting) and context.time_remaining() is None:
                reason = "the call has no deadline; set a timeout, as the SDK does"
                raise InvalidRequest("DeadlineMissing", reason)
            yield caller
        except Refused as refusal:
            await abort(context, refusal)
        except grpc.aio.AbortError:
            raise
        except Exception as error:
            known = self._translate(error)
            if known is not None:
                await abort(context, known)
            log.exception("rpc: a call failed inside the service, refused")
            reason = "the service failed; nothing was done"
            self._failed(Verdict("deny", None, "InternalError", reason, (), "hover"))
            await abort(context, InternalError("InternalError", reason))
        finally:
            if admitted:
                self._open[admitted] -= 1
                if not self._open[admitted]:
                    del self._open[admitted]

    def decoded(self, handler: grpc.RpcMethodHandler) -> grpc.RpcMethodHandler:
        """A handler whose requests are decoded once their caller is let in and counted: a flood of nonsense is one too.

        gRPC begins the call of a method with one request when that has arrived, and keeps those whose request never does. So
        to gRPC it is a method with a stream of requests, of which the first one is read.
        """
        decode, handle = handler.request_deserializer, handler.unary_unary or handler.unary_stream
        unsent: Counter[str] = Counter()

        async def behaviour(_requests: Any, context: Any) -> Any:
            body = await self._received(unsent, context)
            try:
                request = None if body is grpc.aio.EOF else decode(body)
            except DecodeError:
                request = None
            if request is not None:
                return await handle(request, context)
            async with self.call(context, lasting=True):
                raise InvalidRequest("InvalidArgument", "the request cannot be decoded; send this method's message")

        build = grpc.stream_unary_rpc_method_handler if handler.unary_unary else grpc.stream_stream_rpc_method_handler
        return build(behaviour, None, handler.response_serializer)

    async def _received(self, unsent: Counter[str], context: Any) -> Any:
        """The bytes of a call's request, or EOF; ends a call that does not send it, and the one too many that has not yet.

        Args:
            unsent: calls of each identity whose request is not there yet.
            context: gRPC's context of the call.
        """
        try:
            identity = self._callers.of(context.auth_context(), True).identity
        except NotAuthenticated:
            identity = ""
        if unsent[identity] >= MAX_OPEN_CALLS:
            reason = f"{MAX_OPEN_CALLS} calls of this method wait for their request; send it with the call"
            await abort(context, ResourceExhausted("TooManyCalls", reason, retry_after_s=1.0))
        unsent[identity] += 1
        try:
            async with asyncio.timeout(REQUEST_TIMEOUT_S):
                return await context.read()
        except TimeoutError:
            reason = f"no request came within {REQUEST_TIMEOUT_S:.0f} s of the call; send it with the call"
            await abort(context, InvalidRequest("InvalidArgument", reason))
        finally:
            unsent[identity] -= 1
            if not unsent[identity]:
                del unsent[identity]

    def _admit(self, identity: str, allowance: Allowance, urgent: bool) -> None:
        """Count a call.

        Raises:
            Refused: the caller asks too much.
        """
        again_s = allowance.take(identity, time.monotonic())
        reason = f"more than {allowance.rate:.0f} calls a second; slow down"
        if not again_s and not urgent and self._open[identity] >= MAX_OPEN_CALLS:
            again_s, reason = 1.0, f"{MAX_OPEN_CALLS} calls are under way; end one before the next"
        if again_s:
            raise ResourceExhausted("TooManyCalls", reason, retry_after_s=again_s)

    def grant_of(self, caller: Caller) -> ActiveGrant:
        """The grant of a caller.

        Raises:
            Refused: it has none here.
        """
        grant = self._grants.of(caller.identity)
        if grant is None:
            log.warning(
                "policy: no grant on this node, call refused (caller=%s)",
                caller.identity,
                extra={"limit_by": caller.identity},
            )
            raise PolicyDenied("NoGrant", f"{caller.identity} has no grant on this node")
        return grant
