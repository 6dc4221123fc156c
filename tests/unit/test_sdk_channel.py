"""Retries of SDK calls while a service is unreachable."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import fractus
import grpc
import pytest
from fractus.channel import ServiceChannel
from fractus.environment import Endpoint
from fractus.errors import NotConfigured, Unavailable
from grpc.aio import Metadata


class Restarting(ServiceChannel):
    """Channel to a service that is unavailable during the first call."""

    def __init__(self) -> None:
        super().__init__(Endpoint("127.0.0.1:1", "drone-1", Path("tls")), lambda _channel: None)
        self.calls: list[Any] = []

    async def _answer(self, request: Any, *, timeout: float) -> str:  # noqa: ASYNC109 - same signature as gRPC stubs
        assert timeout > 0
        self.calls.append(request)
        if len(self.calls) == 1:
            raise grpc.aio.AioRpcError(grpc.StatusCode.UNAVAILABLE, Metadata(), Metadata(), "Connection refused")
        return "done"

    @asynccontextmanager
    async def stub(self) -> AsyncIterator[Any]:
        yield SimpleNamespace(Arm=self._answer, SetVelocity=self._answer, Hover=self._answer, GetPosition=self._answer)


@pytest.mark.parametrize("method", ["Hover", "GetPosition"])
async def test_call_retries_while_service_restarts(method: str) -> None:
    channel = Restarting()
    assert await channel.unary(method, "request") == "done"
    assert len(channel.calls) == 2


@pytest.mark.parametrize("method", ["Arm", "SetVelocity"])
async def test_arm_and_set_velocity_are_not_retried(method: str) -> None:
    channel = Restarting()
    with pytest.raises(Unavailable):
        await channel.unary(method, "request")
    assert len(channel.calls) == 1


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "the certificate {0}/ca.crt cannot be read: No such file or directory"),
        (b"", "{0}/ca.crt is not a PEM file"),
    ],
)
def test_missing_or_invalid_certificate_exits_with_one_sentence(
    tmp_path: Path, content: bytes | None, said: str
) -> None:
    if content is not None:
        for name in ("ca.crt", "tls.key", "tls.crt"):
            (tmp_path / name).write_bytes(content)

    async def program(_drone: fractus.Mobility, _control: fractus.Control) -> None:
        raise AssertionError("there is no control")

    remedy = "set FRACTUS_TLS_DIR to the directory of this component's tls.crt, tls.key and ca.crt"
    with pytest.raises(SystemExit) as ended:
        fractus.run(program, endpoint=Endpoint("127.0.0.1:1", "drone-1", tmp_path), stay=False)
    assert ended.value.code == f"{said.format(tmp_path)}; {remedy}"


async def test_control_without_certificate_raises_not_configured(tmp_path: Path) -> None:
    async with fractus.mobility(Endpoint("127.0.0.1:1", "drone-1", tmp_path)) as drone:
        with pytest.raises(NotConfigured, match="set FRACTUS_TLS_DIR"):
            async with drone.control():
                pass
