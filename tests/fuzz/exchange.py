"""Fuzz requests between components, with any ids and attempts: each runs once, or is refused with a status."""

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
    """gRPC's context of one call."""

    def __init__(self, metadata: tuple[tuple[str, str | bytes], ...]) -> None:
        self._metadata = metadata
        self.code: grpc.StatusCode | None = None

    def invocation_metadata(self) -> tuple[tuple[str, str | bytes], ...]:
        return self._metadata

    async def abort(self, code: grpc.StatusCode, _text: str) -> None:
        self.code = code
        raise grpc.aio.AbortError


class Peer:
    """A component that replies, and counts the requests it has executed."""

    def __init__(self, given: atheris.FuzzedDataProvider) -> None:
        self._given = given
        self.done: Counter[tuple[str, bytes]] = Counter()

    async def handle(self, request: Request) -> bytes:
        """Execute a request, or refuse it temporarily or permanently."""
        assert request.attempt >= 0
        await asyncio.sleep(0.1)
        how = self._given.ConsumeIntInRange(0, 7)
        if how == 0:
            raise ValueError("refused")
        if how == 1:
            raise OSError("again")
        self.done[request.id, request.body] += 1
        return request.body + b"!"


async def requests(given: atheris.FuzzedDataProvider) -> None:
    """Send up to twelve requests with few ids."""
    peer = Peer(given)
    method = Responder({}, 0)._method("M", peer.handle).unary_unary

    async def call(body: bytes, context: Context) -> None:
        try:
            answer = await method(body, context)
        except grpc.aio.AbortError:
            assert context.code in {grpc.StatusCode.INVALID_ARGUMENT, grpc.StatusCode.UNAVAILABLE}, context.code
        else:
            assert answer == body + b"!"

    running: list[asyncio.Task[Any]] = []
    for _ in range(given.ConsumeIntInRange(1, 12)):
        metadata: list[tuple[str, str | bytes]] = []
        if given.ConsumeIntInRange(0, 7):
            metadata.append(
                (ID_HEADER, given.PickValueInList(IDS) if given.ConsumeBool() else given.ConsumeUnicodeNoSurrogates(80))
            )
        if given.ConsumeIntInRange(0, 3):
            metadata.append((ATTEMPT_HEADER, given.PickValueInList(ATTEMPTS)))
        if not given.ConsumeIntInRange(0, 7):
            metadata.append((given.PickValueInList([ID_HEADER, ATTEMPT_HEADER]), given.ConsumeUnicodeNoSurrogates(10)))
        task = asyncio.ensure_future(call(given.PickValueInList([b"", b"x", b"y"]), Context(tuple(metadata))))
        running.append(task)
        if given.ConsumeBool():
            await asyncio.sleep(0.05)
        if not given.ConsumeIntInRange(0, 7):
            task.cancel()
    for outcome in await asyncio.gather(*running, return_exceptions=True):
        if isinstance(outcome, Exception):
            raise outcome
    await asyncio.sleep(1)
    assert all(count == 1 for count in peer.done.values()), peer.done
    assert len({name for name, _ in peer.done}) == len(peer.done), "one id, two bodies"


def one(data: bytes) -> None:
    """Run one conversation."""
    fly(lambda: requests(atheris.FuzzedDataProvider(data)))


if __name__ == "__main__":
    atheris.Setup(sys.argv, one)
    atheris.Fuzz()
