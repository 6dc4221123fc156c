"""Limits of rates: they hold up requests, never what makes things safer."""

from __future__ import annotations

from typing import Any, cast

import grpc
import pytest
from fractus_services import answering
from fractus_services.answering import BURST, Reception
from fractus_services.auth import Caller


class Aborted(Exception):
    """Stands for gRPC's end of a call."""


class Context:
    """A call of one caller."""

    def auth_context(self) -> dict[str, Any]:
        return {}

    async def abort(self, code: grpc.StatusCode, _details: str, _metadata: Any) -> None:
        raise Aborted(code)


async def test_an_urgent_call_is_let_through_a_flood(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(answering, "caller_of", lambda _context, _time: Caller("spiffe://fractus.dev/a", 0.0, 1e12))
    monkeypatch.setattr(answering.time, "monotonic", lambda: 1.0)
    reception = Reception(cast("Any", None), lambda: 0.0)
    for _ in range(int(BURST)):
        async with reception.call(Context()):
            pass
    with pytest.raises(Aborted, match="RESOURCE_EXHAUSTED"):
        async with reception.call(Context()):
            pass
    async with reception.call(Context(), urgent=True) as caller:
        assert caller.identity == "spiffe://fractus.dev/a"
