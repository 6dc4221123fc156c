"""What every handler does: know the caller, and turn what goes wrong into a status with details."""

from __future__ import annotations

import logging
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import grpc
from fractus_core.policy.values import Verdict

from fractus_services.auth import Caller, NotAuthenticated, caller_of
from fractus_services.grants import GrantFiles, Held
from fractus_services.replies import Refused, abort, refused

log = logging.getLogger(__name__)

CALLS_PER_S = 50.0
BURST = 100.0
"""What one identity may ask of a service; a driver that streams setpoints stays far below it."""


class Allowance:
    """A token bucket for each caller: a flood costs its sender, not the drone."""

    def __init__(self, rate: float = CALLS_PER_S, burst: float = BURST) -> None:
        self._rate = rate
        self._burst = burst
        self._left: dict[str, tuple[float, float]] = {}

    def take(self, identity: str, time_s: float) -> bool:
        """Use up one call; False when there is none left. Times are monotonic seconds."""
        left, at = self._left.get(identity, (self._burst, time_s))
        left = min(self._burst, left + max(time_s - at, 0.0) * self._rate)
        if left < 1.0:
            self._left[identity] = (left, time_s)
            return False
        self._left[identity] = (left - 1.0, time_s)
        return True


class Reception:
    """Receives the calls of one service.

    Args:
        grants: grants of this node.
        clock: Unix time.
        translate: a failure of the service's own kind as a refusal; None for what it does not know.
        failed: called with the verdict on an error that nobody foresaw.
    """

    def __init__(
        self,
        grants: GrantFiles,
        clock: Callable[[], float],
        translate: Callable[[Exception], Refused | None] = lambda _error: None,
        failed: Callable[[Verdict], None] = lambda _verdict: None,
    ) -> None:
        self._grants = grants
        self.clock = clock
        self._translate = translate
        self._failed = failed
        self._allowance = Allowance()

    @asynccontextmanager
    async def call(self, context: Any, urgent: bool = False) -> AsyncIterator[Caller]:
        """The caller of a call; exceptions inside end it with a status.

        Args:
            context: gRPC's context of the call.
            urgent: the call only makes things safer, so no limit of rates holds it up.
        """
        try:
            caller = caller_of(context.auth_context(), self.clock())
            if not urgent and not self._allowance.take(caller.identity, time.monotonic()):
                reason = f"more than {CALLS_PER_S:.0f} calls a second; slow down"
                raise Refused(grpc.StatusCode.RESOURCE_EXHAUSTED, Verdict("deny", None, "TooManyCalls", reason))
            yield caller
        except NotAuthenticated as error:
            verdict = Verdict("deny", None, "NotAuthenticated", str(error))
            await abort(context, Refused(grpc.StatusCode.UNAUTHENTICATED, verdict))
        except Refused as refusal:
            await abort(context, refusal)
        except grpc.aio.AbortError:
            raise
        except Exception as error:
            known = self._translate(error)
            if known is not None:
                await abort(context, known)
            log.exception("a call failed inside the service; refused")
            verdict = Verdict("deny", None, "InternalError", "the service failed; nothing was done", (), "hover")
            self._failed(verdict)
            await abort(context, Refused(grpc.StatusCode.INTERNAL, verdict))

    def held(self, caller: Caller) -> Held:
        """The grant of a caller.

        Raises:
            Refused: it has none here.
        """
        held = self._grants.of(caller.identity)
        if held is None:
            raise refused(Verdict("deny", None, "NoGrant", f"{caller.identity} has no grant on this node"))
        return held
