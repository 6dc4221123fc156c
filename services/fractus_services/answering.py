"""What every handler does: know the caller, and turn what goes wrong into a status with details."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import grpc
from fractus_core.policy.values import Verdict

from fractus_services.auth import Caller, NotAuthenticated, caller_of
from fractus_services.grants import GrantFiles, Held
from fractus_services.replies import Refused, abort, refused

log = logging.getLogger(__name__)


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

    @asynccontextmanager
    async def call(self, context: Any) -> AsyncIterator[Caller]:
        """The caller of a call; exceptions inside end it with a status."""
        try:
            yield caller_of(context.auth_context(), self.clock())
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
