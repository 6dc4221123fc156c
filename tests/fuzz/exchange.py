"""Fuzz requests between components, with arbitrary ids and attempt numbers.

Each request runs once or is refused with a status."""

from __future__ import annotations

import asyncio
import logging
import sys
from collections import Counter
from typing import Any

import atheris

with atheris.instrument_imports(include=["fractus.exchange"]):
    from fractus.exchange import ATTEMPT_HEADER, ID_HEADER, Request, Responder
import grpc
from virtual_time import fly

IDS = ["a", "b", "", "a" * 200, "\0", "é"]
ATTEMPTS = ["1", "2", "", "-1", "1.5", "x", "9" * 5000, "²", "٣", " 1"]
logging.disable(logging.CRITICAL)


class Context:
    """Fake gRPC context of one call."""

    def __init__(self, metadata: tuple[tuple[str, str | bytes], ...]) -> None:
        self._metadata = metadata
        self.code: grpc.StatusCode | None = None

    def invocation_metadata(self) -> tuple[tuple[str, str | bytes], ...]:
        return self._metadata

    async def abort(self, code: grpc.StatusCode, _text: str) -> None:
        self.code = code
        raise grpc.aio.AbortError


class Peer:
    """Fake component that replies and counts executed requests."""

    def __init__(self, data_provider: atheris.FuzzedDataProvider) -> None:
        self._data_provider = data_provider
        self.done: Counter[tuple[str, bytes]] = Counter()

    async def handle(self, request: Request) -> bytes:
        """Execute a request, or refuse it temporarily or permanently."""
        assert request.attempt >= 0
        await asyncio.sleep(0.1)
        how = self._data_provider.ConsumeIntInRange(0, 7)
        if how == 0:
            raise ValueError("refused")
        if how == 1:
            raise OSError("again")
        self.done[request.id, request.body] += 1
        return request.body + b"!"


async def requests(data_provider: atheris.FuzzedDataProvider) -> None:
    """Send up to twelve requests. They share few ids, so that some ids repeat."""
    peer = Peer(data_provider)
    method = Responder({}, 0)._method("M", peer.handle).unary_unary

    async def call(body: bytes, context: Context) -> None:
        try:
            answer = await method(body, context)
        except grpc.aio.AbortError:
            assert context.code in {grpc.StatusCode.INVALID_ARGUMENT, grpc.StatusCode.UNAVAILABLE}, context.code
        else:
            assert answer == body + b"!"

    running: list[asyncio.Task[Any]] = []
    for _ in range(data_provider.ConsumeIntInRange(1, 12)):
        metadata: list[tuple[str, str | bytes]] = []
        if data_provider.ConsumeIntInRange(0, 7):
            metadata.append(
                (
                    ID_HEADER,
                    data_provider.PickValueInList(IDS)
                    if data_provider.ConsumeBool()
                    else data_provider.ConsumeUnicodeNoSurrogates(80),
                )
            )
        if data_provider.ConsumeIntInRange(0, 3):
            metadata.append((ATTEMPT_HEADER, data_provider.PickValueInList(ATTEMPTS)))
        if not data_provider.ConsumeIntInRange(0, 7):
            metadata.append(
                (
                    data_provider.PickValueInList([ID_HEADER, ATTEMPT_HEADER]),
                    data_provider.ConsumeUnicodeNoSurrogates(10),
                )
            )
        task = asyncio.ensure_future(call(data_provider.PickValueInList([b"", b"x", b"y"]), Context(tuple(metadata))))
        running.append(task)
        if data_provider.ConsumeBool():
            await asyncio.sleep(0.05)
        if not data_provider.ConsumeIntInRange(0, 7):
            task.cancel()
    for outcome in await asyncio.gather(*running, return_exceptions=True):
        if isinstance(outcome, Exception):
            raise outcome
    await asyncio.sleep(1)
    assert all(count == 1 for count in peer.done.values()), peer.done
    assert len({name for name, _ in peer.done}) == len(peer.done), "one id was executed with two bodies"


def fuzz_one(data: bytes) -> None:
    """Run one sequence of requests."""
    fly(lambda: requests(atheris.FuzzedDataProvider(data)))


if __name__ == "__main__":
    atheris.Setup(sys.argv, fuzz_one)
    atheris.Fuzz()
