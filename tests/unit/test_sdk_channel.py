"""What is tried again while a service is away, and what is not."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import grpc
import pytest
from fractus.channel import ServiceChannel
from fractus.environment import Endpoint
from fractus.errors import Unavailable
from grpc.aio import Metadata


class Restarting(ServiceChannel):
    """A service that is away when it is called first."""

    def __init__(self) -> None:
        super().__init__(Endpoint("127.0.0.1:1", "drone-1", Path("tls")), lambda _channel: None)
        self.calls: list[Any] = []

    async def _answer(self, request: Any, *, timeout: float) -> str:  # noqa: ASYNC109 - as stubs have it
        assert timeout > 0
        self.calls.append(request)
        if len(self.calls) == 1:
            raise grpc.aio.AioRpcError(grpc.StatusCode.UNAVAILABLE, Metadata(), Metadata(), "Connection refused")
        return "done"

    @asynccontextmanager
    async def stub(self) -> AsyncIterator[Any]:
        yield SimpleNamespace(Arm=self._answer, SetVelocity=self._answer, Hover=self._answer, GetPosition=self._answer)


@pytest.mark.parametrize("method", ["Hover", "GetPosition"])
async def test_a_call_waits_for_a_service_that_restarts(method: str) -> None:
    channel = Restarting()
    assert await channel.unary(method, "request") == "done"
    assert len(channel.calls) == 2


@pytest.mark.parametrize("method", ["Arm", "SetVelocity"])
async def test_what_is_for_this_moment_is_not_asked_for_later(method: str) -> None:
    channel = Restarting()
    with pytest.raises(Unavailable):
        await channel.unary(method, "request")
    assert len(channel.calls) == 1
